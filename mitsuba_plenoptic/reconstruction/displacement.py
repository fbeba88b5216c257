r"""Where the light of bins comes from, told by a white capture, and images brought back from there.

A bin gets light from about its place. The microlenses' diffraction takes light of one point of the pupil for that of
another; in the middle of the field this averages out, but where the pupil or the detector ends it comes from one side
only. Where lenses interfere, the phases of their fields weigh the places from which light comes. So a bin at x
that is divided by white reads a slope of radiance at :math:`x + s`, to first order.

The displacement s is the first moment of white. A scene whose radiance rises along the plane of the bins makes a
capture that is white times the radiance at the places that pixels have their light from,
:math:`W (1 + \epsilon u)`. Refocused by the same method and divided by white it reads :math:`1 + \epsilon (x + s)`.
The place u of a pixel is where the ray through the middle of its lens meets the bins, from that point of the pupil
where the pixel's light has its centroid: with K the spread of intensities over the pupil plane by a lens's diffraction,
:math:`K * (P \, A) / K * A` over the pupil A (Goodman, "Introduction to Fourier Optics", sections 4.4 and 5.2).

The image is then drawn back to first order, by the slope of a plane fitted to the bins about each one, at the places
where they have their light from (a local linear regression: Fan and Gijbels, "Local Polynomial Modelling and Its
Applications", section 3.1).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

import numpy as np
import scipy
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ..camera import PlenopticCamera
from ..design import focus_type
from ..optics import rays
from ..optics.phase import in_millimetres, soft_edge
from ..runtime.limits import require_memory

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


_SLOPE = 0.02
"""Change of white over the light that it has, at most: what is of second order in it is then no tenth of a bin."""

_FARTHEST = 1.0
"""Displacement that is believed, in lens pitches. Beyond, as where interference leaves little light, it is cut."""

_LEAST_DETERMINANT = 1e-3
"""Of the covariance of the places of bins to which a plane is fitted, in bins; that of four in a square is 0.06."""

_BLOCK = 2**18
"""Pixels that are looked at together."""


def is_known(camera: PlenopticCamera) -> bool:
    """Whether displacements are told: of unfocused cameras, whose pixels see pupil points, behind thin lenses."""
    return camera.lens_data.is_thin and focus_type(camera) == "unfocused"


def tilted_whites(
    white: NDArray[np.float32], camera: PlenopticCamera, distance: float, wavelengths: Sequence[float] | None
) -> Iterator[tuple[NDArray[np.float32], float]]:
    """Make of a capture of white those of scenes whose radiance rises along the bins, to the right and downwards.

    Parameters
    ----------
    white : (rows, columns, channels) float32 array
        The white capture.
    camera : PlenopticCamera
        The camera, for which `is_known`.
    distance : float
        Of the plane.
    wavelengths : sequence of floats, or None
        At which each channel was recorded by waves, in nanometres; None for a capture by rays.

    Yields
    ------
    tilted : (rows, columns, channels) float32 array
        The capture.
    slope : float
        Relative radiance per millimetre of the MLA plane, 1 on the axis.
    """
    at_pupil, on_bins = rays.follow_back(1.0, 0.0, 0.0, distance, camera)
    of_pupil = on_bins / at_pupil
    half = (max(camera.bin_count) / 2 + 1) * camera.mla_pitch
    farthest = half + abs(of_pupil) * camera.lit_radius
    slope = _SLOPE / farthest
    lights = [None] * white.shape[2] if wavelengths is None else list(wavelengths)
    for axis in (0, 1):
        tilted = np.empty_like(white)
        for rows, places in _places(camera, distance, axis, lights, of_pupil):
            for channel, u in enumerate(places):
                tilted[rows, :, channel] = white[rows, :, channel] * (1 + slope * u.clip(-farthest, farthest))
        yield tilted, slope


def _places(
    camera: PlenopticCamera, distance: float, axis: int, lights: Sequence[float | None], of_pupil: float
) -> Iterator[tuple[slice, list[NDArray[np.float64]]]]:
    """Yield rows of pixels, and where along an axis of the bins the light of each channel comes from, on the MLA."""
    px, down = camera.pixel_coordinates(0), camera.pixel_coordinates(1)
    height = max(1, _BLOCK // len(px))
    for first in range(0, len(down), height):
        p = px, down[first : first + height, None]
        cells = camera.lattice.cell(*(rays.chief_point(q, camera.mla_distance, camera.detector_distance) for q in p))
        found = [
            np.broadcast_arrays(*rays.follow_back(q, c, c, distance, camera))
            for q, c in zip(p, camera.lattice.centre(*cells), strict=True)
        ]
        P = np.broadcast_arrays(found[0][0], found[1][0])
        u = np.broadcast_to(found[axis][1], P[0].shape)
        places = []
        for light in lights:
            moved = 0.0 if light is None else PupilCentroid.of(camera, light)(*P)[axis] - P[axis]
            places.append(u + of_pupil * moved)
        yield slice(first, first + height), places


def displacements(
    tilted: Sequence[NDArray[np.float64]], slopes: Sequence[float], camera: PlenopticCamera, oversample: int
) -> list[NDArray[np.float64]]:
    """Return by how much the light of bins comes from beside them, along x and y.

    Parameters
    ----------
    tilted : two (rows, columns, channels) arrays
        What the bins read of scenes that rise to the right and downwards.
    slopes : two floats
        How steeply, per millimetre of the MLA plane.
    camera : PlenopticCamera
        The camera.
    oversample : int
        Bins per lens along each axis.

    Returns
    -------
    two (rows, columns, channels) float64 arrays
        In bins; 0 where nothing is read.
    """
    found = []
    for axis, (image, slope) in enumerate(zip(tilted, slopes, strict=True)):
        count = image.shape[1 - axis]
        own = (np.arange(count) - (count - 1) / 2).reshape((1, -1, 1) if axis == 0 else (-1, 1, 1))
        place = (image - 1) / slope * (oversample / camera.mla_pitch)
        farthest = _FARTHEST * oversample
        found.append(np.nan_to_num(place - own).clip(-farthest, farthest))
    return found


def brought_back(
    image: NDArray[np.float64], moved: Sequence[NDArray[np.float64]], weights: NDArray[np.float64], reach: int
) -> NDArray[np.float64]:
    """Return what an image reads at its bins, of one that reads beside them.

    Parameters
    ----------
    image : (rows, columns, channels) array
        The image; NaN where it reads nothing.
    moved : two (rows, columns, channels) arrays
        From `displacements`.
    weights : (rows, columns, channels) array
        Of the bins in the fits: the light that they get of white.
    reach : int
        Bins on each side of one that are fitted.

    Returns
    -------
    (rows, columns, channels) float64 array
    """
    known = np.isfinite(image)
    values, light = np.where(known, image, 0.0), np.where(known, weights, 0.0)
    rows, columns = image.shape[:2]
    terms = (
        moved[0] + (np.arange(columns) - columns / 2)[:, None],
        moved[1] + (np.arange(rows) - rows / 2)[:, None, None],
        values,
    )
    # Means over the bins about each one: of place and value, and of their products.
    mass = _mean_about(light, reach)
    mass = np.where(mass > 0, mass, 1)
    x, y, value = (_mean_about(light * term, reach) / mass for term in terms)

    def covariance(i: int, j: int, means: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(_mean_about(light * terms[i] * terms[j], reach) / mass - means)

    xx, xy, yy = covariance(0, 0, x * x), covariance(0, 1, x * y), covariance(1, 1, y * y)
    xv, yv = covariance(0, 2, x * value), covariance(1, 2, y * value)
    determinant = xx * yy - xy**2
    # A few bins in a line tell no plane.
    told = determinant > _LEAST_DETERMINANT
    safe = np.where(told, determinant, 1)
    across, down = (yy * xv - xy * yv) / safe, (xx * yv - xy * xv) / safe
    return np.where(told, image - moved[0] * across - moved[1] * down, image)


def _mean_about(image: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Return the mean over the square of bins about each one; what lies outside of the image is 0."""
    return np.asarray(scipy.ndimage.uniform_filter(image, 2 * reach + 1, mode="constant", axes=(0, 1)))
