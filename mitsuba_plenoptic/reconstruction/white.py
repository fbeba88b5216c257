"""What a white scene gives by waves, by which images are divided: 1 then is the radiance of white."""

from __future__ import annotations

import functools
import math

import numpy as np

from ..bounds import MOST_PIXELS
from ..camera import PlenopticCamera
from ..design import focus_type
from ..errors import InputError
from ..optics import rays
from ..optics.phase import soft_edge
from ..runtime.backend import backend
from ..runtime.fft import convolve
from ..system.optical_system import OpticalSystem
from ..system.pupil import PupilFraction
from ..system.sampling import check_memory
from .conjugates import RealConjugates
from .lens_by_lens import object_patches, on_bins, passing_power, pupil_fields
from .lens_sets import AlignedLenses, LensSet, lens_set
from .lens_tiles import Tile, tile_lenses
from .radiance import lens_scale, over_lenses
from .ray_sums import ray_sums, white_pixels, white_sums

_THROUGHPUT_LENSES = 25

_HEIGHTS, _TOGETHER = 17, 512
"""Lenses behind a real main lens of which the throughput is found, and how many places of lenses are found at once."""

_WHOLE = 0.2
"""Light of such a lens over that of the brightest, at least."""

_RAY_BINS = 36
"""Fine bins across a lens in which the rays of a white scene are counted, where they are not too many."""

_MOST_RAY_BINS = 2**26


def white_light(
    camera: PlenopticCamera, wavelength: float, distance: float, oversample: int, *, fine: int, relay: bool
) -> np.ndarray:
    """Return the power that comes to each bin from a white scene, in pixel values times pixels.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    distance : float
        Object distance.
    oversample : int
        Bins per lens along each axis.
    fine : int
        Fine bins across a bin, in which power is summed before it is spread over lenses.
    relay : bool
        Whether the microlenses act in the MLA plane.

    Returns
    -------
    (rows, columns) float64 array
    """
    if camera.lens_data.traced_surfaces:
        places, throughput = _traced_throughput(camera, wavelength, distance, relay)
        x, y = (
            (np.arange(count * oversample) - (count * oversample - 1) / 2) * (camera.mla_pitch / oversample)
            for count in camera.bin_count
        )
        share = np.interp(np.hypot(x, y[:, None]), places, throughput)
        return _white_rays(camera, distance, oversample, fine) * share
    if camera.lenses_are_bins and focus_type(camera) != "unfocused":
        return white_power(camera, wavelength, distance, relay=relay, oversample=oversample)
    return _white_rays(camera, distance, oversample, fine) * white_throughput(camera, wavelength, relay=relay)


