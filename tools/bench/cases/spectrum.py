"""Colour: bands against dense quadrature, and a chart of known reflectances."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from cases import relative

from mitsuba_plenoptic import (
    CaptureOperator,
    PlenopticCamera,
    Spectrum,
)
from mitsuba_plenoptic.points.spectral import with_enough_nodes

from .. import Row, case, figure

ERROR = 0.003


CROWN = {"index": 1.5168, "abbe": 64.17}

POINTS = ((0.0, 0.0, 240.0), (0.3, 0.2, 210.0), (0.3, -0.4, 280.0))


@case(
    "spectrum.bands",
    "Spreads of bands, with as many wavelengths as are found necessary, against 64",
    page="docs/guides/colour.md",
    quick={"widths": (20.0,), "glass": False},
)
def bands(*, widths: tuple[float, ...] = (20.0, 100.0), glass: bool = True) -> Iterator[Row]:
    """Compare three points, without glass and with crown."""
    for material in (None, CROWN)[: 1 + glass]:
        camera = PlenopticCamera(resolution=(512, 512), detector_width=1.024, glass=material)
        for width in widths:
            worst, counts = 0.0, []
            for point in POINTS:
                dense = Spectrum.band(550, width, 64)
                found = with_enough_nodes(camera, [point], dense, ERROR)
                counts.append(len(found.nodes or found.wavelengths))
                images = [
                    CaptureOperator(camera, [point], spectrum=spectrum, accuracy=0).forward(
                        np.ones((1, len(spectrum.wavelengths)))
                    )
                    for spectrum in (Spectrum.band(550, width, counts[-1]), dense)
                ]
                worst = max(worst, relative(*images))
            what = f"band of {width:g} nm, {'crown' if material else 'no glass'}, {counts} wavelengths"
            yield figure(what, worst, at_most=ERROR)
