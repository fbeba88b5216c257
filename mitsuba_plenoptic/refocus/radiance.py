r"""Conversion of sums over bins to radiance, by one rule for all methods and lattices.

A bin is divided by the light that it receives from a white scene by the same method: from a white capture of the camera
if there is one, otherwise from the computed white capture by the capture's model of light. So a white scene reads 1
everywhere, also at the borders, where part of the light misses the detector, and where waves cancel. A bin that
receives less than 1 % of the rays of the best bin contains hardly any light, and is NaN with every method. A given
white also shows the positions from which bins receive their light; the image is corrected for their displacements.
"""

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from ..camera import PlenopticCamera, once_a_camera
from ..design import focus_type, lens_footprint
from ..errors import InputError, refuse_if, short_repr
from ..io import Capture, digest
from ..runtime import Array, fft
from ..views import capture_white, recorded_white, wave_white
from ..views import white_pixels as white_pixels
from .displacement import brought_back, displacements, is_known, rising, tilt
from .methods import Progress, Task, portion
from .projection import ray_sums
from .straight import straightened_image

_log = logging.getLogger(__name__)


def as_reference(
    white: Capture | Array, capture: Capture, tilted: PlenopticCamera, recorded: Any, as_recorded: bool
) -> Array:
    """Return a recorded white image, scaled to a radiance of 1, with the channels of the capture to be divided.

    For a method that takes captures `as_recorded` it is neither straightened nor scaled. Refused is a white wave
    capture that lost another part of the light at the edges of its micro-images. The camera of white must be the
    capture's before it was straightened, `tilted`, or that with which the capture was `recorded`.
    """
    image = np.atleast_3d(capture.image)
    cameras = [tilted, *([recorded.camera] if isinstance(recorded, Capture) else [])]
    pixels = recorded_white(white, image.shape, cameras)
    if isinstance(white, Capture):
        refuse_if(
            white.model == "wave" and capture.model != "wave",
            "white: it was captured by waves, and the capture by rays, which lose no light at edges",
        )
        theirs, ours = (
            None if one.wavelength is None else np.broadcast_to(one.wavelength, image.shape[2])
            for one in (white, capture)
        )
        refuse_if(
            theirs is not None and ours is not None and not np.array_equal(theirs, ours),
            f"white of {short_repr(white.wavelength)} nm: the capture is of {short_repr(capture.wavelength)} nm; "
            "it must be of the same wavelengths",
        )
    if as_recorded:
        return np.ascontiguousarray(np.broadcast_to(pixels, image.shape))
    pixels = straightened_image(pixels, tilted)
    by_model = replace(white if isinstance(white, Capture) else capture, camera=tilted)
    expected = computed_white(by_model, lambda done: None).mean(-1)
    scaled = recorded_white(pixels, pixels.shape, [capture.camera], expected)
    return np.ascontiguousarray(np.broadcast_to(scaled, image.shape))


def captures(task: Task) -> Iterator[tuple[Array, Sequence[float], Progress]]:
    """Yield the images that a method sums over bins, (rows, columns, channels), with distances and progress.

    They are the capture, the white capture, given or computed, if there is one and, if displacements are known by a
    given one, two images made from it for every distance.
    """
    white = task.computed if task.white is None else task.white
    pictures = [task.image] if white is None else [task.image, white]
    # The ways to the main lens and from there to a plane take about equally long.
    works = [1 + len(task.distances)] * len(pictures)
    pairs: Iterator[tuple[Array, Sequence[float]]] = ((image, task.distances) for image in pictures)
    if task.white is not None and is_known(task.camera):
        works += [2] * (2 * len(task.distances))
        pairs = itertools.chain(pairs, rising(task.white, task.camera, task.distances, task.recorded))
    for done, (image, distances) in enumerate(pairs):
        yield image, distances, portion(task.progress, done, works)


@once_a_camera
def _sums_of_white(camera: PlenopticCamera, *key: Any, make: Callable[[], list[Array]]) -> list[Array]:
    """Return the sums over bins of a computed white image, made once for each key of what they depend on."""
    return make()


