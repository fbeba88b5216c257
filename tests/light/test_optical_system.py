"""The main lens of a bound camera: which one it is, what it holds, and its pupil against closed forms."""

import numpy as np
import pytest

from mitsuba_plenoptic import CaptureOperator, InputError, Objective, PlenopticCamera
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.lenses.telecentric import TelecentricLens
from mitsuba_plenoptic.lenses.thin import DistortedLens, ThinLens
from mitsuba_plenoptic.light.optical_system import OpticalSystem

WAVELENGTH = 550.0
SMALL = {"detector_width": 0.256, "resolution": (64, 64)}
THIN = PlenopticCamera(**SMALL)
REAL = PlenopticCamera(main_lens="double_gauss", focus_distance=240.0, **SMALL)
MICROSCOPE = PlenopticCamera(main_lens=Objective(20.0, 0.4), mla_pitch=0.15, mla_focal_length=3.75, **SMALL)
POINTS = np.array([(0.0, 0.0, 240.0), (0.1, -0.2, 230.0)])


def test_the_factory_makes_the_lens_of_a_camera():
    assert main_lens(THIN) == ThinLens(80.0, 5.0, 120.0)
    assert isinstance(main_lens(THIN.replace(distortion=(1e-5, 0, 0, 0, 0))), DistortedLens)
    assert main_lens(MICROSCOPE) == TelecentricLens(MICROSCOPE.objective)
    assert main_lens(THIN, varying={"focal_length": 81.0}).focal_length == 81.0
    real = main_lens(REAL, WAVELENGTH)
    assert (real.wavelength, real.pupil_distance) == (WAVELENGTH, REAL.pupil_distance)


def test_fits_are_held_and_shared_by_systems_of_the_same_camera_and_wavelength():
    system = OpticalSystem(REAL, WAVELENGTH)
    lens = system.waves_of(POINTS)
    assert system.waves_of(POINTS) is lens
    assert system.waves_of_one(POINTS[0]) is system.waves_of_one(POINTS[0])
    assert OpticalSystem(REAL, WAVELENGTH).lens is system.lens
    assert OpticalSystem(REAL, WAVELENGTH + 1).lens is not system.lens


def test_sums_share_the_system_of_their_own_camera_only():
    system = OpticalSystem(REAL, WAVELENGTH)
    first, second = (
        CaptureOperator(REAL, [point], wavelength=WAVELENGTH, system=system) for point in POINTS[:1].repeat(2, 0)
    )
    assert first._plans.system_at(WAVELENGTH) is second._plans.system_at(WAVELENGTH)
    for camera, wavelength in ((THIN, WAVELENGTH), (REAL, 633.0)):
        with pytest.raises(InputError, match="bound to another camera"):
            CaptureOperator(camera, POINTS, wavelength=wavelength, system=system)


def test_the_start_of_rays_lies_within_the_bounds():
    for camera in (THIN, REAL, MICROSCOPE):
        lens, rng = main_lens(camera), np.random.default_rng(1)
        place = rng.uniform(-0.12, 0.12, (2, 200))
        pupil = rng.uniform(-1, 1, (2, 200)) * camera.pupil_radius
        (x, y, _), _, is_open = lens.ray(tuple(pupil), tuple(place))
        radius, _ = lens.start_bounds(0.17)
        is_open = np.broadcast_to(is_open, x.shape) & (np.hypot(*pupil) < camera.pupil_radius)
        assert np.hypot(x, y)[is_open].max() <= radius
