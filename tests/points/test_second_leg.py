"""What pixels record of the light of points by its direction behind the lenses: absorption and oblique response."""

import numpy as np
import pytest
from cameras import HALF, error, small_camera

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.points.point_spread import point_fields

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
