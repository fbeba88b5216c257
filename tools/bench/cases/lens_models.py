"""Thin main lenses of both models: stars against the Airy pattern, and wavefronts of points over the field.

Coherent and partial reconstructions and laser light apply phases in the main lens's pupil, and let light propagate by
slopes or by direction cosines. Of a point on the axis, half-way to the corner of the field, and in the corner, light
is taken through a pupil with the phases and the law that each method uses. The wavefront is compared with the sphere
that converges to the point's image, or, for light that moves by slopes, with the parabola that does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import cast

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem, is_paraxial
from mitsuba_plenoptic.lenses.thin import ThinLens
from mitsuba_plenoptic.optics.rays import slopes_to_cosines
from mitsuba_plenoptic.optics.waves import in_millimetres, transfer
from mitsuba_plenoptic.points.full_fields import point_fields
from mitsuba_plenoptic.prescription.lens_data import conjugate_distance
from mitsuba_plenoptic.refocus.conjugates import ThinConjugates
from mitsuba_plenoptic.runtime.backend import array_module

from .. import Row, at_most, case

WAVELENGTH = 550.0
MODELS = ("ideal", "parabolic")
_FREQUENCY, _MODES, _CONTRAST = 0.25, 60, 0.35


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
                        camera.row_pitch * place
                        + round(camera.mla_distance * math.tan(math.radians(angle)) / camera.row_pitch)
                        * camera.row_pitch
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


def distance_of(camera: PlenopticCamera, blur: float) -> float:
    """Return the distance of the plane whose points light discs of some lenses' radius, behind the focused plane."""
    power = (1 - blur * camera.row_pitch / camera.aperture_radius) / camera.mla_distance
    return 1 / (1 / camera.focal_length - power)


def scene_of(camera: PlenopticCamera, distance: float, *, white: bool = False) -> mi.Scene:
    """Return a scene of one wall that fills the view, of smooth random radiance without frequencies near the bins'."""
    bins = camera.bin_count[0] + 2 * (2 + math.ceil(camera.blur_diameter(distance) / camera.row_pitch))
    generator, place = np.random.default_rng(0), (np.arange(8 * bins) + 0.5) / 8
    texture = np.ones((8 * bins, 8 * bins))
    for _ in range(_MODES):
        fx, fy = generator.uniform(-_FREQUENCY, _FREQUENCY, 2)
        wave = 2 * np.pi * (fx * place + fy * place[:, None] + generator.uniform())
        texture += _CONTRAST * math.sqrt(2 / _MODES) * np.cos(wave)
    half = bins * camera.row_pitch * distance / camera.mla_distance / 2
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
            corner = np.array(camera.bin_count) * camera.row_pitch / 2
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
