"""The light of a white scene in the wave model, by which images are divided, so that white has the radiance 1."""

from __future__ import annotations

import math

import numpy as np

from ..bounds import MOST_PIXELS
from ..camera import PlenopticCamera
from ..design import focus_type
from ..errors import InputError
from ..lightfield.white import PupilFraction
from ..optics import rays
from ..optics.phase import soft_edge
from ..runtime.backend import backend
from ..runtime.fft import Field, convolve
from ..system.optical_system import OpticalSystem
from ..system.sampling import check_memory
from .conjugates import RealConjugates, ThinConjugates
from .lens_by_lens import LensBatch, LensSet, object_patches, on_bins, passing_power, pupil_fields
from .lens_tiles import LensTile, fine_bins, tile_lenses
from .radiance import lens_scale, over_lenses
from .ray import once_a_camera, ray_sums, white_pixels, white_sums

_THROUGHPUT_LENSES = 25

_HEIGHTS = 17
"""Lenses behind a real main lens of which the throughput is found."""

_WHOLE = 0.2
"""Light of such a lens over that of the brightest, at least."""

_RAY_BINS = 36
"""Fine bins across a lens in which the rays of a white scene are counted, where they are not too many."""

_MOST_RAY_BINS = 2**26


def white_light(
    camera: PlenopticCamera, wavelength: float, distance: float, oversample: int, relay: bool
) -> np.ndarray:
    """Return the power that comes to each bin from a white scene, in pixel values times pixels."""
    fine = fine_bins(OpticalSystem(camera, wavelength), oversample)
    if camera.lens_data.traced_surfaces:
        places, throughput = _traced_throughput(camera, wavelength, distance, relay)
        x, y = (
            (np.arange(count * oversample) - (count * oversample - 1) / 2) * (camera.mla_pitch / oversample)
            for count in camera.bin_count
        )
        share = np.interp(np.hypot(x, y[:, None]), places, throughput)
        return _white_rays(camera, distance, oversample, fine) * share
    if camera.lenses_are_bins and focus_type(camera) != "unfocused":
        return white_power(camera, wavelength, distance, relay, oversample)
    return _white_rays(camera, distance, oversample, fine) * white_throughput(camera, wavelength, relay)


@once_a_camera
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


@once_a_camera
def white_throughput(camera: PlenopticCamera, wavelength: float, relay: bool = True) -> float:
    """Return the fraction of a white micro-image's power that comes back through the main lens.

    Its edge is one of the pupil, where light diffracts out: 7 % for the paper's camera.
    """
    back, sent = (_aligned_throughput if camera.lenses_are_bins else _mean_throughput)(camera, wavelength, relay)
    if not min(back, sent) > 0:
        raise InputError(
            f"aperture_radius = {camera.aperture_radius:g}: its micro-images of "
            f"{camera.micro_image_diameter / camera.pixel_size:.2g} pixels light no pixel near the axis, so that "
            "no white can be computed for waves"
        )
    return back / sent


