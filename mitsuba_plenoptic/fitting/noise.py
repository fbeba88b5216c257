"""The noise of recorded pixels as a model expects it, and which pixels count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, require_number
from ..io.captures import Capture
from ..io.raw import response_of
from ..mosaic import require_demosaiced

if TYPE_CHECKING:
    from .light import View

_LEAST_ELECTRONS = 1.0
"""Variance, in squared electrons, by which pixels are weighted at least: of a stray count in the dark."""

_CLEAR = 4.0
"""Standard deviations by which a pixel that counts is expected below its saturation."""

_LIGHT = 3.0
"""Standard deviations of its dark noise by which the sum of a capture is above zero, or it is black."""

_NEGATIVE = 6.0
"""Standard deviations of its dark noise, by no more of which a pixel is below zero."""


@dataclass(frozen=True)
class PixelNoise:
    r"""Noise of counted electrons, and of the dark.

    The variance of a pixel whose expected value is :math:`v` is :math:`(E v + d) / E^2`.

    Parameters
    ----------
    electrons : float
        Electrons that are counted in a pixel of value 1, E: photons times quantum efficiency.
    dark_variance : float
        Variance without light, d, in squared electrons: of dark current, reading and rounding.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    electrons: float
    dark_variance: float = 0.0

    def __post_init__(self) -> None:
        require_number("electrons", self.electrons, positive=True)
        require_number("dark_variance", self.dark_variance, minimum=0)


def kept_noise(capture: Capture) -> tuple[PixelNoise | None, float | None]:
    """Return the noise of a capture that `expose` made, from its metadata, and the value at which its pixels saturate.

    Parameters
    ----------
    capture : Capture
        The capture.

    Returns
    -------
    noise : PixelNoise or None
        None if no detector has recorded the capture.
    saturation : float or None
        Four standard deviations of the reading below a full well, or below the largest digital number.

    Raises
    ------
    InputError
        If the metadata are damaged, or the capture is a mosaic of colours.
    """
    require_demosaiced(capture)
    exposure = capture.metadata.get("exposure")
    if not isinstance(exposure, dict):
        return None, None
    gain, black, dark, unit = response_of(exposure)
    reading, full = (require_number(name, exposure.get(name), minimum=0) for name in ("read_noise", "full_well"))
    largest = (2 ** require_number("bits", exposure.get("bits"), minimum=1, maximum=16) - 1 - black) / gain
    # Rounding adds a twelfth of the square of a digital number (EMVA Standard 1288).
    noise = PixelNoise(unit, dark + reading**2 + 1 / (12 * gain**2))
    return noise, (min(full, largest) - dark - _CLEAR * reading) / unit


@dataclass(frozen=True)
class Pixels:
    """What is expected of the noise of all pixels of some views, (views, rows, columns)."""

    # Deviations by which residuals are divided; infinite where a pixel does not count.
    weight: NDArray[np.float64]
    # Expected squares of the residuals after that: 1, less in the dark, and 0 where a pixel does not count.
    share: NDArray[np.float64]
    # Variances of those squares.
    spread: NDArray[np.float64]

    @classmethod
    def of(cls, views: Sequence[View], expected: NDArray[np.float64], default: PixelNoise | None) -> Pixels:
        """Return the noise of views whose pixels are expected to have some values; `default` where a view has none."""
        return cls(*map(np.stack, zip(*map(_pixels, views, expected, [default] * len(views)), strict=True)))


def by_model(view: View, default: PixelNoise | None) -> bool:
    """Return whether the noise of a view, or which of its pixels count, depends on what a model expects."""
    return view.saturation is not None or isinstance(default if view.noise is None else view.noise, PixelNoise)


def _pixels(view: View, expected: NDArray[np.float64], default: PixelNoise | None) -> tuple[NDArray[np.float64], ...]:
    noise: Any = default if view.noise is None else view.noise
    if isinstance(noise, PixelNoise):
        counts, unit = noise.electrons * np.maximum(expected, 0), noise.electrons
        variance = counts + noise.dark_variance
        weight = np.maximum(variance, _LEAST_ELECTRONS)
    else:
        counts, unit = np.zeros_like(expected), 1.0
        weight = variance = counts + np.square(noise)
    kept = view.kept
    if view.saturation is not None:
        # By what is expected alone, so that noise does not decide which pixels near saturation count.
        kept = kept & (expected + _CLEAR * np.sqrt(variance) / unit < view.saturation)
    share = np.where(kept, variance / weight, 0.0)
    # The fourth cumulant of a Poisson distribution is its mean; that of a normal one is zero.
    spread = np.where(kept, (2 * variance**2 + counts) / weight**2, 0.0)
    return np.where(kept, np.sqrt(weight) / unit, np.inf), share, spread


def check_light(view: View, default: PixelNoise | None = None) -> None:
    """Refuse a view that shows no light, or pixels further below zero than noise takes them."""
    noise = default if view.noise is None else view.noise
    if isinstance(noise, PixelNoise):
        dark, least = (np.sqrt(max(noise.dark_variance, some)) / noise.electrons for some in (0.0, _LEAST_ELECTRONS))
    else:
        dark = 0.0 if noise is None else np.asarray(noise, np.float64)
        least = np.inf if noise is None else dark
    kept, image = view.kept, view.image
    if not kept.any():
        raise InputError("image: all of its pixels are left out: by its mask, or as saturated")
    if image.sum(where=kept, dtype=np.float64) <= _LIGHT * np.sqrt(np.sum(np.square(dark) * kept)):
        raise InputError("image: it is black: nothing can be found by it")
    negative = kept & (image < -_NEGATIVE * least)
    if negative.any():
        row, column = np.argwhere(negative)[0]
        raise InputError(
            f"image: {negative.sum()} of its pixels are negative, beyond {_NEGATIVE:g} standard deviations of their "
            f"noise, the first, {image[row, column]:g}, at ({row}, {column}): subtract the right black level, or mask "
            "them"
        )
