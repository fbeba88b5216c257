"""Points through cameras as they are fitted, with absorption and oblique response: light, places, powers."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, TABLE, UNEVEN, WAVELENGTH, error, small_camera

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, Vignetting, render_capture
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points.point_spread import point_fields
from mitsuba_plenoptic.points.units import radiance_weight

FITTED = PlenopticCamera(
    detector_width=0.32, resolution=(80, 80), mla_rotation=3.0, mla_offset=(0.01, -0.02), vignetting=UNEVEN,
    mla_warp=(0.05, -0.02, 0.03, 0, 0, 0, 0, 0.02, 0.04, -0.03, 0, 0, 0, 0), mla_transmissions=TABLE,
    detector_blur=0.003,
)  # fmt: skip
"""Of 5 x 5 lenses with 16 x 16 pixels."""


@pytest.mark.slow
def test_points_of_a_plane_are_the_white_of_a_scene():
    """Rays, waves of scenes, and points have the same pupil, lenses and blur."""
    # Waves of scenes diffract at the rim alone, points at the outline, too: it lies near the rim.
    gentle = Vignetting(
        radius=[0.9, 0.03, -0.02, 0, 0.02, 0.03], slope_x=[0.1, 0.05, -0.1], slope_y=[-0.1],
        apodisation_2=[-0.2, 0, 0.1], scale=0.16,
    )  # fmt: skip
    crop = FITTED.replace(vignetting=gentle, crop_offset=(32, 32), crop_size=(16, 16))
    # Closer than half a period of the finest fringes, lambda b / 2 a; the light of points beyond is not recorded.
    step, reach = 0.0072, 0.032 + 0.2
    along = np.arange(-reach, reach, step) + step / 2
    x, y = (values.ravel() for values in np.meshgrid(along, along))
    points = np.column_stack([-2 * x, -2 * y, np.full(x.size, 240.0)])
    weight = radiance_weight(crop, OpticalSystem(crop, WAVELENGTH).lens, step**2)
    image = CaptureOperator(crop, points, wavelength=WAVELENGTH).forward(np.full(len(points), weight))
    scene = {"type": "scene", "sky": {"type": "constant"}, "camera": crop.to_sensor()}
    waves = {"type": "plenoptic_wave", "wavelength": WAVELENGTH, "path": {"type": "direct"}}
    white = render_capture(mi.load_dict(scene | {"integrator": waves}), spp=64).image
    assert error(image, white) < 0.05
    assert image.sum() == pytest.approx(white.sum(), rel=0.015)


def test_dimmed_light_is_a_part_of_the_light():
    """An apodised pupil passes 1 + a / 2 of a point's light, an outline of 0.6 its square."""
    small = PlenopticCamera(detector_width=0.256, resolution=(64, 64))
    points = np.array([[0.02, -0.03, 238.0], [-0.05, 0.01, 243.0]])
    for given, part in (
        (Vignetting(radius=1.0, apodisation_2=-0.5), 0.75),
        (Vignetting(radius=0.6), 0.36),
        (Vignetting(radius=1.0, slope_x=[0.4]), 1.0),
    ):
        plain, dimmed = (
            CaptureOperator(small.replace(vignetting=table), points, wavelength=WAVELENGTH) for table in (None, given)
        )
        assert dimmed.forward([1, 2]).sum() == pytest.approx(part * plain.forward([1, 2]).sum(), rel=0.015)


POINT = (0.05, -0.03, 231.0)
RESPONSE = {"pixel_response": (0, 1, 3, 0.3)}
ABSORBING = {"mla_absorption": 2.0}
ORDINARY = {"mla_lattice": "none", "detector_width": 0.08, "resolution": (40, 40)}


def spread(camera, **options):
    return mp.point_spread_function(camera, POINT, wavelength=550.0, **options)


def test_patches_against_full_fields():
    """Most of the light is lost behind the lenses, which no guard takes for light beyond the patches."""
    camera = small_camera(4, **RESPONSE, **ABSORBING)
    full = spread(camera, method="full_field")
    assert error(spread(camera), full) < 0.005
    assert full.sum() < 0.75 * spread(camera.replace(pixel_response=(), mla_absorption=0.0)).sum()


def test_an_ordinary_camera_has_the_mean_response_of_its_pupil():
    camera = mp.PlenopticCamera(**ORDINARY)
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 400)])
    inside = np.hypot(x, y) < 1
    angle = np.degrees(np.arctan(np.hypot(x, y)[inside] * camera.pupil_radius / camera.pupil_distance))
    for options in ({}, {"model": "ray"}):
        point = (0.0, 0.0, 240.0)
        dimmed, plain = (
            mp.point_spread_function(each, point, wavelength=550.0, **options)
            for each in (camera.replace(**RESPONSE), camera)
        )
        expected = np.interp(angle, [0, 3], [1, 0.3]).mean()
        assert dimmed.sum() / plain.sum() == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    "changes", [{"aperture_blades": 5}, {"pupil_apodisation": (-0.8, 0.0)}], ids=["blades", "apodised"]
)
def test_fields_of_a_point_have_the_power_of_its_pupil(changes):
    camera = small_camera(2, **HALF, **changes)
    pupil = point_fields(camera, (0.02, -0.01, 114.0), wavelength=550.0).pupil
    x, y = (start + pupil.pitch * np.arange(len(pupil.samples)) for start in pupil.origin)
    seen = np.abs(pupil.samples) ** 2
    expected = camera.aperture.power(*np.meshgrid(x / camera.pupil_radius, y / camera.pupil_radius))
    # Edges are soft over a sample.
    assert np.linalg.norm(seen / seen.sum() - expected / expected.sum()) < 0.1 * np.linalg.norm(seen / seen.sum())
    assert pupil.power == pytest.approx(1, abs=0.01)
