"""The plan of diffraction of cameras with and without a microlens array."""

from __future__ import annotations

import functools
from typing import Any, cast

from ..camera import PlenopticCamera
from ..fields import OpticalSystem
from ..lenses import ThinLens
from ..optics import guards, in_millimetres
from .accuracy import FINER, USUAL
from .phase_space import PhaseSpace
from .pupil_diffraction import PupilDiffraction

Plan = PhaseSpace | PupilDiffraction
"""The diffraction of a camera at one wavelength, as functions of rays and kernels of images."""


def plan_type(camera: PlenopticCamera) -> type[Plan]:
    """Return the class of a camera's plans."""
    return PhaseSpace if camera.has_array else PupilDiffraction


def check_screen(camera: PlenopticCamera, wavelength: float) -> None:
    """Refuse a phase screen whose slopes vary within the points of the pupil whose light interferes at one sample.

    These are as far apart as the pupil's points that a microlens, or a pixel without an array, tells from each other.
    """
    _, width = camera.image_samples
    apart = min(in_millimetres(wavelength) * camera.pupil_distance / width, camera.pupil_radius)
    lens = cast(ThinLens, OpticalSystem(camera, wavelength).lens)
    guards.check(guards.SCREEN, lens.beyond_slopes(apart, wavelength))


@functools.lru_cache(maxsize=16)
def plan_of(
    camera: PlenopticCamera,
    wavelength: float,
    fine: bool,
    shortest: float,
    longest: float | None = None,
    beside_far: bool = False,
) -> Plan:
    """Return a usual or a finer plan of a camera, cached for further captures.

    `shortest` and `longest` are the extreme wavelengths among the capture's plans, and `beside_far` says that one of
    them is far from focus.
    """
    if not camera.has_array:
        return PupilDiffraction(camera, wavelength, fine, shortest)
    accuracy = FINER if fine else USUAL
    options: dict[str, Any] = {
        "window": accuracy.window,
        "radial": accuracy.radial,
        "tolerance": accuracy.tolerance,
        "shortest": shortest,
        "longest": longest,
        "beside_far": beside_far,
    }
    plan = PhaseSpace(camera, wavelength, degree=accuracy.degree, **options)
    if plan.lands_by_point or plan.defocus <= USUAL.high_defocus:
        return plan
    return PhaseSpace(camera, wavelength, degree=accuracy.degree + 2, **options)
