r"""Refocusing with the wave model: the square root of a capture is one coherent wave, or one for each lens subset.

The detector has lost the phase of the light. Coherent reconstruction supplies one: under each microlens, of centre
c, the light is taken to converge from its whole micro-image towards c,

.. math:: U_0(p) = \sqrt{I(p)} \, \exp\left(-i \pi \frac{|p - c|^2}{\lambda z}\right)

and is propagated back by the angular spectrum to the MLA, the microlenses :math:`\exp(-i \pi |m - c|^2 / \lambda f_2)`,
to the main lens :math:`\exp(-i \pi P^2 / \lambda f_1)` and its pupil, and to the object plane, where
:math:`|U|^2` is summed over bins.

Why the microlens acts a second time
------------------------------------
The converging phase undoes the effect of the microlens during the capture, which suggests that the microlens can be
left out. But at its focus in the MLA plane, a field that converges from a distance z is the Fourier transform of
:math:`\sqrt{I}` *times* :math:`\exp(i \pi |m - c|^2 / \lambda z)` (Goodman, "Introduction to Fourier Optics", section
5.2). If that factor stays, the light that reaches the main lens is not the micro-image enlarged but the micro-image
after :math:`(\lambda z)^{1/2}` of Fresnel blur: 18 um of a micro-image of 43 um for the paper's camera, where a
microlens has the Fresnel number 1.4. A blurred micro-image is a blurred pupil: every ray's direction is uncertain, and
planes out of focus come out with doubled edges, the more the farther they are. The microlens's own phase cancels the
factor (exactly for z = f2), and the pupil holds :math:`\sqrt{I}` itself. ``relay=False`` leaves it out, to show this.

Focused cameras
---------------
The two phases are right for :math:`z \neq f_2`, too. The chief ray of a pixel goes through the centre of its lens, so
light converges to there over z; and what is left after the microlens, :math:`\exp(-i \pi |m - c|^2 / \lambda a)`, makes
it converge once more, to :math:`\sqrt{I}` itself in the plane that the microlens sees, a before the MLA (or behind it)
with :math:`1/a + 1/z = 1/f_2`: the micro-image, enlarged, where the main lens's image is. Where micro-images are smooth
the light goes through a small part of the lens only, and what came from the rim of the pupil through the rim of a lens
misses the pupil on its way back; images are divided by what a white scene gives.

Partial coherence
-----------------
Light that passed different microlenses from different scene points never interferes, yet the fields of all lenses of a
coherent reconstruction do. Fields of lenses in subsets, every K-th column and row, interfere less; where the lenses of
a subset are farther apart than their images are wide, not at all. That limit is found by full fields with such a
period, or lens by lens, whichever costs less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type
from ..errors import MOST_PIXELS, refuse_if
from ..light.optical_system import OpticalSystem
from ..light.sampling import check_memory
from ..light.walk import follow_back
from ..optics import rays
from ..optics.waves import soft_edge
from ..runtime.backend import backend
from ..runtime.fft import Field, convolve
from ..runtime.limits import single_threaded_blas
from ..views.white_image import PupilFraction
from .conjugates import RealConjugates, ThinConjugates, undistorted
from .full_fields import lit_window, reconstruct_subsets
from .lens_by_lens import (
    LensBatch,
    LensSet,
    object_patches,
    on_bins,
    passing_power,
    pupil_fields,
    reconstruct_lens_by_lens,
)
from .lens_tiles import LensTile, fine_bins, tile_lenses
from .methods import Progress, Task, method, portion, work_of
from .planning import plan
from .radiance import captures, lens_scale, once_a_camera, over_lenses, to_radiance
from .ray import ray_sums, white_pixels, white_sums

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
        positions, throughput = _traced_throughput(camera, wavelength, distance, relay)
        x, y = (
            (np.arange(count * oversample) - (count * oversample - 1) / 2) * (camera.mla_pitch / oversample)
            for count in camera.bin_count
        )
        share = np.interp(np.hypot(x, y[:, None]), positions, throughput)
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
    white, parts = white_pixels(camera), _pixel_parts(camera, distance)
    split = camera.replace(
        resolution=tuple(parts * size for size in camera.resolution),
        crop_offset=tuple(parts * size for size in camera.crop_offset),
        crop_size=None if camera.crop_size is None else tuple(parts * size for size in camera.crop_size),
    )
    rays_of_white = (white / parts**2).repeat(parts, 0).repeat(parts, 1)[..., None]
    counted = ray_sums(rays_of_white, split, distance, camera.lit_radius, "point", oversample * fine)[..., 0]
    return over_lenses(counted, camera, oversample, fine, lens_scale(camera, distance))


def _pixel_parts(camera: PlenopticCamera, distance: float) -> int:
    """Return into how many parts along each axis pixels are split, so that images of parts are no wider than a lens.

    Light of waves comes from all of a pixel, and the pixels of fast cameras have images as wide as several lenses.
    """
    _, image = follow_back(camera.pixel_size, 0.0, 0.0, distance, camera)
    most = min(math.isqrt(_MOST_RAY_BINS // math.prod(camera.shape)), MOST_PIXELS // max(camera.resolution))
    return max(1, min(math.ceil(abs(float(image)) / camera.mla_pitch), most))


@once_a_camera
@single_threaded_blas()  # the bits are the same with any thread count
def white_throughput(camera: PlenopticCamera, wavelength: float, relay: bool = True) -> float:
    """Return the fraction of a white micro-image's power that comes back through the main lens.

    Its edge is one of the pupil, where light diffracts out: 7 % for the paper's camera.
    """
    back, sent = (_aligned_throughput if camera.lenses_are_bins else _mean_throughput)(camera, wavelength, relay)
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
    """Return `white_throughput` of some lenses behind a real main lens, by their distance from the axis.

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
    positions, shares, light = np.array(found).T
    # Lenses whose micro-images are recorded in small part only say little.
    whole = light > _WHOLE * light.max()
    return positions[whole], shares[whole]