def divided_by_white(
    task: Task,
    sums_of: Callable[[Array, Sequence[float], Progress], list[Array]],
    radius: float,
    footprint: str,
    *key: Any,
) -> list[Array]:
    """Return a method's images of a task, as radiance.

    `sums_of` an image, distances and a progress callback are the method's sums over bins; `radius` and `footprint` are
    of the rays by which bins are lit, see `ray_sums`. Sums of a computed white image are kept by the method's name and
    options, `key`.
    """
    sums = []
    for index, (image, distances, progress) in enumerate(captures(task)):
        make = partial(sums_of, image, distances, progress)
        if index and task.white is None:
            facts = digest(image), tuple(distances), task.oversample, *key
            sums.append(_sums_of_white(task.camera, *facts, make=make))
            progress(1.0)
        else:
            sums.append(make())
    lit = [white_sums(task.camera, g, radius, footprint, task.oversample) for g in task.distances]
    if task.passed is not None:
        pixels = (white_pixels(task.camera) * task.passed)[..., None]
        lit = [ray_sums(pixels, task.camera, g, radius, footprint, task.oversample)[..., 0] for g in task.distances]
    return to_radiance(task, sums, (), lit)


def to_radiance(
    task: Task, sums: Sequence[Sequence[Array]], white: Sequence[Array], reach: Sequence[Array]
) -> list[Array]:
    """Return a capture's sums over bins, divided by the sums of white; NaN where no light can come from.

    Parameters
    ----------
    task : Task
        With the white capture if there is one.
    sums : sequence of sequences of (rows, columns, channels) arrays
        For each of the `captures` of the task the sums over bins at its distances.
    white : sequence of arrays (rows, columns) or (rows, columns, channels)
        Sums over bins of white, for every distance, if it is not among the captures; else ignored.
    reach : sequence of (rows, columns) arrays
        Pixels of white whose rays reach the bins, for every distance.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance.
    """
    light, *others = sums
    whites = others.pop(0) if others else white
    images = []
    for index, (distance, total, divisor, hits) in enumerate(zip(task.distances, light, whites, reach, strict=True)):
        divisor = np.atleast_3d(divisor)
        weak = WeakBins(divisor, hits[..., None], task.oversample)
        divisor = weak.shared(divisor)
        reached = divided_bins(divisor, hits[..., None], distance)
        image = _divided(weak.shared(total), divisor, reached)
        if others:
            pairs = others[2 * index : 2 * index + 2]
            rising = [_divided(weak.shared(quantity), divisor, reached) for (quantity,) in pairs]
            moved = displacements(rising, tilt(task.camera, distance)[0], task.camera, task.oversample)
            image = brought_back(image, moved, np.broadcast_to(divisor, image.shape), task.oversample)
        images.append(image.astype(np.float32, copy=False))
    return images


def _divided(total: Array, divisor: Array, reached: Array) -> Array:
    """Return the reached bins divided by the divisor, NaN elsewhere."""
    image = np.full(total.shape, np.nan, np.float32)
    np.divide(total, divisor, out=image, where=np.broadcast_to(reached, total.shape), casting="same_kind")
    return image


class WeakBins:
    """Bins that waves hardly reach, as fine ones beside the spots of a focused camera's lenses, in one plane.

    The division by white would amplify their light. They share sums with the bins around them, over one lens.
    """

    def __init__(self, white: Array, rays: Array, oversample: int):
        """Find bins of less than a quarter of the white that as many rays bring around them."""
        self._lens = oversample // 2 * 2 + 1
        self._weak = white * self._around(rays) < 0.25 * rays * self._around(white)

    def _around(self, sums: Array) -> Array:
        return uniform_filter(sums, self._lens, mode="constant", axes=(0, 1))

    def shared(self, sums: Array) -> Array:
        """Return sums (rows, columns, ...), in weak bins the mean around them."""
        return np.where(self._weak, self._around(sums), sums)

    def shared_vjp(self, bins: Array) -> Array:
        """Return the transpose of `shared`, applied to bins (rows, columns, ...)."""
        return np.where(self._weak, 0, bins) + self._around(np.where(self._weak, bins, 0))


