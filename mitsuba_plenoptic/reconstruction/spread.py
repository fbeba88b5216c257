"""Light of single lenses, spread over what they have gathered it from."""

from __future__ import annotations

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint
from ..runtime.convolve import blur, convolve


def lens_scale(camera: PlenopticCamera, distance: float) -> float:
    """Part of a lens over which its light is spread: all for an unfocused one, none where a focused one is sharp."""
    if focus_type(camera) == "unfocused":
        return 1.0
    return min(lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths)


def over_lenses(
    power: np.ndarray, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0
) -> np.ndarray:
    """Spread what comes from each lens over its aperture, enlarged by `scale`, and sum fine bins to bins.

    A lens has gathered light over its aperture. Where a lens lies on every bin spreading it would change nothing in
    focus; elsewhere the light of all of a lens would go to the one bin that holds its centre, and some bins would get
    none.
    """
    # the transform's rounding is not light
    return _spread(power, _aperture(camera, oversample, fine, scale), fine).clip(min=0)


class LensSpread:
    """`over_lenses` as a function with derivatives, which does nothing where there is a lens on each bin.

    Parameters
    ----------
    camera, oversample, fine
        As of `over_lenses`.
    distance : float
        Object distance, which tells the scale.
    """

    def __init__(self, camera: PlenopticCamera, distance: float, oversample: int, fine: int) -> None:
        self._aperture, self._fine = None, fine
        if fine > 1:
            self._aperture = _aperture(camera, oversample, fine, lens_scale(camera, distance))

    def at(self, power: np.ndarray) -> SpreadBins:
        """Spread a power."""
        return SpreadBins(self._aperture, self._fine, power)


class SpreadBins:
    """A power in bins, spread over lenses, and its derivatives there.

    Attributes
    ----------
    bins : (rows, columns) array
        The power.
    """

    def __init__(self, aperture: np.ndarray | None, fine: int, power: np.ndarray) -> None:
        self._aperture, self._fine = aperture, fine
        spread = power if aperture is None else _spread(power, aperture, fine)
        self._lit = spread > 0
        self.bins = np.where(self._lit, spread, 0)

    def tangent(self, change: np.ndarray) -> np.ndarray:
        """Return the change of the bins with that of the power."""
        spread = change if self._aperture is None else _spread(change, self._aperture, self._fine)
        return np.where(self._lit, spread, 0)

    def back(self, bins: np.ndarray) -> np.ndarray:
        """Apply the transpose of `tangent`."""
        bins = np.where(self._lit, bins, 0)
        if self._aperture is None:
            return bins
        rows, columns = ((k - 1) // 2 for k in self._aperture.shape)
        fine = bins.repeat(self._fine, 0).repeat(self._fine, 1)
        whole = convolve(fine, self._aperture[::-1, ::-1])
        first = [k - 1 - middle for k, middle in zip(self._aperture.shape, (rows, columns), strict=True)]
        return whole[first[0] : first[0] + fine.shape[0], first[1] : first[1] + fine.shape[1]]


def _aperture(camera: PlenopticCamera, oversample: int, fine: int, scale: float) -> np.ndarray:
    """Return what light of a lens is spread over, on fine bins."""
    return camera.lattice.aperture_image(camera.mla_pitch / (oversample * fine), scale)


def _spread(power: np.ndarray, aperture: np.ndarray, fine: int) -> np.ndarray:
    """Spread fine bins, and sum them to bins."""
    rows, columns = (size // fine for size in power.shape)
    return blur(power, aperture).reshape(rows, fine, columns, fine).sum((1, 3))
