"""What diffraction leaves of a ramp, as the cases compute it, against a plain sum over pairs of pupil points."""

import cases
import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from tools.bench.scenes.wall_diffraction import expected

CAMERA = PlenopticCamera(detector_width=0.768, resolution=(192, 192))
WAVELENGTH = 633.0


def by_pairs(camera, distance, column, row, radiance, count=48):
    """One bin: all pairs of points of the pupil, a square lens's squared sinc between them."""
    step = 2 * camera.aperture_radius / count
    line = (np.arange(count) + 0.5) * step - camera.aperture_radius
    x, y = (axis.ravel() for axis in np.meshgrid(line, line))
    inside = np.hypot(x, y) <= camera.aperture_radius
    x, y = x[inside], y[inside]
    nearness = 0.0 if np.isinf(distance) else 1 / distance
    kappa = 1 + camera.mla_distance * (nearness - 1 / camera.focal_length)
    half = camera.bin_count[0] / 2
    place = [(index + 0.5 - half) * camera.mla_pitch for index in (column, row)]
    seen = np.maximum(*(np.abs(at + kappa * P) for at, P in zip(place, (x, y), strict=True))) <= half * camera.mla_pitch
    width = WAVELENGTH * 1e-6 * camera.mla_distance / camera.mla_pitch
    dx, dy = (np.subtract.outer(P[seen], P) for P in (x, y))
    weight = np.sinc(dx / width) ** 2 * np.sinc(dy / width) ** 2
    slope = -(place[0] + kappa * dx) / (half * camera.mla_pitch)
    return (weight * radiance(slope)).sum() / weight.sum()


@pytest.mark.parametrize("distance", [*(pytest.param(g, marks=pytest.mark.slow) for g in (150.0, 1000.0)), np.inf])
def test_a_ramp_is_the_sum_over_pairs_of_pupil_points(distance):
    image = expected(CAMERA, distance, WAVELENGTH, "ramp")
    known = cases.known_radiance(CAMERA, "ramp")
    for column, row in ((0, 0), (1, 6), (11, 3)):
        value = by_pairs(CAMERA, distance, column, row, lambda slope: cases.wall_radiance(slope, "ramp"))
        assert image[row, column] == pytest.approx(value, abs=0.004)
    assert np.abs(image - known).max() > 0.01


def test_nothing_is_left_out_of_white_or_in_focus():
    np.testing.assert_allclose(expected(CAMERA, 1000.0, WAVELENGTH, "white"), 1, atol=1e-9)
    sharp = expected(CAMERA, CAMERA.focus_distance, WAVELENGTH, "ramp")
    np.testing.assert_allclose(sharp, np.tile(cases.known_radiance(CAMERA, "ramp"), (12, 1)), atol=1e-6)
