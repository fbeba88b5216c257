"""References of studies: spots, contrasts, verdicts, and ramps by pairs of pupil points."""

import cases
import numpy as np
import pytest
from cases import spot_filtered

from mitsuba_plenoptic import PlenopticCamera
from tools.bench.cases import resolution
from tools.bench.cases.resolution import WAVELENGTH
from tools.bench.scenes.wall_diffraction import expected


def test_the_spot_of_a_square_lens():
    # A spot of 4 pixels to its first zero.
    pixel = WAVELENGTH * 1e-6 * 8 / 4
    camera = PlenopticCamera(detector_width=128 * pixel, resolution=(128, 128))
    point = np.zeros((128, 128))
    point[64, 64] = 1
    spot = spot_filtered(point, camera)
    x = (np.arange(128) - 64) / 4
    # Periodic in twice the detector, so the far tails differ a little.
    assert spot == pytest.approx(np.outer(np.sinc(x) ** 2, np.sinc(x) ** 2) / 16, abs=2e-4)
    assert spot[64, 68] == pytest.approx(0, abs=2e-4)


def test_contrasts_in_focus_have_closed_forms():
    paper, hexagonal = (resolution.camera_of(name, 16) for name in ("paper", "hexagonal"))
    nyquist = 1 / (2 * paper.mla_pitch)
    # sinc(1/2) along x; turned by 45 degrees the square of sinc(1/2 cos 45).
    assert resolution.in_focus(paper, 240.0, nyquist, 0.0, "ray") == pytest.approx(2 / np.pi, abs=1e-5)
    assert resolution.in_focus(paper, 240.0, nyquist, 45.0, "ray") == pytest.approx(np.sinc(0.5**1.5) ** 2, abs=1e-5)
    # The pupil of f/12 passes 1 / (633e-6 * 12) per millimetre; near zero its transfer function has the slope 4 / pi.
    fine = 0.1
    wave, ray = (resolution.in_focus(paper, 240.0, fine, 0.0, model) for model in ("wave", "ray"))
    assert 1 - wave / ray == pytest.approx(4 / np.pi * fine * 633e-6 * 12, rel=1e-3)
    # A hexagon of the same width is the narrower lens, alike in six directions.
    at = [resolution.in_focus(hexagonal, 240.0, nyquist, angle, "ray") for angle in (0.0, 60.0, 120.0)]
    assert at == pytest.approx([at[0]] * 3, abs=1e-4) and at[0] > 2 / np.pi


CAMERA = PlenopticCamera(detector_width=0.768, resolution=(192, 192))
RED = 633.0


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
    width = RED * 1e-6 * camera.mla_distance / camera.mla_pitch
    dx, dy = (np.subtract.outer(P[seen], P) for P in (x, y))
    weight = np.sinc(dx / width) ** 2 * np.sinc(dy / width) ** 2
    slope = -(place[0] + kappa * dx) / (half * camera.mla_pitch)
    return (weight * radiance(slope)).sum() / weight.sum()


@pytest.mark.parametrize("distance", [*(pytest.param(g, marks=pytest.mark.slow) for g in (150.0, 1000.0)), np.inf])
def test_a_ramp_is_the_sum_over_pairs_of_pupil_points(distance):
    image = expected(CAMERA, distance, RED, "ramp")
    known = cases.known_radiance(CAMERA, "ramp")
    for column, row in ((0, 0), (1, 6), (11, 3)):
        value = by_pairs(CAMERA, distance, column, row, lambda slope: cases.wall_radiance(slope, "ramp"))
        assert image[row, column] == pytest.approx(value, abs=0.004)
    assert np.abs(image - known).max() > 0.01


def test_nothing_is_left_out_of_white_or_in_focus():
    np.testing.assert_allclose(expected(CAMERA, 1000.0, RED, "white"), 1, atol=1e-9)
    sharp = expected(CAMERA, CAMERA.focus_distance, RED, "ramp")
    np.testing.assert_allclose(sharp, np.tile(cases.known_radiance(CAMERA, "ramp"), (12, 1)), atol=1e-6)
