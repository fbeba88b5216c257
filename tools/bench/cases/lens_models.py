"""Thin main lenses of both models, by rays and by waves: stars against the Airy pattern, and refocused walls.

Behind an ideal lens rays and waves differ by diffraction and by microlenses, which are thin phases in waves. A textured
wall is captured by both and refocused by rays. Their difference, after one factor for all bins, is held against what
two apertures predict (Goodman, "Introduction to Fourier Optics", section 6.3): the spots of a microlens, aberrated as
those of a thin phase are, spread the ray capture, and the pupil's transfer function filters the refocused image. The
factor is stated, too: thin phases enlarge micro-images, and dim them.

Wavefronts of points over the field of thin main lenses, as the methods for many points at once take them.

Coherent and partial reconstructions and laser light apply phases in the main lens's pupil, and let light propagate by
slopes or by direction cosines. Of a point on the axis, half-way to the corner of the field, and in the corner, light
is taken through a pupil with the phases and the law that each method uses. The wavefront is compared with the sphere
that converges to the point's image, or, for light that moves by slopes, with the parabola that does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import mitsuba as mi
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from mitsuba_plenoptic import Capture, PlenopticCamera, reconstruct, render_capture
from mitsuba_plenoptic.lenses.thin import ThinLens
from mitsuba_plenoptic.light.optical_system import OpticalSystem, is_paraxial
from mitsuba_plenoptic.optics.rays import slopes_to_cosines
from mitsuba_plenoptic.optics.waves import in_millimetres, transfer
from mitsuba_plenoptic.points.full_field import point_fields
from mitsuba_plenoptic.prescription.lens_data import conjugate_distance
from mitsuba_plenoptic.refocus.conjugates import ThinConjugates
from mitsuba_plenoptic.runtime.backend import array_module

from .. import Row, at_most, case
from ..measures import mean_of_seeds, relative, spot_filtered, without_noise, write_comparison

WAVELENGTH = 550.0
MODELS = ("ideal", "parabolic")
_FREQUENCY, _MODES, _CONTRAST = 0.25, 60, 0.35
_MARGIN = 3
_LENS_SAMPLES = 400
_FINEST, _ZONE = 32, 4
"""Least count of pixels across a micro-image for predictions, and pixels that one direction of light stands for."""


def camera_of(
    f_number: float, lens_model: str = "ideal", *, focal_length: float = 50.0, pitch: float = 0.1, lenses: int = 24
) -> PlenopticCamera:
    """Return a camera, focused at 6.4 focal lengths, whose micro-images of ten pixels touch each other."""
    distance = conjugate_distance(focal_length, 6.4 * focal_length)
    depth = 1 / (focal_length / f_number / (pitch * distance) + 1 / distance)
    return PlenopticCamera(
        focal_length=focal_length, aperture_radius=focal_length / f_number / 2, mla_distance=distance,
        mla_pitch=pitch, mla_focal_length=depth, lens_model=lens_model,
        detector_width=lenses * pitch * (1 + depth / distance), resolution=(10 * lenses,) * 2,
    )  # fmt: skip


@case(
    "lens-models.stars",
    "A star's light in the array's plane by waves, encircled at 1, 2 and 4 Airy radii, less that of the Airy pattern",
    {
        "f-number": "{f_number:g}", "model": "{model}", "field (degrees)": "{degrees:.1f}",
        "1 radius": "{one:+.4f}", "2 radii": "{two:+.4f}", "4 radii": "{four:+.4f}", "largest": "{worst:.4f}",
    },
    (at_most("worst", "limit"),),
    page="docs/theory/rays.md",
    quick={"f_numbers": (5.6,)},
)  # fmt: skip
def stars(
    *,
    f_numbers: tuple[float, ...] = (2.0, 2.8, 5.6, 10.0),
    degrees: tuple[float, ...] = (0.0, 3.9),
    places: tuple[float, ...] = (0.0, 0.5),
) -> Iterator[Row]:
    """Compare stars on the axis and off it, over a lens's centre (0.5) and over the corner of four (0).

    The focal length is 8 mm, so that a full field takes less than 4 GiB; 3.9 degrees are 40 lenses of a camera of
    50 mm. Stars by a parabolic phase are stated, not judged.
    """
    from scipy.special import j0, j1

    for number in f_numbers:
        for model in MODELS:
            for angle in degrees:
                for place in places:
                    camera = camera_of(number, model, focal_length=8.0, lenses=2)
                    side = (
                        camera.mla_pitch * place
                        + round(camera.mla_distance * math.tan(math.radians(angle)) / camera.mla_pitch)
                        * camera.mla_pitch
                    )
                    lit = _around(camera, side)
                    distance = camera.focus_distance
                    star = np.array([-side * distance / camera.mla_distance, 0.0, distance])
                    field = point_fields(OpticalSystem(lit, WAVELENGTH), star).mla
                    power = np.abs(field.samples) ** 2 * field.pitch**2
                    x, y = (
                        start + field.pitch * np.arange(size)
                        for start, size in zip(field.origin, power.shape[::-1], strict=True)
                    )
                    radius = np.hypot(x - side, y[:, None])
                    found = []
                    for count in (1, 2, 4):
                        v = 3.8317 * count
                        edge = v * WAVELENGTH * 1e-6 * camera.mla_distance / (2 * math.pi * camera.aperture_radius)
                        inside = np.clip((edge - radius) / field.pitch + 0.5, 0, 1)
                        found.append(float((power * inside).sum() - (1 - j0(v) ** 2 - j1(v) ** 2)))
                    yield {
                        "f_number": number, "model": model, "degrees": angle, "one": found[0], "two": found[1],
                        "four": found[2], "worst": max(map(abs, found)), "limit": 0.01 if model == "ideal" else None,
                    }  # fmt: skip


def _around(camera: PlenopticCamera, side: float) -> PlenopticCamera:
    """Return a camera with a detector that is cropped to two lenses about a place on the array along x."""
    pixels = round(abs(side) / camera.pixel_size)
    size = 2 * pixels + camera.resolution[0]
    return camera.replace(
        detector_width=size * camera.pixel_size, resolution=(size, size),
        crop_offset=(2 * pixels if side > 0 else 0, pixels), crop_size=camera.resolution,
    )  # fmt: skip


@case(
    "lens-models.walls",
    "A textured wall refocused by rays: the capture by waves against that by ideal rays, and what diffraction predicts",
    {
        "f-number": "{f_number}", "blur (lenses)": "{blur:g}", "waves": "{model}",
        "captures differ by": "{captured:.2%}", "refocused images by": "{refocused:.2%}",
        "diffraction predicts": "{predicted:.2%}", "factor": "{factor:.4f}", "noise": "{noise:.2%}",
    },
    (at_most("refocused", "limit"),),
    page="docs/theory/rays.md",
    quick={"f_numbers": (10.0,), "blurs": (2.0,), "lenses": 12, "spp": 64},
)  # fmt: skip
def walls(
    output: Path,
    *,
    f_numbers: tuple[float, ...] = (2.0, 2.8, 5.6, 10.0, 0.0),
    blurs: tuple[float, ...] = (0.0, 2.0),
    lenses: int = 24,
    spp: int = 256,
    seeds: int = 2,
) -> Iterator[Row]:
    """Compare walls in focus and blurred, the radius of the blur in lenses; f-number 0 is the paper's camera."""
    for number in f_numbers:
        for blur in blurs:
            made = {
                model: camera_of(number, model, lenses=lenses)
                if number
                else PlenopticCamera(detector_width=0.064 * lenses, resolution=(32 * lenses,) * 2, lens_model=model)
                for model in MODELS
            }
            camera = made["ideal"]
            distance = distance_of(camera, blur)
            scene = scene_of(camera, distance)

            def seen(image: np.ndarray, camera: PlenopticCamera = camera, distance: float = distance) -> np.ndarray:
                return inner(refocused(camera, image, distance))

            rays = [taken(scene, "ray", spp, seed) for seed in range(seeds)]
            image, noise = mean_of_seeds(lambda seed, rays=rays, seen=seen: seen(rays[seed]), seeds)
            mean = np.mean(rays, 0)
            predicted = _predicted(camera, distance, spp * seeds)
            for model in MODELS:
                scene = scene_of(made[model], distance)
                waves = [taken(scene, "wave", spp, seed) for seed in range(seeds)]
                other, own = mean_of_seeds(lambda seed, waves=waves, seen=seen: seen(waves[seed]), seeds)
                difference, factor = _scaled(other, image)
                yield {
                    "f_number": f"{number:g}" if number else "paper's", "blur": blur, "model": model,
                    "captured": without_noise(
                        relative(np.mean(waves, 0), mean), *(_noise(images) for images in (rays, waves))
                    ),
                    "refocused": without_noise(difference, noise, own), "predicted": predicted, "factor": factor,
                    "noise": math.hypot(noise, own), "limit": 2 * predicted if model == "ideal" else None,
                }  # fmt: skip
                write_comparison(
                    output / f"f{number:g}_{blur:g}_{model}_waves_rays_times_10.png", other, image, gain=10
                )