@once_a_camera
def _traced_throughput(
    camera: PlenopticCamera, wavelength: float, distance: float, relay: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return what `white_throughput` does of some lenses behind a real main lens, by their distance from the axis.

    Micro-images that the lens cuts have more edge for their area, and lose more.
    """
    conjugates = RealConjugates.of(OpticalSystem(camera, wavelength), [distance], 1)
    tile = LensTile(conjugates.camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of white micro-images")
    white, lenses, libraries = white_pixels(camera), LensSet(tile), backend()
    lit = lenses.lit(white)
    order = np.argsort(np.hypot(*lenses.centre[lit].T), kind="stable")
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
    # Lenses whose micro-images are recorded in small part only say little.
    whole = light > _WHOLE * light.max()
    return places[whole], shares[whole]


def _aligned_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> tuple[float, float]:
    """Power that comes back, and power sent, of the micro-image of a lens next to the axis."""
    camera = _around_axis(camera, 2)
    centre = rays.chief_detector_point(camera.mla_pitch / 2, camera.mla_distance, camera.detector_distance)
    px, py = (camera.pixel_coordinates(axis) - centre for axis in (0, 1))
    image = soft_edge((camera.micro_image_diameter / 2 - np.hypot(px, py[:, None])) / camera.pixel_size)
    tile = LensTile(camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of a white micro-image")
    return _power(image, LensSet(tile), (0, 0), relay), float(image.sum()) * camera.pixel_size**2


def _mean_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> tuple[float, float]:
    """Power that comes back, and power sent by pixels whose own ray passes the main lens, for a lens of every type."""
    camera = _around_axis(camera, 3)
    lenses = LensSet(LensTile(camera, wavelength, _THROUGHPUT_LENSES, 1))
    back = sent = 0.0
    i, j = camera.lattice.cell(0.0, 0.0)
    # Among the lenses next to the axis there is one of every type.
    for index in [(i + step, j) for step in range(len(camera.mla_focal_lengths))]:
        image, radius = _white_micro_image(camera, index)
        sent += float(image[radius <= camera.lit_radius].sum()) * camera.pixel_size**2
        back += _power(image, lenses, index, relay)
    return back, sent


def _white_micro_image(camera: PlenopticCamera, index: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the micro-image of white behind one lens, and where its pixels see the pupil from its centre, at most."""
    b, z = camera.mla_distance, camera.detector_distance
    centre = [rays.chief_detector_point(c, b, z) for c in camera.lattice.centre(*index)]
    Px, Py = ((c - camera.pixel_coordinates(axis)) * (b / z) for axis, c in enumerate(centre))
    lens_type = int(camera.lattice.lens_type(*index)) if len(camera.mla_focal_lengths) > 1 else 0
    return PupilFraction(camera, lens_type)(*np.broadcast_arrays(Px, Py[:, None])), np.hypot(Px, Py[:, None])


def white_power(
    camera: PlenopticCamera, wavelength: float, distance: float, relay: bool, oversample: int
) -> np.ndarray:
    """Return the power in each bin from a white scene, for an aligned lattice and if no two lenses interfere.

    For a focused camera the bins of a lens overlap with those of a few others. Light from the rim of its micro-image,
    which came from within the pupil through a part of the lens, returns as if through the lens's centre and misses the
    pupil. So some bins get more light than others. All lenses are taken for the one next to the axis.
    """
    count = tile_lenses(camera, [distance])
    lenses = LensSet(LensTile(_around_axis(camera, 2), wavelength, count, oversample))
    fields, batch = _lens_field(_white_micro_image(lenses.tile.camera, (0, 0))[0], lenses, (0, 0), relay)
    libraries, system = backend(), OpticalSystem(lenses.tile.camera, wavelength)
    patches = object_patches(fields, lenses.tile, batch, distance, ThinConjugates(system))
    patch = libraries.to_host(patches[0]).astype(np.float64)
    everywhere = LensSet(LensTile(camera, wavelength, count, oversample))
    comb = np.zeros([(count - 1) * oversample + 1 for count in everywhere.bins[::-1]])
    column, row = everywhere.bin[everywhere.lit(np.ones(camera.shape, bool))].T
    comb[row * oversample, column * oversample] = 1
    return on_bins(libraries.arrays.asarray(convolve(comb, patch)), everywhere)


def _around_axis(camera: PlenopticCamera, lenses: int) -> PlenopticCamera:
    """Return the camera with a crop of `lenses` lenses on each side of the axis; the detector grows if needed."""
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


def _lens_field(image: np.ndarray, lenses: LensSet, index: tuple[float, float], relay: bool) -> tuple[Field, LensBatch]:
    """Return the field that one lens makes of a capture at the main lens."""
    batch = lenses.batch(np.array([lenses.find(*index)]))
    amplitude = backend().arrays.asarray(np.sqrt(image).astype(np.float32))
    return pupil_fields(amplitude, lenses.tile, batch, relay=relay), batch


def _power(image: np.ndarray, lenses: LensSet, index: tuple[float, float], relay: bool) -> float:
    """Power that one lens sends through the main lens."""
    tile, arrays = lenses.tile, backend().arrays
    (field,), _ = _lens_field(image, lenses, index, relay)
    inside = (tile.camera.aperture_radius - np.hypot(tile.pupil, tile.pupil[:, None])) / tile.pupil_pitch
    return float((abs(field) ** 2 * arrays.asarray(soft_edge(inside))).sum()) * tile.pupil_pitch**2
