"""Captures of laser light: realisations, resumed runs, statistics against closed forms, and counts of modes."""

import math

import numpy as np
import pytest
from stopped_runs import StoppedError, stopped_before
from wave_cases import HALF, WAVELENGTH, error, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator, Checkpoint, InputError, Job, PlenopticCamera, laser
from tools.bench.cases import speckle

CAMERA = small_camera(4, **HALF)
POINTS = scattered(20, distances=(119.5, 120.5), image=0.1)


def operator_of(points=POINTS, camera=CAMERA):
    return CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field")


@pytest.mark.slow
def test_modes_average_independent_patterns():
    operator, weights, seen = operator_of(), np.linspace(0, 1, 20), []
    two = laser.coherent_capture(
        operator, weights, modes=2, seed=4, job=Job(progress=lambda done, total: seen.append((done, total)))
    )
    assert seen == [(0, 2), (1, 2), (2, 2)]
    assert np.array_equal(two, laser.coherent_capture(operator, weights, modes=2, seed=4))
    one = laser.coherent_capture(operator, weights, modes=1, seed=4)
    assert error(one, two) > 0.1
    assert error(laser.coherent_capture(operator, weights, modes=2, seed=5), two) > 0.1
    # The first of the two modes is the only one of a single mode.
    other = 2 * two - one
    assert other.min() > -1e-4 * other.max()
    assert other.sum() == pytest.approx(one.sum(), rel=0.3)


def test_a_single_point_has_its_point_spread_whatever_its_phase():
    operator = operator_of(POINTS[:1])
    for seed in (0, 1):
        assert error(laser.coherent_capture(operator, [4.0], modes=2, seed=seed), operator.forward([4.0])) < 1e-4


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
    sums = rows.reshape(128, per_pixel, 128, per_pixel).sum((1, 3)) * (field.pitch / 4) ** 2
    assert error(image, sums) < 0.002


def test_a_stopped_capture_resumes_with_the_same_bits(tmp_path):
    operator, path = operator_of(), tmp_path / "speckle.checkpoint"

    def compute(existing="refuse", progress=None, **changes):
        with Checkpoint(path, existing) as keeper:
            job = Job(progress, keeper=keeper)
            return laser.coherent_capture(operator, np.ones(20), **{"modes": 3, "seed": 1, **changes}, job=job)

    whole, seen = compute(), []
    with pytest.raises(StoppedError), stopped_before(lambda sums: len(sums) == 2):
        compute()
    assert path.exists()
    with pytest.raises(InputError, match="modes"):
        compute("resume", modes=4)
    assert np.array_equal(compute("resume", lambda done, total: seen.append(done)), whole)
    assert seen == [2, 3]


@pytest.mark.slow
def test_the_mean_over_modes_is_the_incoherent_capture():
    camera = speckle.SMALL.replace(detector_width=0.064, resolution=(32, 32))
    points, weights = scattered(20, distances=(119.5, 120.5), image=0.03), np.random.default_rng(0).random(20)
    mean = laser.coherent_capture(operator_of(points, camera), weights, modes=60, seed=2)
    exact = CaptureOperator(camera, points, wavelength=WAVELENGTH).forward(weights)
    bright = exact > 0.2 * exact.max()
    assert mean[bright].sum() == pytest.approx(exact[bright].sum(), rel=0.1)
    # Each pixel scatters by its contrast, at most 1, over the root of the modes.
    assert 0.4 / math.sqrt(60) < np.sqrt(np.mean((mean[bright] / exact[bright] - 1) ** 2)) < 1.15 / math.sqrt(60)


@pytest.fixture(scope="module")
def found():
    camera = speckle.OPEN.replace(detector_width=0.8, resolution=(125, 125))
    return speckle.patterns(camera, 16, 4)


def test_contrast(found):
    patterns, _ = found
    # 1,775 grains: 3.5 times the scatter of about 1 / sqrt(grains)
    for modes in (1, 2, 4):
        assert speckle.contrast(np.mean(patterns[:modes], axis=0)) == pytest.approx(1 / math.sqrt(modes), rel=0.08)


def test_grains(found):
    patterns, pitch = found
    widths = [speckle.grain_width(pattern, pitch) for pattern in patterns]
    camera = speckle.OPEN
    exact = 1.029 * WAVELENGTH * 1e-6 * camera.mla_distance / (2 * camera.aperture_radius)
    assert np.mean(widths) == pytest.approx(exact, rel=0.03)


def test_negative_exponential_statistics(found):
    patterns, pitch = found
    samples, p = speckle.exponential_test(patterns[0], pitch)
    assert samples > 900
    assert p > 0.01
    # The mean of two patterns has another distribution, which the test sees.
    assert speckle.exponential_test(np.mean(patterns[:2], axis=0), pitch)[1] < 0.01