def _predicted(camera: PlenopticCamera, distance: float, spp: int) -> float:
    """Return how refocused images of waves and rays differ by the diffraction of pupil and lenses.

    Lenses spread the light of finer pixels, whose edges are those of the rays' micro-images.
    """
    parts = math.ceil(_FINEST * camera.pixel_size / camera.micro_image_pitch)
    fine = camera.replace(resolution=(parts * camera.resolution[0],) * 2)
    image = taken(scene_of(fine, distance), "ray", math.ceil(spp / parts**2), 0)
    before, after = (
        refocused(camera, each.reshape(camera.resolution[1], parts, camera.resolution[0], parts).mean((1, 3)), distance)
        for each in (image, lens_filtered(image, fine))
    )
    return _scaled(inner(pupil_filtered(after, camera)), inner(before))[0]


def _scaled(image: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Return the relative difference of an image that is scaled to its reference, and the factor."""
    factor = float(np.vdot(image, reference) / np.vdot(image, image))
    return relative(factor * image, reference), factor


def _noise(images: list[np.ndarray]) -> float:
    """Return the noise of the mean of images over its norm."""
    return mean_of_seeds(lambda seed: images[seed], len(images))[1]


@case(
    "lens-models.microlenses",
    "Micro-images of a white wall by rays of both models, filtered by a lens's transfer function, against waves",
    {
        "f-number": "{f_number:g}", "lenses off the axis": "{off_axis:g}", "rays": "{model}",
        "differ from waves by": "{difference:.2%}", "light over that of waves": "{light:.4f}",
    },
    page="docs/theory/rays.md",
    quick={"f_numbers": (5.6,), "off_axis": (0,)},
)  # fmt: skip
def microlenses(
    *,
    f_numbers: tuple[float, ...] = (2.0, 2.8, 5.6, 10.0),
    off_axis: tuple[int, ...] = (0, 40),
    spp: int = 256,
) -> Iterator[Row]:
    """Compare four lenses on the axis and off it, with 32 pixels across a lens."""
    for number in f_numbers:
        for aside in off_axis:
            waves = None
            for model in MODELS:
                camera = camera_of(number, model, lenses=2 * aside + 8)
                camera = camera.replace(
                    resolution=(32 * (2 * aside + 8),) * 2, crop_offset=(64 * aside, 32 * aside), crop_size=(256, 256)
                )
                scene = scene_of(camera, camera.focus_distance, white=True)
                if waves is None:
                    waves = taken(scene, "wave", spp, 0)[64:-64, 64:-64]
                found = spot_filtered(taken(scene, "ray", spp, 0), camera, WAVELENGTH)[64:-64, 64:-64]
                yield {
                    "f_number": number, "off_axis": aside, "model": model, "difference": relative(found, waves),
                    "light": found.mean() / waves.mean(),
                }  # fmt: skip


def distance_of(camera: PlenopticCamera, blur: float) -> float:
    """Return the distance of the plane whose points light discs of some lenses' radius, behind the focused plane."""
    power = (1 - blur * camera.mla_pitch / camera.aperture_radius) / camera.mla_distance
    return 1 / (1 / camera.focal_length - power)


def taken(scene: mi.Scene, model: str, spp: int, seed: int) -> np.ndarray:
    """Capture a scene."""
    options = {"wavelength": WAVELENGTH} if model == "wave" else {}
    return render_capture(scene, model=model, spp=spp, seed=seed, **options).image.astype(float)


def scene_of(camera: PlenopticCamera, distance: float, *, white: bool = False) -> mi.Scene:
    """Return a scene of one wall that fills the view, of smooth random radiance without frequencies near the bins'."""
    bins = camera.bin_count[0] + 2 * (2 + math.ceil(camera.blur_diameter(distance) / camera.mla_pitch))
    generator, place = np.random.default_rng(0), (np.arange(8 * bins) + 0.5) / 8
    texture = np.ones((8 * bins, 8 * bins))
    for _ in range(_MODES):
        fx, fy = generator.uniform(-_FREQUENCY, _FREQUENCY, 2)
        wave = 2 * np.pi * (fx * place + fy * place[:, None] + generator.uniform())
        texture += _CONTRAST * math.sqrt(2 / _MODES) * np.cos(wave)
    half = bins * camera.mla_pitch * distance / camera.mla_distance / 2
    placed = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale([half, half, 1])
    texture = np.ones_like(texture) if white else texture
    bitmap = mi.Bitmap(np.maximum(texture, 0.05).astype(np.float32)[..., None])
    light = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear"}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 1},
            "sensor": camera.to_sensor(),
            "wall": {
                "type": "rectangle", "to_world": placed, "emitter": {"type": "area", "radiance": light},
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
            },
        }
    )  # fmt: skip