def _aligned_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> tuple[float, float]:
    """Power that comes back, and power sent, of the micro-image of a lens next to the axis."""
    camera = _around_axis(camera, 2)
    centre = rays.chief_detector_point(camera.mla_pitch / 2, camera.mla_distance, camera.reduced_distance)
    px, py = (camera.pixel_coordinates(axis) - centre for axis in (0, 1))
    image = soft_edge((camera.micro_image_diameter / 2 - np.hypot(px, py[:, None])) / camera.pixel_size)
    tile = LensTile(camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of a white micro-image")
    return _power(image, LensSet(tile), (0, 0), relay), float(image.sum()) * camera.pixel_size**2


def _mean_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> tuple[float, float]:
    """Return the power that comes back, and the power sent by pixels whose ray passes the main lens, per lens type."""
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
    b, z = camera.mla_distance, camera.reduced_distance
    centre = [rays.chief_detector_point(c, b, z) for c in camera.lattice.centre(*index)]
    Px, Py = ((c - camera.pixel_coordinates(axis)) * (b / z) for axis, c in enumerate(centre))
    lens_type = int(camera.lattice.lens_type(*index)) if len(camera.mla_focal_lengths) > 1 else 0
    return PupilFraction(camera, lens_type)(*np.broadcast_arrays(Px, Py[:, None])), np.hypot(Px, Py[:, None])


@single_threaded_blas()
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
    refuse_if(
        around > MOST_PIXELS // 2,
        f"mla_pitch = {camera.mla_pitch:g}: a micro-image of {around // 2} pixels is too wide for waves",
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


_APART = 2
"""Bins between the geometric images of two lenses that do not interfere, for diffraction."""


@method("coherent", waves=True)
def coherent(task: Task, *, relay: bool) -> list[np.ndarray]:
    """Follow the light back as one coherent wave."""
    return _refocus(task, 1, relay)


@method("partial", waves=True)
def partial(task: Task, *, interleave: int | str, relay: bool) -> list[np.ndarray]:
    """Follow the light back as one wave for each subset of lenses, or for each lens."""
    return _refocus(task, interleave, relay)


def _refocus(task: Task, interleave: int | str, relay: bool) -> list[np.ndarray]:
    """Return the refocused images, channel by channel.

    The white that bins are divided by, if there is no white capture, is that of rays: without interference, less what
    waves lose of a micro-image at the edge of the pupil.
    """
    camera, oversample = task.camera, task.oversample
    sums = []
    for image, distances, progress in captures(task):
        # The shortest waves, which take the most memory, come first.
        channels = np.argsort(task.wavelengths[: image.shape[2]]).tolist()
        works, found = work_of([task.wavelengths[channel] for channel in channels]), {}
        for index, channel in enumerate(channels):
            system = task.system(task.wavelengths[channel])
            given = image[..., channel], system, distances, task.distances, interleave, relay, oversample
            found[channel] = _signed_power(*given, portion(progress, index, works))
        of_planes = zip(*(found[channel] for channel in sorted(found)), strict=True)
        sums.append([np.stack(planes, axis=-1) for planes in of_planes])
    white = [
        np.stack([white_light(camera, w, g, oversample, relay) for w in task.wavelengths], axis=-1)
        for g in (task.distances if task.white is None else ())
    ]
    rays = [white_sums(camera, g, camera.lit_radius, "lens", oversample) for g in task.distances]
    return to_radiance(task, sums, white, rays)


def signed_parts(image: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Return the non-negative pixels with the sign 1 and, if any, magnitudes of negative ones with the sign -1.

    Amplitudes are square roots. Pixels below zero, which `expose` makes of dark ones, are refocused apart, and what
    they give is subtracted: so noise of mean zero leaves no light on average.
    """
    if image.min() >= 0:
        return [(1.0, image)]
    return [(sign, np.maximum(sign * image, 0)) for sign in (1.0, -1.0)]


def _signed_power(
    image: np.ndarray,
    system: OpticalSystem,
    distances: Sequence[float],
    planned: Sequence[float],
    interleave: int | str,
    relay: bool,
    oversample: int,
    progress: Progress,
) -> list[np.ndarray]:
    """Return the power in bins, in pixel values times pixels, spread over lenses where these do not lie on bins.

    The propagation to the main lens is done once for all distances. Seen from behind, a real main lens is a thin one.
    Fields have the samples that all `planned` distances need: ratios of images, such as displacements, which are of
    single planes, are far more sensitive to the samples than the images are.
    """
    camera, wavelength = system.camera, system.wavelength
    fine, real, seen = fine_bins(system, oversample), None, camera
    planes, sampled = list(distances), list(planned)
    if camera.lens_data.traced_surfaces:
        real = RealConjugates.of(system, sampled, oversample)
        seen = real.camera
        planes, sampled = ([real.distance(distance) for distance in each] for each in (distances, planned))
    parts, found = signed_parts(image), [np.zeros(()) for _ in distances]
    for index, (sign, part) in enumerate(parts):
        # Guards look at the light, not at the noise below zero.
        options: dict[str, Any] = {"relay": relay, "oversample": oversample * fine, "checked": sign > 0}
        options |= {
            "progress": portion(progress, index, [1] * len(parts)),
            "conjugates": real or ThinConjugates(system),
        }
        period = full_field_period(part, seen, planes, wavelength) if isinstance(interleave, str) else interleave
        if period is None:
            totals = reconstruct_lens_by_lens(part, seen, planes, wavelength, **options)
        else:
            totals = reconstruct_subsets(part, seen, planes, wavelength, interleave=period, planned=sampled, **options)
        for plane, (total, distance) in enumerate(zip(totals, distances, strict=True)):
            scale = lens_scale(camera, distance)
            if real is not None:
                total, stretch = undistorted(total, real, camera, distance, oversample * fine)
                scale *= stretch
            if fine > 1 or real is not None:
                total = over_lenses(total, camera, oversample, fine, scale)
            found[plane] = found[plane] + sign * total
    return found


def full_field_period(
    image: np.ndarray, camera: PlenopticCamera, distances: Sequence[float], wavelength: float
) -> int | None:
    """Return the period from which subsets of lenses do not interfere, or None if single lenses are cheaper.

    Full fields are cheaper near focus, where few subsets suffice. The cost is the count of transformed samples.
    """
    lit = lit_window(image, camera)
    if lit is None:
        return 1
    blur = max(camera.blur_diameter(g) for g in distances) / min(camera.mla_pitches)
    period = math.ceil(blur - 1e-6) + _APART
    tile = LensTile(camera, wavelength, tile_lenses(camera, distances), 1)
    lenses = math.prod((end - first) / camera.pixels_per_lens for first, end in lit)
    single = lenses * tile.transformed * len(distances)
    # A field takes at least this; how much more needs grids, of which those of large cameras are not worth planning.
    if period**2 * math.prod(end - first for first, end in lit) >= single:
        return None
    return period if period**2 * plan(camera, wavelength, distances, lit).transformed < single else None
