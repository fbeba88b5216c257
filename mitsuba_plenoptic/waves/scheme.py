"""The plan of diffraction of cameras with and without a microlens array."""

import functools
from typing import cast

from ..camera import PlenopticCamera
from ..fields import OpticalSystem
from ..lenses import ThinLens
from ..optics import guards, in_millimetres
from ..rays import LensChoice
from .accuracy import FINER, USUAL
from .array_field import LensWaves
from .phase_space import PhaseSpace
from .pupil_diffraction import PupilDiffraction

Plan = PhaseSpace | PupilDiffraction
"""The diffraction of a camera at one wavelength, as functions of rays and kernels of images."""


def diffraction_of(camera: PlenopticCamera, wavelength: float) -> LensWaves | PupilDiffraction:
    """Return what has the spots of a camera's lenses, or of its pupil without an array, and their width."""
    if camera.lens_data.images_stop:
        from .stop_image import LensDiffraction

        return LensDiffraction(camera, wavelength)
    return (LensWaves if camera.has_array else PupilDiffraction)(camera, wavelength)


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
    if camera.lens_data.images_stop:
        from .stop_image import LensDiffraction

        return LensDiffraction(camera, wavelength, fine, shortest)
    if not camera.has_array:
        return PupilDiffraction(camera, wavelength, fine, shortest)
    # Light of too many lenses for a pixel is refused before it is planned.
    LensChoice.of_pixels(camera, camera.pupil_radius, 1.0)
    accuracy = FINER if fine else USUAL
    return PhaseSpace.of(camera, wavelength, accuracy, shortest=shortest, longest=longest, beside_far=beside_far)
