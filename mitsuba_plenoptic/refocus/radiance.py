r"""Conversion of sums over bins to radiance, by one rule for all methods and lattices.

A bin is divided by the light that it receives from a white scene by the same method: from a white capture of the camera
if there is one, otherwise from a computed white image. So a white scene reads 1 everywhere, also at the borders, where
part of the light misses the detector. A bin that receives less than 1 % of the rays of the best bin contains hardly any
light, and is NaN with every method. Between the footprints of lenses, fine bins may receive little light in the wave
model though many rays reach them; the computed white is least accurate there, and its brightening effect is limited. A
white capture contains the true light of these bins, including interference, and shows the positions from which bins
receive their light; the image is corrected for their displacements.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint
from ..detector import SHARP, DetectorOperator
from ..errors import MOST_PIXELS, refuse_if, short_repr
from ..fields import OpticalSystem
from ..io import Capture
from ..optics import rays, soft_edge
from ..rays import follow_back
from ..runtime import active_backend, check_memory, fft, single_threaded_blas
from ..views import PupilFraction, mean_response, recorded_white, white_image
from .conjugates import RealConjugates, ThinConjugates
from .displacement import brought_back, displacements, is_known, rising, tilt
from .lens_by_lens import (
    LensSet,
    LensTile,
    object_patches,
    on_bins,
    passing_power,
    pupil_fields,
    tile_lenses,
)
from .methods import Progress, Task, once_a_camera, portion
from .projection import ray_sums
from .splatting import thin_places
from .straight import passed_light, straightened_image

_LEAST_REACHED = 0.01

_INNER = 0.99
"""Light of a pixel of a white scene, over the most, below which the pixel is at the rim of its micro-image."""

_LEAST_WHITE = 0.25
"""Fraction of the light that as many rays usually bring, as which no bin's computed white counts less."""


def as_reference(
    white: Capture | np.ndarray, capture: Capture, tilted: PlenopticCamera, recorded: Any, as_recorded: bool
) -> np.ndarray:
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
    expected = white_pixels(capture.camera)
    passed = passed_light(tilted)
    expected = expected if passed is None else expected * passed
    scaled = recorded_white(pixels, pixels.shape, [capture.camera], expected)
    return np.ascontiguousarray(np.broadcast_to(scaled, image.shape))


def captures(task: Task) -> Iterator[tuple[np.ndarray, Sequence[float], Progress]]:
    """Yield the images that a method sums over bins, (rows, columns, channels), with distances and progress.

    They are the capture, the white capture if there is one and, if displacements are known, two images made from the
    white capture for every distance.
    """
    pictures = [task.image] if task.white is None else [task.image, task.white]
    # The ways to the main lens and from there to a plane take about equally long.
    works = [1 + len(task.distances)] * len(pictures)
    pairs: Iterator[tuple[np.ndarray, Sequence[float]]] = ((image, task.distances) for image in pictures)
    if task.white is not None and is_known(task.camera):
        works += [2] * (2 * len(task.distances))
        pairs = itertools.chain(pairs, rising(task.white, task.camera, task.distances, task.recorded))
    for done, (image, distances) in enumerate(pairs):
        yield image, distances, portion(task.progress, done, works)


