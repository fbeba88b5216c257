"""Options of the method ``deconvolved``; help reads this module, which imports no library."""

from typing import Annotated, TypedDict

from ... import choices
from ...errors import require_number
from ...refocus_options import Option

MOST_VARIATION = 0.25
"""Largest weight of the total variation: steps stay positive, as its gradient is at most 3.42."""


class DeconvolvedOptions(TypedDict, total=False):
    """Options of the method ``deconvolved``; None is the default."""

    response: Annotated[
        choices.Model | None,
        Option(
            "how light goes through the camera.", "With a `wavelength` it is ``wave``.", shown="as the capture was made"
        ),
    ]
    iterations: Annotated[
        int | None,
        Option(
            "steps.",
            "Where the noise is known, from `photons` or from metadata of `expose`, there are at most 100.",
            shown="until only noise is left, where a capture states its exposure; else 30",
        ),
    ]
    accelerate: Annotated[
        bool | None,
        Option(
            "whether each step starts from an extrapolated point.",
            "One step then does the work of several.",
            default=True,
        ),
    ]
    photons: Annotated[
        float | None,
        Option(
            "photons that a pixel of value 1 has counted.",
            "Photon noise is then the only noise.",
            shown="those that 'expose' recorded",
            check=lambda name, value, _: require_number(name, value, positive=True),
        ),
    ]
    volume: Annotated[bool | None, Option("all distances together explain the capture, not each alone.", default=False)]
    variation: Annotated[
        float | None,
        Option(
            "weight of the total variation, which makes planes even between sharp borders.",
            "At most 0.25; 0.002 to 0.02 suit, the more the noisier the capture. What is fainter than the noise "
            "becomes flat, and slopes become steps.",
            default=0.0,
            shown="0",
            check=lambda name, value, _: require_number(name, value, minimum=0, maximum=MOST_VARIATION),
        ),
    ]