def test_van_cittert_zernike():
    assert speckle.visibility(1000) < 0.01


def test_young():
    period, contrast = speckle.fringes()
    assert period < 0.005
    assert contrast < 0.005


def modes_of(source, pupil):
    """Return the modes of a source and a pupil of small angular radii."""
    options = {"source_diameter": 200 * source, "source_distance": 100.0}
    return laser.mode_count(PlenopticCamera(), wavelength=633, distance=5 / pupil, **options)


def test_tilted_sources_average_as_many_patterns_as_the_closed_form():
    camera = speckle.OPEN.replace(detector_width=0.6, resolution=(94, 94))
    points = speckle.wall(camera, 16)
    operator, rng = operator_of(points, camera), np.random.default_rng(0)
    rough = np.exp(2j * np.pi * rng.random(len(points)))
    pupil = camera.aperture_radius / 120
    source, count = 1.5 * pupil, 24
    # A sunflower of source points; each tilts the phases of one and the same surface.
    radius, angle = source * np.sqrt((np.arange(count) + 0.5) / count), np.arange(count) * math.pi * (3 - math.sqrt(5))
    total = 0.0
    for tilt in np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1):
        phase = points[:, :2] @ tilt / (WAVELENGTH * 1e-6)
        samples = operator.field(rough * np.exp(2j * np.pi * phase), plane="array").samples
        inner = slice(samples.shape[0] // 8, -samples.shape[0] // 8)
        total = total + np.abs(samples[inner, inner]) ** 2
    assert 1 / speckle.contrast(total) ** 2 == pytest.approx(modes_of(source, pupil), rel=0.15)


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
    simulated = (intensity.mean() / intensity.std()) ** 2
    found = laser.mode_count(PlenopticCamera(), wavelength=633, distance=240, bandwidth=2, roughness=height)
    assert found == pytest.approx(simulated, rel=0.1)


def test_limits_of_mode_counts():
    for tiny in (1e-6, 1e-200):
        assert modes_of(tiny, 0.01) == pytest.approx(1, rel=1e-3)
    # A source far wider than the pupil: the ratio of the solid angles over the integral of the squared overlap.
    s = np.linspace(0, 1, 100001)
    overlap = 2 / math.pi * (np.arccos(s) - s * np.sqrt(1 - s**2))
    integral = np.trapezoid(overlap**2 * s, s) * 8 * math.pi
    assert modes_of(10, 0.01) == pytest.approx(math.pi * 10**2 / (0.01**2 * integral), rel=0.01)
    assert laser.mode_count(PlenopticCamera(), wavelength=633, distance=240) == 1
    # In a scene: 2.2 times the ratio of the solid angles of a wide source and the pupil, of a radius of 5 mm.
    wide = laser.mode_count(PlenopticCamera(), wavelength=633, distance=240, source_diameter=200, source_distance=100)
    assert wide == pytest.approx(2.2 * (100 / 100) ** 2 / (5 / 240) ** 2, rel=0.03)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: laser.coherent_capture(operator_of(), np.ones(3)), r"weights of shape \(3,\): it must be \(20,\)"),
        (lambda: laser.coherent_capture(operator_of(), -np.ones(20)), "weights: -1 is among them"),
        (lambda: laser.coherent_capture(operator_of(), np.full(20, 1e80)), r"weights: 1e\+80 is among them: at most"),
        (
            lambda: laser.coherent_capture(operator_of(np.empty((0, 3))), []),
            "points: coherent fields need at least one",
        ),
        (lambda: laser.coherent_capture(CAMERA, [1]), "operator of type PlenopticCamera: it must be a CaptureOperator"),
        (lambda: laser.coherent_capture(operator_of(), np.ones(20), modes=0), "modes = 0: it must be at least 1"),
        (lambda: laser.coherent_capture(operator_of(), np.ones(20), modes=1.5), "modes = 1.5: it must be a whole"),
        (
            lambda: laser.mode_count(PlenopticCamera(), wavelength=633, distance=240, source_diameter=1),
            "source_distance: a source_diameter needs it",
        ),
        (
            lambda: laser.mode_count(PlenopticCamera(), wavelength=633, distance=240, bandwidth=1),
            "roughness: a bandwidth needs it",
        ),
        (
            lambda: laser.mode_count(PlenopticCamera(), wavelength=633, distance=-1),
            "distance = -1: it must be greater than 0",
        ),
    ],
)
def test_refusals(make, message):
    with pytest.raises(InputError, match=message):
        make()