def to_radiance(
    task: Task, sums: Sequence[Sequence[np.ndarray]], white: Sequence[np.ndarray], reach: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return a capture's sums over bins, divided by the sums of white; NaN where no light can come from.

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
            rising = [_divided(quantity, divisor, reached) for (quantity,) in others[2 * index : 2 * index + 2]]
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
    """Return the divisors of a plane's sums over bins, and a mask of the bins to be divided."""
    white = np.atleast_3d(white)
    reached = is_reached(rays)[..., None] & (white > 0)
    refuse_if(not reached.any(), f"distance = {distance:g}: no light comes from any of the {rays.size} bins there")
    if computed:
        # Both sums are of all bins, since light that misses one of them is in another.
        usual = white.sum() / (float(rays.sum()) * white.shape[2])
        white = np.maximum(white, _LEAST_WHITE * usual * rays[..., None])
    return white, reached


def is_reached(rays: np.ndarray) -> np.ndarray:
    """Return a mask (rows, columns) of bins that enough rays of white reach for a division."""
    return np.asarray((rays >= _LEAST_REACHED * rays.max()) & (rays > 0))


def lens_scale(camera: PlenopticCamera, distance: float) -> float:
    """Fraction of a lens over which its light is spread: 1 for unfocused cameras, 0 where a focused camera is sharp."""
    if focus_type(camera) == "unfocused":
        return 1.0
    return min(lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths)


class LensSpread:
    """Spread of each lens's light over its aperture, enlarged by `scale`, and summation of fine bins.

    A lens has gathered light over its aperture. If bins coincide with lenses, spreading changes nothing in focus;
    otherwise all light of a lens would go to the bin that contains its centre, and some bins would receive none.
    """

    def __init__(self, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0) -> None:
        self._aperture = camera.lattice.aperture_image(camera.row_pitch / (oversample * fine), scale)
        self._fine = fine

    def forward(self, power: np.ndarray) -> np.ndarray:
        """Return bins: the power of fine bins, spread over lenses and summed."""
        rows, columns = (size // self._fine for size in power.shape)
        return fft.blur(power, self._aperture).reshape(rows, self._fine, columns, self._fine).sum((1, 3))

    def vjp(self, bins: np.ndarray) -> np.ndarray:
        """Return the transpose of `forward`, applied to bins."""
        fine = bins.repeat(self._fine, 0).repeat(self._fine, 1)
        convolved = fft.convolve(fine, self._aperture[::-1, ::-1])
        rows, columns = (k - 1 - (k - 1) // 2 for k in self._aperture.shape)
        return convolved[rows : rows + fine.shape[0], columns : columns + fine.shape[1]]


def over_lenses(
    power: np.ndarray, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0
) -> np.ndarray:
    """Return fine bins spread over lenses, without negative rounding errors of the transform."""
    return LensSpread(camera, oversample, fine, scale).forward(power).clip(min=0)


_THROUGHPUT_LENSES = 25

_HEIGHTS = 17
"""Lenses behind a real main lens of which the throughput is found."""

_WHOLE = 0.2
"""Light of such a lens over that of the brightest, at least."""

_RAY_BINS = 36
"""Fine bins across a lens in which the rays of a white scene are counted, where they are not too many."""

_PIXEL_PARTS = 4
"""Parts of a pixel along an axis, at least: of whole pixels, ten across a lens, some rows of lenses have 1 % more."""

_MOST_RAY_BINS = 2**26


white_pixels = once_a_camera(white_image)


def light_of_bins(
    task: Task, distance: float, radius: float, footprint: str, wavelength: float | None = None, relay: bool = True
) -> np.ndarray:
    """Return the `white_sums` of a task's camera, less the light that its pixels have lost.

    Pixels lose light by vignetting, absorption and their response to oblique light.
    """
    given = task.camera, distance, radius, footprint, task.oversample
    white = white_sums(*given) if wavelength is None else white_sums(*given, wavelength, relay)
    if task.camera.pixel_response or task.camera.mla_absorption:
        white = white * mean_response(task.camera)
    if task.passed is None:
        return white
    pixels = white_pixels(task.camera)
    even = white_sums(*given)
    left = ray_sums((pixels * task.passed)[..., None], *given)[..., 0]
    # Of waves the pupil takes light at the rims of micro-images. An outline within them, which keeps out the rims,
    # loses about half as much: images of white read 0.99 to 1.02 with this factor, 0.96 to 1.07 with 0 and 1.
    rim = (pixels > 0) & (pixels < _INNER * pixels.max())
    kept = float(task.passed[rim].mean()) if rim.any() else 1.0
    lost = np.where(even > 0, even - white, 0) * (1 + kept) / 2
    return (even - lost) * (left / np.where(even > 0, even, 1))


@once_a_camera
def white_sums(
    camera: PlenopticCamera,
    distance: float,
    radius: float,
    footprint: str,
    oversample: int,
    wavelength: float | None = None,
    relay: bool = True,
) -> np.ndarray:
    """Return the light of a scene of uniform radiance 1 in each bin, in pixel values times pixels: a method's divisor.

    By rays the divisor is `ray_sums` of the camera's white capture. By waves no two lenses interfere, as interference
    cancels in the mean over the bins: it is the light of rays, less the part of a micro-image that the pupil blocks.

    Parameters
    ----------
    camera, distance, radius, footprint, oversample
        As in `ray_sums`.
    wavelength : float, optional
        Wavelength in nanometres; None: by rays.
    relay : bool
        Whether the microlenses of a wave act a second time, see `reconstruct`.

    Returns
    -------
    (rows, columns) float64 array
    """
    if wavelength is None:
        white = white_pixels(camera)[..., None]
        return ray_sums(white, camera, distance, radius, footprint, oversample)[..., 0].astype(np.float64)
    is_focused = focus_type(camera) != "unfocused"
    if camera.lens_data.traced_surfaces:
        positions, throughput = _traced_throughput(camera, wavelength, distance, relay)
        x, y = (
            (np.arange(count * oversample) - (count * oversample - 1) / 2) * (camera.row_pitch / oversample)
            for count in camera.bin_count
        )
        share: Any = np.interp(np.hypot(x, y[:, None]), positions, throughput)
    elif camera.lenses_are_bins and is_focused:
        return _lens_patches(camera, wavelength, distance, relay, oversample)
    else:
        share = _throughput(camera, wavelength, relay)
    if camera.lens_data.traced_surfaces or camera.lenses_like_bins or is_focused:
        return white_sums(camera, distance, radius, footprint, oversample) * share
    return _spread_rays(camera, distance, oversample) * share


@once_a_camera
def _spread_rays(camera: PlenopticCamera, distance: float, oversample: int) -> np.ndarray:
    """Return the number of white pixels whose rays come to each bin, spread over lenses like the light of waves.

    A ray must pass at least half a pixel inside the pupil: a smooth wave returns through the lens's centre alone. Light
    of waves comes from all of a pixel, through the lens of each part, and pixels of fast cameras have images as wide as
    several lenses: pixels are split into parts whose images are no wider than a lens.
    """
    # Rays go to points, where waves go to spots: the grid on which they are counted must not show.
    bins = math.prod(camera.bin_count) * oversample**2
    fine = max(1, min(-(-_RAY_BINS // oversample), math.isqrt(_MOST_RAY_BINS // bins)))
    _, image = follow_back(camera.pixel_size, 0.0, 0.0, distance, camera)
    most = min(math.isqrt(_MOST_RAY_BINS // math.prod(camera.shape)), MOST_PIXELS // max(camera.resolution))
    parts = max(1, min(max(_PIXEL_PARTS, math.ceil(abs(float(image)) / camera.row_pitch)), most))
    split = camera.replace(
        resolution=tuple(parts * size for size in camera.resolution),
        crop_offset=tuple(parts * size for size in camera.crop_offset),
        crop_size=None if camera.crop_size is None else tuple(parts * size for size in camera.crop_size),
    )
    white = white_pixels(camera) / parts**2
    across, down = (count * oversample * fine + 2 for count in camera.bin_count)
    counted = np.zeros(down * across)
    for block, *position, is_lit in thin_places(split, distance, camera.lit_radius):
        lit = np.flatnonzero(is_lit)
        # Divided among the four samples around, as lenses, whose borders would show else, lie between samples.
        places = [
            values[lit] * (oversample * fine / camera.row_pitch) + (size - 1) / 2
            for values, size in zip(position, (across, down), strict=True)
        ]
        (column, x), (row, y) = ((np.floor(values), values - np.floor(values)) for values in places)
        inside = np.flatnonzero((column >= 0) & (column < across - 1) & (row >= 0) & (row < down - 1))
        light = white[np.arange(block.start, block.stop) // parts].repeat(parts, 1).ravel()[lit][inside]
        x = x[inside]
        y = y[inside]
        corner = (row * across + column)[inside].astype(np.int64)
        start = int(corner.min(initial=counted.size))
        for below, right in np.ndindex(2, 2):
            added = np.bincount(corner - start, light * abs(1 - below - y) * abs(1 - right - x))
            first = start + below * across + right
            counted[first : first + added.size] += added
    counted = counted.reshape(down, across)[1:-1, 1:-1]
    return over_lenses(counted, camera, oversample, fine, lens_scale(camera, distance))


@once_a_camera
@single_threaded_blas()  # the bits are the same with any thread count
def _throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> float:
    """Return the fraction of a white micro-image's power that comes back through the main lens.

    A micro-image's edge is an image of the pupil's edge, where light diffracts out: 7 % for the paper's camera. Only
    pixels whose own ray passes the main lens count.
    """
    around = _around_axis(camera, 2 if camera.lenses_are_bins else 3)
    tile = LensTile(around, wavelength, _THROUGHPUT_LENSES, 1)
    arrays = active_backend().arrays
    check_memory(tile.memory, "wave reconstruction of a white micro-image")
    lenses = LensSet(tile)
    inside = soft_edge((camera.aperture_radius - np.hypot(tile.pupil, tile.pupil[:, None])) / tile.pupil_pitch)
    back = sent = 0.0
    i, j = around.lattice.cell(0.0, 0.0)
    # Among the lenses next to the axis there is one of every type.
    for step in range(len(camera.mla_focal_lengths)):
        image, visible = _micro_image(around, (i + step, j))
        sent += float(image[visible <= camera.lit_radius].sum()) * camera.pixel_size**2
        which = np.array([lenses.find(i + step, j)])
        light, samples = lenses.on_array(arrays.asarray(np.sqrt(image).astype(np.float32)), which)
        (field,) = pupil_fields(light, tile, lenses.batch(which, samples), relay=relay)
        back += float((abs(field) ** 2 * arrays.asarray(inside)).sum()) * tile.pupil_pitch**2
    refuse_if(
        not min(back, sent) > 0,
        f"aperture_radius = {camera.aperture_radius:g}: its micro-images of "
        f"{camera.micro_image_diameter / camera.pixel_size:.2g} pixels light no pixel near the axis, so that "
        "no white can be computed for waves",
    )
    return back / sent


@once_a_camera
@single_threaded_blas()
def _traced_throughput(
    camera: PlenopticCamera, wavelength: float, distance: float, relay: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return `_throughput` for some lenses behind a real main lens, by their distance from the axis.

    Micro-images cut by the lens have more edge for their area, and lose more light.
    """
    conjugates = RealConjugates.of(OpticalSystem(camera, wavelength), [distance], 1)
    tile = LensTile(conjugates.camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of white micro-images")
    white = white_pixels(camera)
    lenses = LensSet(tile)
    libraries = active_backend()
    # Rays bring no light back from beyond the sharp micro-images.
    counted = np.where(white_pixels(camera.replace(**SHARP)) > 0, white, 0)
    lit = lenses.lit(white)
    order = np.argsort(np.hypot(*lenses.centre[lit].T), kind="stable")
    chosen = order[np.unique(np.linspace(0, len(order) - 1, _HEIGHTS).round().astype(int))]
    amplitude = libraries.arrays.asarray(np.sqrt(white))
    throughputs = []
    for number in chosen:
        which = lit[number : number + 1]
        light, samples = lenses.on_array(amplitude, which)
        batch = lenses.batch(which, samples)
        fields = pupil_fields(light, tile, batch, relay=relay)
        sent = lenses.light_of(counted, which[0])
        passed = passing_power(fields, tile, batch, conjugates.distance(distance), conjugates)
        if sent > 0:
            throughputs.append((float(np.hypot(*batch.centre[0])), passed / (sent * camera.pixel_size**2), sent))
    positions, shares, light = np.array(throughputs).T
    # Lenses whose micro-images are recorded in small part only say little.
    full = light > _WHOLE * light.max()
    return positions[full], shares[full]


@single_threaded_blas()
def _lens_patches(
    camera: PlenopticCamera, wavelength: float, distance: float, relay: bool, oversample: int
) -> np.ndarray:
    """Return the power in each bin from a white scene, for an aligned lattice of lenses that do not interfere.

    For a focused camera the bins of a lens overlap with those of a few others. Light from the rim of its micro-image,
    which came through part of the lens from within the pupil, returns as if through the lens's centre and misses the
    pupil. So some bins receive more light than others. All lenses are treated like the one next to the axis.
    """
    around = _around_axis(camera, 2)
    count = tile_lenses(camera, [distance])
    libraries = active_backend()
    lenses = LensSet(LensTile(around, wavelength, count, oversample))
    which = np.array([lenses.find(0, 0)])
    amplitude = libraries.arrays.asarray(np.sqrt(_micro_image(around, (0, 0))[0]).astype(np.float32))
    light, step = lenses.on_array(amplitude, which)
    batch = lenses.batch(which, step)
    fields = pupil_fields(light, lenses.tile, batch, relay=relay)
    thin = ThinConjugates(OpticalSystem(around, wavelength))
    patch = libraries.to_host(object_patches(fields, lenses.tile, batch, distance, thin)[0]).astype(np.float64)
    everywhere = LensSet(LensTile(camera, wavelength, count, oversample))
    samples = everywhere.tile.samples
    comb = np.zeros([(count - 1) * samples + 1 for count in everywhere.bins[::-1]])
    column, row = everywhere.bin[everywhere.lit(np.ones(camera.shape, bool))].T
    comb[row * samples, column * samples] = 1
    return on_bins(libraries.arrays.asarray(fft.convolve(comb, patch)), everywhere)


def _micro_image(camera: PlenopticCamera, index: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return one lens's white micro-image, and the radius in the pupil that each pixel sees through the lens's centre.

    For an unfocused camera with an aligned lattice the micro-image is a disc.
    """
    b = camera.mla_distance
    z = camera.reduced_distance
    centre = [rays.chief_detector_point(c, b, z) for c in camera.lattice.centre(*index)]
    Px, Py = ((c - camera.pixel_coordinates(axis)) * (b / z) for axis, c in enumerate(centre))
    radius = np.hypot(Px, Py[:, None])
    if not DetectorOperator.of(camera).is_identity:
        # It mixes the light of neighbours.
        return white_pixels(camera), radius
    if camera.lenses_are_bins and focus_type(camera) == "unfocused":
        return soft_edge((camera.aperture_radius - radius) / camera.pupil_step), radius
    lens_type = int(camera.lattice.lens_type(*index)) if len(camera.mla_focal_lengths) > 1 else 0
    return PupilFraction(camera, lens_type)(*np.broadcast_arrays(Px, Py[:, None])), radius


def _around_axis(camera: PlenopticCamera, lenses: int) -> PlenopticCamera:
    """Return the camera cropped to `lenses` lenses on each side of the axis; the detector grows if needed."""
    around = math.ceil(lenses * camera.micro_image_pitch / camera.pixel_size)
    refuse_if(
        around > MOST_PIXELS // 2,
        f"mla_pitch = {camera.row_pitch:g}: a micro-image of {around // 2} pixels is too wide for waves",
    )
    columns, rows = (max(size, 2 * around) for size in camera.resolution)
    return camera.replace(
        resolution=(columns, rows),
        detector_width=columns * camera.pixel_size,
        crop_offset=(columns // 2 - around, rows // 2 - around),
        crop_size=(2 * around, 2 * around),
    )
