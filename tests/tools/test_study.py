"""References of studies: spots, contrasts, verdicts, and ramps by pairs of pupil points."""

import cases
import numpy as np
import pytest
from cases import spot_filtered
from scipy.special import erf, erfinv

from mitsuba_plenoptic import Capture, PlenopticCamera
from tools.bench.cases import resolution
from tools.bench.cases.resolution import WAVELENGTH, difference, falls
from tools.bench.registry import load
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


def test_noise_does_not_count_as_difference():
    random = np.random.default_rng(0)
    rays, waves = ([mean + 0.5 * random.standard_normal((256, 256)) for _ in range(2)] for mean in (1.1, 1.0))
    assert difference(rays, waves, 1) == pytest.approx(0.1, abs=0.02)
    assert difference(rays, waves, 4) == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize(
    ("rays", "verdict"),
    [(0.1, "ok"), (0.25, "FAILED: by_pixels 1.25"), (0.4, "FAILED: by_pixels 2, at most 1; by_len")],
)
def test_rays_must_come_nearer_with_larger_pixels_and_wider_lenses(rays, verdict):
    def row(pitch, binning, value):
        return {"f_number": 8.0, "pitch": pitch, "focus": "in focus", "binning": binning, "rays": value}

    others = [row(0.064, 1, 0.5), row(0.064, 2, 0.3), row(0.128, 1, 0.2)]
    last = row(0.128, 2, rays)
    assert load()["ray-limits"].verdict(last | falls(last, others)).startswith(verdict)
    assert falls(others[0], others[:0]) == {"by_pixels": None, "by_lenses": None}


def test_contrasts_in_focus_have_closed_forms():
    paper, hexagonal = (resolution.camera_of(name, 16) for name in ("paper", "hexagonal"))
    nyquist = 1 / (2 * paper.mla_pitch)
    # sinc(1/2) along x; turned by 45 degrees the square of sinc(1/2 cos 45).
    assert resolution.in_focus(paper, 240.0, nyquist, 0.0, "ray") == pytest.approx(2 / np.pi, abs=1e-5)
    assert resolution.in_focus(paper, 240.0, nyquist, 45.0, "ray") == pytest.approx(np.sinc(0.5**1.5) ** 2, abs=1e-5)
    # The pupil of f/12 passes 1 / (633e-6 * 12) per millimetre; near zero its transfer function has the slope 4 / pi.
    fine = 0.1
    fall = 1 - resolution.in_focus(paper, 240.0, fine, 0.0, "wave") / resolution.in_focus(
        paper, 240.0, fine, 0.0, "ray"
    )
    assert fall == pytest.approx(4 / np.pi * fine * 633e-6 * 12, rel=1e-3)
    # A hexagon of the same width is the narrower lens, alike in six directions.
    at = [resolution.in_focus(hexagonal, 240.0, nyquist, angle, "ray") for angle in (0.0, 60.0, 120.0)]
    assert at == pytest.approx([at[0]] * 3, abs=1e-4) and at[0] > 2 / np.pi


def test_contrast_and_edges_of_known_samples():
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.3, 0.3, 41), np.linspace(-0.3, 0.3, 41)))
    places = np.array([x, y])
    wave = 2 + 0.6 * np.cos(2 * np.pi * 5 * (x * np.cos(np.pi / 6) + y / 2) + 1)
    assert resolution.contrast(wave, places, 5.0, 30.0) == pytest.approx(0.3)
    turned = np.radians(resolution.EDGE_ANGLE)
    edge = erf((x * np.cos(turned) + y * np.sin(turned) - 0.01) / 0.05)
    assert resolution.edge_width(edge, places, 0.1) == pytest.approx(2 * erfinv(0.8) * 0.5)


def test_the_sums_of_lenses_are_theirs():
    camera = resolution.camera_of("hexagonal", 16)
    to_array = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    x, y = np.meshgrid(*(camera.pixel_coordinates(axis) * to_array for axis in (0, 1)))
    i, j = camera.lattice.cell(x, y)
    image = np.stack([i, j, i - j], axis=-1)
    values, places = resolution.sums_over_lenses(Capture(image.astype(np.float32), camera))
    assert np.array(camera.lattice.centre(*values[:, :2].T)) == pytest.approx(places)
    assert values[:, 2] == pytest.approx(values[:, 0] - values[:, 1])


@pytest.mark.parametrize(
    ("case", "figures", "verdict"),
    [
        ("resolution", {"difference": 0.019, "apart": 0.04}, "ok"),
        ("resolution", {"difference": 0.021}, "FAILED: difference"),
        ("arrays.pixels-and-range", {"focus": 0.5, "wider": 1.2}, "ok"),
        ("arrays.pixels-and-range", {"focus": 0.3, "wider": None}, "FAILED: focus"),
    ],
)
def test_verdicts_of_studies_come_out_both_ways(case, figures, verdict):
    assert load()[case].verdict(figures).startswith(verdict)


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