@functools.lru_cache(maxsize=32)
def _white_rays(camera: PlenopticCamera, distance: float, oversample: int, fine: int) -> np.ndarray:
    """Return the pixels of white whose rays come to each bin, spread over lenses as the light of waves is.

    A ray must pass the pupil, by half a pixel: a smooth wave goes back through the lens's centre alone.
    """
    if camera.lens_data.traced_surfaces or camera.lenses_like_bins or focus_type(camera) != "unfocused":
        return white_sums(camera, distance, camera.lit_radius, "lens", oversample)
    # Rays go to points, where waves go to spots: the grid on which they are counted must not show.
    bins = math.prod(camera.bin_count) * (oversample * fine) ** 2
    fine *= max(1, min(-(-_RAY_BINS // (oversample * fine)), math.isqrt(_MOST_RAY_BINS // bins)))
    white = white_pixels(camera)[..., None]
    counted = ray_sums(white, camera, distance, camera.lit_radius, "point", oversample * fine)[..., 0]
    return over_lenses(counted, camera, oversample, fine, lens_scale(camera, distance))


@functools.lru_cache(maxsize=16)
def white_throughput(camera: PlenopticCamera, wavelength: float, *, relay: bool = True) -> float:
    """Return the fraction of a white micro-image's power that comes back through the main lens.

    Its edge is one of the pupil, where light diffracts out: 7 % for the paper's camera.

    Raises
    ------
    InputError
        If no light comes back, for micro-images so small that they miss the centres of all pixels.
    """
    back, sent = (_aligned_throughput if camera.lenses_are_bins else _mean_throughput)(camera, wavelength, relay)
    if not min(back, sent) > 0:
        raise InputError(
            f"aperture_radius = {camera.aperture_radius:g}: its micro-images of "
            f"{camera.micro_image_diameter / camera.pixel_size:.2g} pixels light no pixel near the axis, so that "
            "waves cannot tell what is white"
        )
    return back / sent


@functools.lru_cache(maxsize=16)
def _traced_throughput(
    camera: PlenopticCamera, wavelength: float, distance: float, relay: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return what `white_throughput` does, of some lenses behind a real main lens, by their distance from the axis.

    Micro-images that the lens cuts have more edge for their area, and lose more.
    """
    conjugates = RealConjugates.of(OpticalSystem(camera, wavelength), [distance], 1)
    tile = Tile(conjugates.camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of white micro-images")
    white, lenses, libraries = white_pixels(camera), lens_set(tile), backend()
    lit = lenses.lit(white)
    centres = np.concatenate([lenses.batch(part).centre for part in np.array_split(lit, -(-len(lit) // _TOGETHER))])
    order = np.argsort(np.hypot(*centres.T), kind="stable")
    chosen = order[np.unique(np.linspace(0, len(order) - 1, _HEIGHTS).round().astype(int))]
    amplitude = libraries.arrays.asarray(np.sqrt(white))
    found = []
    for number in chosen:
        batch = lenses.batch(lit[number : number + 1])
        fields = pupil_fields(amplitude, tile, batch, relay=relay)
        own = np.logical_and.reduce(np.broadcast_arrays(*(factor != 0 for factor in batch.source)))
        sent = float((white[batch.row, batch.column] * own).sum(dtype=np.float64)) / tile.subsamples**2
        passed = passing_power(fields, tile, batch, conjugates.distance(distance), conjugates)
        if sent > 0:
            found.append((float(np.hypot(*batch.centre[0])), passed / (sent * camera.pixel_size**2), sent))
    places, shares, light = np.array(found).T
    # Lenses whose micro-images are recorded in small part only tell little.
    whole = light > _WHOLE * light.max()
    return places[whole], shares[whole]


def _aligned_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> tuple[float, float]:
    """Power that comes back, and power sent, of the micro-image of the lens beside the axis."""
    camera = _around_axis(camera, 2)
    centre = rays.chief_detector_point(camera.mla_pitch / 2, camera.mla_distance, camera.detector_distance)
    px, py = (camera.pixel_coordinates(axis) - centre for axis in (0, 1))
    image = soft_edge((camera.micro_image_diameter / 2 - np.hypot(px, py[:, None])) / camera.pixel_size)
    tile = Tile(camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of a white micro-image")
    return _power(image, lens_set(tile), (0, 0), relay), float(image.sum()) * camera.pixel_size**2


def _mean_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> tuple[float, float]:
    """Power that comes back, and power sent by pixels whose own ray passes the main lens, for a lens of every type."""
    camera = _around_axis(camera, 3)
    lenses = lens_set(Tile(camera, wavelength, _THROUGHPUT_LENSES, 1))
    back = sent = 0.0
    px, py = (camera.pixel_coordinates(axis) for axis in (0, 1))
    types = len(camera.mla_focal_lengths)
    for step in range(types):
        # Among the lenses beside the axis there is one of every type.
        i, j = camera.lattice.cell(0.0, 0.0)
        i += step
        lens_type = int(camera.lattice.lens_type(i, j)) if types > 1 else 0
        to_pupil = camera.mla_distance / camera.detector_distance
        centre = [
            rays.chief_detector_point(c, camera.mla_distance, camera.detector_distance)
            for c in camera.lattice.centre(i, j)
        ]
        Px, Py = (centre[0] - px) * to_pupil, ((centre[1] - py) * to_pupil)[:, None]
        image = PupilFraction(camera, lens_type)(*np.broadcast_arrays(Px, Py))
        sent += float(image[np.hypot(Px, Py) <= camera.lit_radius].sum()) * camera.pixel_size**2
        back += _power(image, lenses, (i, j), relay)
    return back, sent


def white_power(
    camera: PlenopticCamera, wavelength: float, distance: float, *, relay: bool = True, oversample: int = 1
) -> np.ndarray:
    """Return the power in each bin from a white scene, for an aligned lattice and if no two lenses interfere.

    For a focused camera the bins of a lens overlap with those of a few others. Light from the rim of its micro-image,
    which came from within the pupil through a part of the lens, returns as if through the lens's centre and misses the
    pupil. So some bins get more light than others. All lenses are taken for the one beside the axis.
    """
    part = _around_axis(camera, 2)
    count = tile_lenses(camera, [distance])
    tile = Tile(part, wavelength, count, oversample)
    lenses = lens_set(tile)
    centre = rays.chief_detector_point(camera.mla_pitch / 2, camera.mla_distance, camera.detector_distance)
    to_pupil = camera.mla_distance / camera.detector_distance
    Px, Py = ((centre - part.pixel_coordinates(axis)) * to_pupil for axis in (0, 1))
    image = PupilFraction(camera)(Px, Py[:, None])
    batch = lenses.batch(np.array([lenses.find(0, 0)]))
    libraries = backend()
    fields = pupil_fields(libraries.arrays.asarray(np.sqrt(image)), tile, batch, relay=relay)
    patch = libraries.to_host(object_patches(fields, tile, batch, distance)[0]).astype(np.float64)
    everywhere = AlignedLenses(Tile(camera, wavelength, count, oversample))
    comb = np.zeros([(count - 1) * oversample + 1 for count in everywhere.bins[::-1]])
    comb[::oversample, ::oversample] = 1
    return on_bins(libraries.arrays.asarray(convolve(comb, patch)), everywhere)


def _around_axis(camera: PlenopticCamera, lenses: int) -> PlenopticCamera:
    """Return the camera with the pixels of so many lenses on each side of the axis, whether it has them or not."""
    around = math.ceil(lenses * camera.micro_image_pitch / camera.pixel_size)
    if around > MOST_PIXELS // 2:
        raise InputError(
            f"mla_pitch = {camera.mla_pitch:g}: a micro-image of {around // 2} pixels is too wide for waves"
        )
    columns, rows = (max(size, 2 * around) for size in camera.resolution)
    return camera.replace(
        resolution=(columns, rows),
        detector_width=columns * camera.pixel_size,
        crop_offset=(columns // 2 - around, rows // 2 - around),
        crop_size=(2 * around, 2 * around),
    )


def _power(image: np.ndarray, lenses: LensSet, index: tuple[float, float], relay: bool) -> float:
    """Power that one lens sends through the main lens."""
    tile, arrays = lenses.tile, backend().arrays
    batch = lenses.batch(np.array([lenses.find(*index)]))
    field = pupil_fields(arrays.asarray(np.sqrt(image).astype(np.float32)), tile, batch, relay=relay)[0]
    inside = (tile.camera.aperture_radius - np.hypot(tile.pupil, tile.pupil[:, None])) / tile.pupil_pitch
    return float((abs(field) ** 2 * arrays.asarray(soft_edge(inside))).sum()) * tile.pupil_pitch**2
