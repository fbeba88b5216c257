"""How much of what a pixel sees of the pupil plane is open: the value of every pixel of a white image."""

from __future__ import annotations

import math

import numpy as np

from ..camera import PlenopticCamera
from ..runtime.fft import blur
from ..runtime.limits import require_memory

# Samples of the table across what a pixel covers of the pupil plane; fewer where the table would get as wide as this.
_SAMPLES = 16
_WIDEST = 4096

# Points across a pixel for the area of what the pupil's edge leaves of it: exact to 0.2 % of the pixel.
_POINTS = 8


class PupilFraction:
    r"""Fraction of the light from an endless pupil that a pixel gets through the pupil there is.

    Seen through a point m of its lens, a pixel covers a square of the pupil plane of side :math:`\Delta p\, b/z`; its
    place moves with m by :math:`1 + b/z - b/f_2` times as much. The fraction of the square that
    the pupil's disc covers is averaged over the lens's aperture: what the pixel reads of a scene of uniform radiance 1.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        # Which of its types of lenses, if there are several.
        lens_type: int = 0,
    ) -> None:
        smear = abs(camera.pupil_shift(camera.mla_focal_lengths[lens_type]))
        reach = camera.aperture_radius + smear * camera.lattice.aperture_reach + camera.pupil_step
        pixels = 2 * reach / camera.pupil_step
        samples = max(1, min(_SAMPLES, int(_WIDEST / pixels)))
        require_memory(
            100.0 * (samples * pixels) ** 2,
            f"white image of a lens, {2 * camera.aperture_radius / camera.pupil_step:.3g} pixels wide, smeared over "
            f"{2 * smear * camera.lattice.aperture_reach / camera.pupil_step:.3g}",
        )
        self._step = camera.pupil_step / samples
        lens = camera.lattice.aperture_image(self._step, smear)
        half = math.ceil(camera.aperture_radius / self._step + samples) + lens.shape[0] // 2
        place = np.arange(-half, half + 1) / samples
        disc = _square_in_disc(place, place[:, None], camera.aperture_radius / camera.pupil_step)
        fraction = blur(disc, lens)
        # The rounding of the transform is not light.
        self._table = np.where(fraction > 1e-6, fraction, 0).clip(max=1).astype(np.float32)
        self._half = half
        self.reach = half * self._step

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the fraction for pixels that see the place (x, y) of the pupil plane through their lens's centre."""
        x, y = (np.asarray(axis) / self._step + self._half for axis in (x, y))
        last = 2 * self._half - 1
        column, row = (np.floor(axis).clip(0, last).astype(np.int32) for axis in (x, y))
        fx, fy = ((axis - base).clip(0, 1).astype(np.float32) for axis, base in ((x, column), (y, row)))
        table, size = self._table.ravel(), self._table.shape[1]
        place = row * size + column
        low = table[place] * (1 - fx) + table[place + 1] * fx
        return low * (1 - fy) + (table[place + size] * (1 - fx) + table[place + size + 1] * fx) * fy


def _square_in_disc(x: np.ndarray, y: np.ndarray, radius: float) -> np.ndarray:
    """Return the fraction of a unit square about (x, y) that lies within a disc of this radius about the origin."""
    x, y = np.broadcast_arrays(x, y)
    distance = np.hypot(x, y)
    fraction = (distance < radius).astype(np.float64)
    edge = np.abs(distance - radius) < math.sqrt(0.5)
    offsets = (np.arange(_POINTS) + 0.5) / _POINTS - 0.5
    chord = np.sqrt(np.maximum(0, radius**2 - (x[edge][:, None] + offsets) ** 2))
    low, high = y[edge][:, None] - 0.5, y[edge][:, None] + 0.5
    fraction[edge] = np.maximum(0, np.minimum(high, chord) - np.maximum(low, -chord)).mean(1)
    return fraction
