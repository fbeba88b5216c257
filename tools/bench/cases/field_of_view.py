"""Wavefronts of points over the field of thin main lenses, as the methods for many points at once take them.

Coherent and partial reconstructions and laser light apply phases in the main lens's pupil, and let light propagate by
slopes or by direction cosines. Of a point on the axis, half-way to the corner of the field, and in the corner, light
is taken through a pupil with the phases and the law that each method uses. The wavefront is compared with the sphere
that converges to the point's image, or, for light that moves by slopes, with the parabola that does.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import numpy as np
from numpy.typing import NDArray

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.lenses.thin import ThinLens
from mitsuba_plenoptic.light.optical_system import OpticalSystem, is_paraxial
from mitsuba_plenoptic.optics.rays import slopes_to_cosines
from mitsuba_plenoptic.optics.waves import in_millimetres, transfer
from mitsuba_plenoptic.prescription.lens_data import conjugate_distance
from mitsuba_plenoptic.refocus.conjugates import ThinConjugates
from mitsuba_plenoptic.runtime.backend import array_module

from .. import Row, at_most, case
from .lens_models import MODELS, WAVELENGTH, camera_of, distance_of

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
