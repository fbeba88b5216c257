"""Where in the pupil the light of a pixel comes from on average, when the microlenses diffract it."""

from __future__ import annotations

import functools

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ..camera import PlenopticCamera
from ..runtime.limits import require_memory
from .phase import in_millimetres, soft_edge

_PLANE = 8
"""Width of the plane in which the pupil is spread, in radii of the pupil."""

_LEAST_SAMPLES = 512


class PupilCentroid:
    """Where in the pupil the light has its centroid that a pixel gets by a microlens's diffraction.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        In nanometres.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float) -> None:
        window = _PLANE * camera.aperture_radius
        # A frequency over the pupil plane is a place in the lens.
        lens = camera.lattice.aperture_image(in_millimetres(wavelength) * camera.mla_distance / window, 1.0)
        size = scipy.fft.next_fast_len(max(_LEAST_SAMPLES, 2 * len(lens)), real=True)
        require_memory(100.0 * size**2, f"pupil of {size} x {size} samples")
        amplitude = np.zeros((size, size))
        amplitude[: len(lens), : len(lens)] = lens
        spread = np.abs(scipy.fft.ifft2(np.roll(amplitude, (-(len(lens) // 2),) * 2, (0, 1)))) ** 2
        transfer = scipy.fft.rfft2(spread)
        self._pitch, self._first = window / size, -(size - 1) / 2
        P = (np.arange(size) + self._first) * self._pitch
        inside = soft_edge((camera.aperture_radius - np.hypot(P, P[:, None])) / self._pitch)

        def blurred(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(scipy.fft.irfft2(scipy.fft.rfft2(values) * transfer, s=(size, size)))

        light = blurred(inside)
        # Far from the pupil the rounding of the transform is not light.
        lit = light > 1e-6 * light.max()
        self._tables = [
            np.divide(blurred(inside * along), light, out=np.zeros_like(light), where=lit).clip(
                -camera.aperture_radius, camera.aperture_radius
            )
            for along in (P, P[:, None])
        ]

    @classmethod
    @functools.lru_cache(maxsize=8)
    def of(cls, camera: PlenopticCamera, wavelength: float) -> PupilCentroid:
        """Return the one of a camera and a wavelength, made once."""
        return cls(camera, wavelength)

    def __call__(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return the places, along x and y, for pixels that see (x, y) through their lens's centre; in millimetres."""
        at = [np.asarray(axis) / self._pitch - self._first for axis in (y, x)]
        return [map_coordinates(table, at, order=1, mode="nearest") for table in self._tables]