def refocused(camera: PlenopticCamera, image: np.ndarray, distance: float) -> np.ndarray:
    """Refocus a capture by rays."""
    return reconstruct(Capture(image.astype(np.float32), camera), distance, method="ray").image.astype(float)


def lens_filtered(image: np.ndarray, camera: PlenopticCamera) -> np.ndarray:
    """Spread the light of a capture as one square microlens, a thin parabolic phase, does at each place of its image.

    Light of one place in the image of the lens on the axis meets the lens in one direction, and its spot has the coma
    and the astigmatism of that direction.
    """
    reach = round(camera.micro_image_pitch / camera.pixel_size)
    places = (np.arange(len(image)) + 0.5 - len(image) / 2) * camera.pixel_size / camera.micro_image_pitch
    count = round(reach / _ZONE)
    zones = np.minimum((places % 1 * count).astype(int), count - 1)
    shape = (len(image) + 2 * reach,) * 2
    total: np.ndarray | float = 0.0
    for row in range(count):
        for column in range(count):
            lit = np.where((zones[:, None] == row) & (zones == column), image, 0)
            slopes = [
                ((zone + 0.5) / count - 0.5) * camera.micro_image_pitch / camera.detector_distance
                for zone in (column, row)
            ]
            total = total + np.fft.rfft2(lit, shape) * np.fft.rfft2(_spot(camera, slopes, reach), shape)
    return np.fft.irfft2(total, shape)[reach:-reach, reach:-reach]