def divided_bins(white: Array, rays: Array, distance: float) -> Array:
    """Return a mask of the bins whose sums are divided by the sums of white."""
    # Bins that few rays of white reach are too noisy for a division.
    reached = (rays >= 0.01 * rays.max()) & (rays > 0) & (white > 0)
    refuse_if(not reached.any(), f"distance = {distance:g}: no light comes from any of the {rays.size} bins there")
    return reached


def lens_scale(camera: PlenopticCamera, distance: float) -> float:
    """Fraction of a lens over which its light is spread: 0 where it is blurred over one or a focused camera is sharp.

    Blurred light reaches all bins by itself. Bins behind a distorting lens are resampled, and light is spread there.
    """
    if focus_type(camera) == "unfocused":
        resampled = camera.lens_data.traced_surfaces
        return 1.0 if resampled else max(0.0, 1.0 - camera.blur_diameter(distance) / max(camera.mla_pitches))
    return min(lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths)


class LensSpread:
    """Spread of each lens's light over its aperture, enlarged by `scale`, and summation of fine bins.

    A lens has gathered light over its aperture. If bins coincide with lenses, spreading changes nothing in focus;
    otherwise all light of a lens would go to the bin that contains its centre, and some bins would receive none.
    """

    def __init__(self, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0):
        self._aperture = camera.lattice.aperture_image(camera.row_pitch / (oversample * fine), scale)
        self._fine = fine

    def forward(self, power: Array) -> Array:
        """Return bins: the power of fine bins, spread over lenses and summed."""
        rows, columns = (size // self._fine for size in power.shape)
        return fft.blur(power, self._aperture).reshape(rows, self._fine, columns, self._fine).sum((1, 3))

    def vjp(self, bins: Array) -> Array:
        """Return the transpose of `forward`, applied to bins."""
        fine = bins.repeat(self._fine, 0).repeat(self._fine, 1)
        convolved = fft.convolve(fine, self._aperture[::-1, ::-1])
        rows, columns = (k - 1 - (k - 1) // 2 for k in self._aperture.shape)
        return convolved[rows : rows + fine.shape[0], columns : columns + fine.shape[1]]


def over_lenses(power: Array, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0) -> Array:
    """Return fine bins spread over lenses, without negative rounding errors of the transform."""
    return LensSpread(camera, oversample, fine, scale).forward(power).clip(min=0)


def computed_white(capture: Capture, progress: Progress) -> Array:
    """Return the computed white image of a capture's model, straightened like the capture, with as many channels."""
    channels = np.atleast_3d(capture.image).shape[2]
    white = capture_white(capture, channels, lambda done, total: progress(done / total))
    white = straightened_image(white, capture.camera)
    return np.ascontiguousarray(np.broadcast_to(white, (*white.shape[:2], channels)))


def white_of_response(capture: Capture, progress: Progress) -> Array | None:
    """Return the white image by which responses by waves are corrected, as recorded, with a capture's channels.

    It is None, and responses serve as they are, where signed rays do not compute captures, as those of points.
    """
    channels = np.atleast_3d(capture.image).shape[2]
    try:
        white = wave_white(capture, channels, lambda done, total: progress(done / total))
    except InputError as error:
        _log.info("responses are not corrected by a white image: %s", error)
        return None
    return np.ascontiguousarray(np.broadcast_to(white, (*white.shape[:2], channels)))


@once_a_camera
def white_sums(camera: PlenopticCamera, distance: float, radius: float, footprint: str, oversample: int) -> Array:
    """Return the light of a scene of uniform radiance 1 in each bin by rays, in pixel values times pixels.

    It is `ray_sums` of the camera's white capture, with the same parameters: (rows, columns), float64.
    """
    white = white_pixels(camera)[..., None]
    return ray_sums(white, camera, distance, radius, footprint, oversample)[..., 0].astype(np.float64)
