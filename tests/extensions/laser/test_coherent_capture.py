"""Captures of laser light: realisations, resumed runs, statistics against closed forms, and counts of modes."""

import math

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error, scattered, small_camera
from refusals import refused
from scipy.stats import kstest

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, laser

CAMERA = small_camera(4, **HALF)
POINTS = scattered(20, distances=(119.5, 120.5), image=0.1)


def operator_of(points=POINTS, camera=CAMERA):
    return CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field")


LENGTH = WAVELENGTH * 1e-6
OPEN = PlenopticCamera(
    focal_length=40, aperture_radius=1, mla_distance=60, mla_focal_length=1e4, mla_pitch=0.64, detector_distance=0.1,
    detector_width=2.3, resolution=(360, 360),
)  # fmt: skip
"""A camera whose microlenses have no power: its speckle is that of a plain camera, the same everywhere."""
DISTANCE = 120.0
"""Distance that both focus on the array, at half the size."""


def rough_wall(camera, per_spot, seed=0):
    """Return points of a rough wall in focus, in a jittered grid with some in each square of side lambda / NA."""
    spot = LENGTH * DISTANCE / (2 * camera.aperture_radius)
    side = camera.detector_width * DISTANCE / camera.mla_distance + 8 * spot
    count = math.ceil(side / spot * math.sqrt(per_spot))
    cells = np.stack(np.meshgrid(np.arange(count), np.arange(count)), -1).reshape(-1, 2)
    place = (cells + np.random.default_rng(seed).random(cells.shape)) * (side / count) - side / 2
    return np.column_stack([place, np.full(len(place), DISTANCE)])


@pytest.mark.slow
def test_speckle_is_fully_developed():
    """Contrast falls with the root of the modes, and intensity is exponential."""
    camera = OPEN.replace(detector_width=0.8, resolution=(250, 250))
    operator = operator_of(rough_wall(camera, 16), camera)
    one, four = (laser.coherent_capture(operator, np.ones(len(operator.points)), modes=m, seed=1) for m in (1, 4))
    # 1,775 grains: 3.5 times the scatter of about 1 / sqrt(grains).
    for modes, image in ((1, one), (4, four)):
        assert image.std(dtype=float) / image.mean(dtype=float) == pytest.approx(1 / math.sqrt(modes), rel=0.08)
    # Samples an Airy radius apart; the mean of four patterns has another distribution.
    step = math.ceil(1.22 * LENGTH * camera.mla_distance / (2 * camera.aperture_radius) / camera.pixel_size)
    few = [image[::step, ::step].ravel() / image.mean(dtype=float) for image in (one, four)]
    assert kstest(few[0], "expon").pvalue > 0.01 > kstest(few[1], "expon").pvalue


def test_young():
    """Images d apart, L behind the array: fringes of period lambda L / d, from fields that add."""
    camera = OPEN.replace(aperture_radius=2.5, detector_width=2.4, resolution=(600, 600))
    near, apart, ratio = 60.0, 0.15, 0.5
    operator = operator_of(np.array([(-apart / 2, 0, near), (apart / 2, 0, near)]), camera)
    both, one, two = (operator.field(given, plane="array") for given in ([1, ratio], [1, 0], [0, ratio]))
    image = 1 / (1 / camera.focal_length - 1 / near)
    period = LENGTH * (image - camera.mla_distance) / (apart * image / near)
    x = both.origin[0] + np.arange(both.samples.shape[1]) * both.pitch
    inner = np.abs(x) < 0.7
    phase = np.unwrap(np.angle((one.samples * two.samples.conj())[np.ix_(inner, inner)].sum(0)))
    assert abs(np.polyfit(x[inner], phase, 1)[0]) * period / (2 * math.pi) == pytest.approx(1, abs=0.005)
    assert error(one.samples + two.samples, both.samples) < 1e-5


def test_pixels_are_integrals_of_the_squared_field():
    operator, rng = operator_of(), np.random.default_rng((7, 0))
    field = operator.field(np.exp(2j * np.pi * rng.random(20)))
    image = laser.coherent_capture(operator, np.ones(20), seed=7)
    # Twice as many samples hold the band of the intensity; its integral over a pixel is then a sum of samples.
    size = field.samples.shape[0]
    spectrum = np.fft.fftshift(np.fft.fft2(field.samples))
    fine = np.abs(np.fft.ifft2(np.fft.ifftshift(np.pad(spectrum, size // 2 * 3))) * 16) ** 2
    first = round((-CAMERA.detector_width / 2 - field.origin[0]) / field.pitch * 4)
    per_pixel = round(CAMERA.pixel_size / field.pitch * 4)
    # By the trapezoidal rule, whose last sample is the first of the next pixel.
    for axis in (0, 1):
        fine = (fine + np.roll(fine, -1, axis)) / 2
    rows = fine[first : first + 128 * per_pixel, first : first + 128 * per_pixel]
    assert error(image, rows.reshape(128, per_pixel, 128, per_pixel).sum((1, 3)) * (field.pitch / 4) ** 2) < 0.002


def modes_of(source, pupil):
    options = {"source_diameter": 200 * source, "source_distance": 100.0}
    return laser.mode_count(PlenopticCamera(), wavelength=633, distance=5 / pupil, **options)


def test_modes_of_a_spectrum():
    rng = np.random.default_rng(0)
    wavelength, bandwidth, height = 633e-6, 2e-6, 0.05
    heights = rng.normal(size=(3000, 200)) * height
    moduli = rng.normal(size=heights.shape) + 1j * rng.normal(size=heights.shape)
    sigma = 2 * math.pi * bandwidth / wavelength**2 / (2 * math.sqrt(2 * math.log(2)))
    intensity = np.zeros(3000)
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    for k, weight in zip(2 * math.pi / wavelength + sigma * nodes, weights, strict=True):
        intensity += weight * np.abs((moduli * np.exp(2j * k * heights)).sum(1)) ** 2
    found = laser.mode_count(PlenopticCamera(), wavelength=633, distance=240, bandwidth=2, roughness=height)
    assert found == pytest.approx((intensity.mean() / intensity.std()) ** 2, rel=0.1)


def test_limits_of_mode_counts():
    for tiny in (1e-6, 1e-200):
        assert modes_of(tiny, 0.01) == pytest.approx(1, rel=1e-3)
    # A source far wider than the pupil: the ratio of the solid angles over the integral of the squared overlap.
    s = np.linspace(0, 1, 100001)
    overlap = 2 / math.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))
    integral = np.trapezoid(overlap**2 * s, s) * 8 * math.pi
    assert modes_of(10, 0.01) == pytest.approx(math.pi * 10**2 / (0.01**2 * integral), rel=0.01)


test_refusals = refused(
    (lambda: laser.coherent_capture(operator_of(), -np.ones(20)), r"weights\[0\] = -1: "),
    (lambda: laser.coherent_capture(operator_of(), np.ones(3)), r"weights of shape \(3,\)"),
    (lambda: laser.coherent_capture(operator_of(), np.full(20, 1e80)), r"weights\[0\] = 1e\+80: "),
    (lambda: laser.coherent_capture(operator_of(np.empty((0, 3))), []), "points: "),
    (lambda: laser.coherent_capture(operator_of(), np.ones(20), modes=1.5), "modes = 1.5"),
    (lambda: laser.mode_count(CAMERA, wavelength=633, distance=240, source_diameter=1), "source_distance"),
    (lambda: laser.mode_count(CAMERA, wavelength=633, distance=240, bandwidth=1), "roughness"),
)