def _spot(camera: PlenopticCamera, slopes: list[float], reach: int) -> np.ndarray:
    """Return the part of the light of a pixel, lit in one direction, that pixels up to some beside it receive."""
    wavelength, step, count = WAVELENGTH * 1e-6, camera.mla_pitch / _LENS_SAMPLES, 4 * _LENS_SAMPLES
    place = (np.arange(count) - count // 2 + 0.5) * step
    length = math.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)
    frequency = np.fft.fftfreq(count, step)
    along = []
    for slope in slopes:
        phase = 2 * slope / length * place - place**2 / camera.mla_focal_length
        lens = np.exp(1j * np.pi / wavelength * phase) * (abs(place) < camera.mla_pitch / 2)
        # The spot is moved to the middle.
        along.append(np.fft.fft(lens) * np.exp(2j * np.pi * frequency * slope * camera.detector_distance))
    square = (wavelength * frequency) ** 2 + (wavelength * frequency[:, None]) ** 2
    spectrum = along[0] * along[1][:, None] * (square < 1)
    spectrum *= np.exp(2j * np.pi * camera.detector_distance / wavelength * np.sqrt(np.maximum(1 - square, 0)))
    spot = np.abs(scipy.fft.ifft2(spectrum)) ** 2
    # Light is even over its pixel.
    aside = np.arange(-reach, reach + 1)[:, None] - place / camera.pixel_size
    overlap = np.maximum(1 - abs(aside), 0)
    return overlap @ spot @ overlap.T / spot.sum()


def pupil_filtered(image: np.ndarray, camera: PlenopticCamera) -> np.ndarray:
    """Filter a refocused image by the transfer function of a round pupil."""
    cut = 2 * camera.aperture_radius / (WAVELENGTH * 1e-6 * camera.mla_distance) * camera.mla_pitch
    fx, fy = np.fft.fftfreq(image.shape[1]), np.fft.fftfreq(image.shape[0])[:, None]
    part = np.minimum(np.hypot(fx, fy) / cut, 1)
    transfer = 2 / np.pi * (np.arccos(part) - part * np.sqrt(1 - part**2))
    return np.fft.ifft2(np.fft.fft2(image) * transfer).real


def inner(image: np.ndarray) -> np.ndarray:
    """Return the bins of an image away from its border, to which light comes from beyond the detector."""
    return image[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]


_RINGS, _SPOKES = 4, 24
_DIRECTIONS = 1 << 16


