r"""Conversion of sums over bins to radiance, by one rule for all methods and lattices.

A bin is divided by the light that it gets from a white scene by the same method: from a white capture of the camera if
there is one, or else from a computed white image. So a white scene reads 1 everywhere, also at the borders, where part
of the light misses the detector. A bin that gets less than 1 % of the rays of the best bin contains hardly any light,
and is NaN with every method. Between the footprints of lenses, fine bins may get little light in the wave model though
many rays reach them; the computed white is least accurate there, and the brightening by it is limited. A white capture
contains the true light of these bins, including interference, and shows the positions from which bins get their light;
the image is corrected for their displacements.

Displacement
------------
A bin gets light from around its position. By the microlenses' diffraction, light of one point of the pupil appears to
come from another. In the middle of the field this averages out, but at the border of the pupil or the detector the
light comes from one side only. If lenses interfere, the phases of their fields weight the positions from which light
comes. So, to first order, a bin at x that is divided by white reads a linear radiance at :math:`x + s`.

The displacement s is the first moment of white. In a scene whose radiance rises linearly along the plane of the bins,
the capture is the white capture times the radiance at the positions from which pixels get their light,
:math:`W (1 + \epsilon u)`. Refocused by the same method and divided by white it reads :math:`1 + \epsilon (x + s)`.
The position u of a pixel is the intersection of the bins' plane with the ray through the centre of its lens and the
centroid of the pixel's light in the pupil. With K, the spread of intensities over the pupil plane by diffraction, it is
:math:`K * (P \, A) / K * A` over the pupil A (Goodman, "Introduction to Fourier Optics", sections 4.4 and 5.2).

The image is then corrected to first order by the slope of a plane that is fitted to the bins around each bin, at the
positions from which they get their light (a local linear regression: Fan and Gijbels, "Local Polynomial Modelling and
Its Applications", section 3.1).
"""

from __future__ import annotations

import functools
import itertools
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar, cast

import numpy as np
import scipy
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint
from ..errors import refuse_if
from ..light.walk import follow_back
from ..optics import rays
from ..optics.waves import in_millimetres, soft_edge
from ..runtime.fft import blur, convolve
from ..runtime.limits import require_memory
from .methods import Progress, Task, portion

_PLANE = 8
"""Width of the plane in which the pupil is spread, in radii of the pupil."""

_LEAST_SAMPLES = 512