@case(
    "lens-models.fields",
    "Largest wavefront error in the pupil, in waves, of points over the field: phases for many points at once",
    {
        "f-number": "{f_number}", "model": "{model}", "blur (lenses)": "{blur:g}", "field (degrees)": "{degrees:.1f}",
        "coherent, partial": "{whole:.3g}", "partial, lens by lens": "{single:.3g}", "laser": "{laser:.3g}",
        "phase of the axis": "{axial:.3g}",
    },
    (at_most("whole", "limit"), at_most("single", "limit"), at_most("laser", "limit")),
    page="docs/theory/reconstruction.md",
    quick={"f_numbers": (2.0, 0.0), "blurs": (0.0,)},
)  # fmt: skip
def fields(
    *,
    f_numbers: tuple[float, ...] = (2.0, 2.8, 5.6, 10.0, 0.0),
    blurs: tuple[float, ...] = (0.0, 2.0),
    places: tuple[float, ...] = (0.0, 0.5, 1.0),
    lenses: int = 100,
) -> Iterator[Row]:
    """Compare points of the corner's diagonal; f-number 0 is the paper's camera. Parabolic lenses are stated."""
    for number in f_numbers:
        for model in MODELS:
            camera = camera_of(number, model, lenses=lenses) if number else PlenopticCamera(lens_model=model)
            corner = np.array(camera.bin_count) * camera.mla_pitch / 2
            for blur in blurs:
                for place in places:
                    aside = place * corner
                    whole, single, laser, axial = errors(camera, distance_of(camera, blur), aside)
                    yield {
                        "f_number": f"{number:g}" if number else "paper's", "model": model, "blur": blur,
                        "degrees": float(np.degrees(np.arctan(np.hypot(*aside) / camera.mla_distance))),
                        "whole": whole, "single": single, "laser": laser, "axial": axial,
                        "limit": 0.25 if model == "ideal" else None,
                    }  # fmt: skip


def errors(camera: PlenopticCamera, distance: float, aside: NDArray[np.float64]) -> tuple[float, ...]:
    """Return the largest wavefront errors in waves of a point, by each of four methods.

    The methods are reconstructions of whole fields and lens by lens, laser light, and, to compare, the phase of the
    point on the axis where light moves by direction cosines. The point's chief ray meets the array at `aside`, the
    point's image lies behind the main lens at the distance that is conjugate to `distance`.
    """
    system = OpticalSystem(camera, WAVELENGTH)
    conjugates, lens = ThinConjugates(system), cast(ThinLens, system.lens)
    radius, turn = (
        values.ravel()
        for values in np.meshgrid(
            np.arange(_RINGS + 1) * (camera.aperture_radius / _RINGS), 2 * np.pi * np.arange(_SPOKES) / _SPOKES
        )
    )
    x, y = radius * np.cos(turn), radius * np.sin(turn)
    slope = aside / camera.mla_distance
    image = conjugate_distance(camera.focal_length, distance)
    types, paraxial = array_module(), is_paraxial(camera)
    pupil = types.Float64(x), types.Float64(y)

    def free(by_slopes: bool) -> NDArray[np.float64]:
        return propagated(image, by_slopes, np.hypot(x - slope[0] * image, y - slope[1] * image))

    def largest(waves: NDArray[np.float64]) -> float:
        return float(np.abs(waves - waves[radius == 0].mean()).max())

    # Whole fields leave the pupil as plane waves to the object's directions.
    by_slope, by_cosine = (
        (x * along + y * down) / in_millimetres(WAVELENGTH) for along, down in (slope, slopes_to_cosines(*slope))
    )
    tilt = by_slope if paraxial else by_cosine
    (zone,) = conjugates.zones(distance)
    whole = free(paraxial) + np.array(zone.light.path(pupil)) + tilt
    # A lens alone sends light to the image of its own centre; by slopes tilts there and back are left out.
    chief = types.Float64(aside[0]), types.Float64(aside[1])
    path = np.array(conjugates.at(*chief, aside[None], types.UInt32(0), distance).path(pupil))
    single = free(paraxial) + path + (tilt if paraxial else 0)
    point = (-slope[0] * distance, -slope[1] * distance, distance)
    laser, axial = (np.asarray(lens.path((x, y), place, WAVELENGTH)) for place in (point, (0.0, 0.0, distance)))
    return tuple(map(largest, (whole, single, free(False) + laser, free(False) + axial + by_cosine)))


def propagated(distance: float, by_slopes: bool, away: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the phase in waves of a point's light at places aside, after a distance of free space.

    The phase is that of the transfer function of free space where it is stationary: the light that gets there.
    """
    cosine = np.linspace(0, 1.05 * away.max() / distance, _DIRECTIONS)
    Float64 = array_module().Float64
    factor = transfer(Float64(cosine), Float64(0), distance, WAVELENGTH, paraxial=by_slopes)
    imag, real = (np.array(part, float) for part in (factor.imag, factor.real))
    turns = np.unwrap(np.arctan2(imag, real)) / (2 * np.pi)
    return np.array([(turns + cosine * (place / in_millimetres(WAVELENGTH))).max() for place in away])