class PupilCentroid:
    """Centroid in the pupil of the light of a pixel, given the diffraction by its microlens."""

    def __init__(self, camera: PlenopticCamera, wavelength: float) -> None:
        window = _PLANE * camera.aperture_radius
        # Spatial frequencies over the pupil plane correspond to positions in the microlens.
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

    def __call__(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return the centroids in millimetres, along x and y, of pixels that see (x, y) through their lens's centre."""
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


_MOST_RESULTS = 32
"""Results of a camera that are remembered by each function."""

_F = TypeVar("_F", bound=Callable[..., Any])

_results: weakref.WeakKeyDictionary[PlenopticCamera, dict[str, dict[Any, Any]]] = weakref.WeakKeyDictionary()


def once_a_camera(function: _F) -> _F:
    """Cache a function's result for a camera as long as the camera lives; a decorator."""

    @functools.wraps(function)
    def known(camera: PlenopticCamera, *given: Any) -> Any:
        own = _results.setdefault(camera, {}).setdefault(function.__name__, {})
        if given not in own:
            if len(own) == _MOST_RESULTS:
                del own[next(iter(own))]
            own[given] = function(camera, *given)
        return own[given]

    return cast(_F, known)


def is_known(camera: PlenopticCamera) -> bool:
    """Return whether displacements are known: for unfocused cameras with thin lenses, whose pixels see pupil points."""
    return camera.lens_data.is_thin and focus_type(camera) == "unfocused"


def tilt(camera: PlenopticCamera, distance: float) -> tuple[float, float, float]:
    """Return the relative rise of radiance per millimetre of the MLA plane, 1 on the axis, of scenes made of white.

    Return also the farthest position on the bins that counts, and a pixel's displacement there per pupil displacement.
    """
    at_pupil, on_bins = follow_back(1.0, 0.0, 0.0, distance, camera)
    of_pupil = on_bins / at_pupil
    farthest = (max(camera.bin_count) / 2 + 1) * camera.mla_pitch + abs(of_pupil) * camera.lit_radius
    return _SLOPE / farthest, farthest, of_pupil


def tilted_whites(
    white: NDArray[np.float32],
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelengths: Sequence[float] | None,
) -> Iterator[tuple[float, NDArray[np.float32]]]:
    """Yield for each distance the captures of scenes whose radiance rises along the bins, to the right and downwards.

    They are computed from a white capture. The wavelengths in nanometres are those of the channels of a wave capture;
    None means a ray capture.
    """
    recorded = [None] * white.shape[2] if wavelengths is None else list(wavelengths)
    known = {light: PupilCentroid(camera, light) for light in recorded if light is not None}
    centroids = [None if light is None else known[light] for light in recorded]
    for distance, axis in itertools.product(distances, (0, 1)):
        slope, farthest, of_pupil = tilt(camera, distance)
        tilted = np.empty_like(white)
        for rows, positions in _places(camera, distance, axis, centroids, of_pupil):
            for channel, u in enumerate(positions):
                tilted[rows, :, channel] = white[rows, :, channel] * (1 + slope * u.clip(-farthest, farthest))
        yield distance, tilted


def _places(
    camera: PlenopticCamera, distance: float, axis: int, lights: Sequence[PupilCentroid | None], of_pupil: float
) -> Iterator[tuple[slice, list[NDArray[np.float64]]]]:
    """Yield rows of pixels, and the positions, along an axis of the MLA, from which each channel's light comes."""
    px, down = camera.pixel_coordinates(0), camera.pixel_coordinates(1)
    height = max(1, _BLOCK // len(px))
    for first in range(0, len(down), height):
        p = px, down[first : first + height, None]
        cells = camera.lattice.cell(*(rays.chief_point(q, camera.mla_distance, camera.reduced_distance) for q in p))
        found = [
            np.broadcast_arrays(*follow_back(q, c, c, distance, camera))
            for q, c in zip(p, camera.lattice.centre(*cells), strict=True)
        ]
        P = np.broadcast_arrays(found[0][0], found[1][0])
        u = np.broadcast_to(found[axis][1], P[0].shape)
        positions = []
        for light in lights:
            moved = 0.0 if light is None else light(*P)[axis] - P[axis]
            positions.append(u + of_pupil * moved)
        yield slice(first, first + height), positions


def displacements(
    tilted: Sequence[NDArray[np.float64]], slope: float, camera: PlenopticCamera, oversample: int
) -> list[NDArray[np.float64]]:
    """Return the displacements, in bins, from which the light of bins comes, along x and y; 0 where nothing is read."""
    found = []
    for axis, image in enumerate(tilted):
        count = image.shape[1 - axis]
        own = (np.arange(count) - (count - 1) / 2).reshape((1, -1, 1) if axis == 0 else (-1, 1, 1))
        position = (image - 1) / slope * (oversample / camera.mla_pitch)
        farthest = _FARTHEST * oversample
        found.append(np.nan_to_num(position - own).clip(-farthest, farthest))
    return found


def brought_back(
    image: NDArray[np.float64], moved: Sequence[NDArray[np.float64]], weights: NDArray[np.float64], reach: int
) -> NDArray[np.float64]:
    """Return an image drawn back by the displacements of its bins, by weighted fits to `reach` bins on each side."""
    known = np.isfinite(image)
    values, light = np.where(known, image, 0.0), np.where(known, weights, 0.0)
    rows, columns = image.shape[:2]
    terms = (
        moved[0] + (np.arange(columns) - columns / 2)[:, None],
        moved[1] + (np.arange(rows) - rows / 2)[:, None, None],
        values,
    )
    # Means over the bins around each bin: of position and value, and of their products.
    mass = _mean_about(light, reach)
    mass = np.where(mass > 0, mass, 1)
    x, y, value = (_mean_about(light * term, reach) / mass for term in terms)

    def covariance(i: int, j: int, means: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(_mean_about(light * terms[i] * terms[j], reach) / mass - means)

    xx, xy, yy = covariance(0, 0, x * x), covariance(0, 1, x * y), covariance(1, 1, y * y)
    xv, yv = covariance(0, 2, x * value), covariance(1, 2, y * value)
    determinant = xx * yy - xy**2
    # A few bins in a line determine no plane.
    known_plane = determinant > _LEAST_DETERMINANT
    safe = np.where(known_plane, determinant, 1)
    across, down = (yy * xv - xy * yv) / safe, (xx * yv - xy * xv) / safe
    return np.where(known_plane, image - moved[0] * across - moved[1] * down, image)


def _mean_about(image: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Return the mean over the square of bins about each one; what lies outside of the image is 0."""
    return np.asarray(scipy.ndimage.uniform_filter(image, 2 * reach + 1, mode="constant", axes=(0, 1)))


_LEAST_REACHED = 0.01

_LEAST_WHITE = 0.25
"""Fraction of the light that as many rays usually bring, as which no bin's computed white counts less."""


def captures(task: Task) -> Iterator[tuple[np.ndarray, Sequence[float], Progress]]:
    """Yield the images that a method sums over bins, (rows, columns, channels), with their distances and progress.

    That is the capture and, where there is one, the white capture; where displacements are known, too, for every
    distance two that are made of it.
    """
    work = [(task.image, task.distances)] + ([] if task.white is None else [(task.white, task.distances)])
    tilted: Iterator[tuple[float, np.ndarray]] = iter(())
    # The ways to the main lens and from there to a plane take about equally long.
    works = [1 + len(distances) for _, distances in work]
    if task.white is not None and is_known(task.camera):
        works += [2] * (2 * len(task.distances))
        tilted = tilted_whites(task.white, task.camera, task.distances, task.recorded)
    made = itertools.chain(work, ((image, [distance]) for distance, image in tilted))
    for done, (image, distances) in enumerate(made):
        yield image, distances, portion(task.progress, done, works)


def to_radiance(
    task: Task, sums: Sequence[Sequence[np.ndarray]], white: Sequence[np.ndarray], reach: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return sums of a capture over bins, divided by the sums of white; NaN where no light can come from.

    Parameters
    ----------
    task : Task
        With the white capture if there is one.
    sums : sequence of sequences of (rows, columns, channels) arrays
        For each of the `captures` of the task the sums over bins at its distances.
    white : sequence of arrays (rows, columns) or (rows, columns, channels)
        Sums over bins of the computed white image, for every distance; ignored if there is a white capture.
    reach : sequence of (rows, columns) arrays
        Pixels of white whose rays reach the bins, for every distance.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance.
    """
    light, *others = sums
    whites = white if task.white is None else others.pop(0)
    images = []
    for index, (distance, total, divisor, hits) in enumerate(zip(task.distances, light, whites, reach, strict=True)):
        divisor, reached = divisors(divisor, hits, distance, computed=task.white is None)
        image = _divided(total, divisor, reached)
        if others:
            rising = [_divided(found, divisor, reached) for (found,) in others[2 * index : 2 * index + 2]]
            moved = displacements(rising, tilt(task.camera, distance)[0], task.camera, task.oversample)
            image = brought_back(image, moved, np.broadcast_to(divisor, image.shape), task.oversample)
        images.append(image.astype(np.float32, copy=False))
    return images


def _divided(total: np.ndarray, divisor: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Return the reached bins divided by the divisor, NaN elsewhere."""
    image = np.full(total.shape, np.nan, np.float32)
    np.divide(total, divisor, out=image, where=np.broadcast_to(reached, total.shape), casting="same_kind")
    return image


def divisors(white: np.ndarray, rays: np.ndarray, distance: float, *, computed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the divisors of a plane's sums over bins, and a mask of the bins that are divided."""
    white = np.atleast_3d(white)
    reached = is_reached(rays)[..., None] & (white > 0)
    refuse_if(not reached.any(), f"distance = {distance:g}: no light comes from any of the {rays.size} bins there")
    if computed:
        # Both sums are of all bins, since light that misses one of them is in another.
        usual = white.sum() / (float(rays.sum()) * white.shape[2])
        white = np.maximum(white, _LEAST_WHITE * usual * rays[..., None])
    return white, reached


def is_reached(rays: np.ndarray) -> np.ndarray:
    """Return a mask (rows, columns) of bins with enough rays of white for a division."""
    return np.asarray((rays >= _LEAST_REACHED * rays.max()) & (rays > 0))


def lens_scale(camera: PlenopticCamera, distance: float) -> float:
    """Part of a lens over which its light is spread: all for an unfocused one, none where a focused one is sharp."""
    if focus_type(camera) == "unfocused":
        return 1.0
    return min(lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths)


class LensSpread:
    """The spread of the light of each lens over its aperture, enlarged by `scale`, and the sum of fine bins to bins.

    A lens has gathered light over its aperture. Where a lens lies on every bin spreading it would change nothing in
    focus; elsewhere the light of all of a lens would go to the one bin that holds its centre, and some bins would get
    none.
    """

    def __init__(self, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0) -> None:
        self._aperture = camera.lattice.aperture_image(camera.mla_pitch / (oversample * fine), scale)
        self._fine = fine

    def forward(self, power: np.ndarray) -> np.ndarray:
        """Spread the power of fine bins, and sum it to bins."""
        rows, columns = (size // self._fine for size in power.shape)
        return blur(power, self._aperture).reshape(rows, self._fine, columns, self._fine).sum((1, 3))

    def vjp(self, bins: np.ndarray) -> np.ndarray:
        """Return the transpose of `forward`, applied to bins."""
        fine = bins.repeat(self._fine, 0).repeat(self._fine, 1)
        whole = convolve(fine, self._aperture[::-1, ::-1])
        rows, columns = (k - 1 - (k - 1) // 2 for k in self._aperture.shape)
        return whole[rows : rows + fine.shape[0], columns : columns + fine.shape[1]]


def over_lenses(
    power: np.ndarray, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0
) -> np.ndarray:
    """Return fine bins spread over lenses, without negative rounding errors of the transform."""
    return LensSpread(camera, oversample, fine, scale).forward(power).clip(min=0)
