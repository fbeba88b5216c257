"""The detector against the equations of EMVA 1288."""

import numpy as np
import pytest
from scipy import stats

from mitsuba_plenoptic import Capture, Detector, PlenopticCamera, expose, read_capture, write_capture
from mitsuba_plenoptic.cli import main

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(256, 256))


def flat(value):
    return Capture(np.full(CAMERA.shape, value), CAMERA)


@pytest.mark.parametrize("photons", [0.0, 5.0, 300.0, 5000.0])
@pytest.mark.parametrize(
    "detector",
    [
        Detector(),
        Detector(quantum_efficiency=0.45, full_well=12000, dark_electrons=30, read_noise=7, bits=14, black_level=300),
        Detector(read_noise=0, bits=8, gain=1 / 25, black_level=2),
    ],
    ids=["default", "dark current", "coarse"],
)
def test_mean_and_variance_of_the_linear_model(detector, photons):
    numbers = detector.digital_numbers(np.full((600, 600), photons), np.random.default_rng(1)).astype(float)
    electrons = detector.quantum_efficiency * photons + detector.dark_electrons
    expected = detector.gain * electrons + detector.black_level
    variance = detector.gain**2 * (detector.read_noise**2 + electrons)
    if variance > 0.25:
        # Noise spreads over several numbers: rounding adds its own variance and no offset.
        variance += 1 / 12
        assert numbers.mean() == pytest.approx(expected, abs=5 * np.sqrt(variance / numbers.size) + 0.01)
        assert numbers.var() == pytest.approx(variance, rel=0.02)
    else:
        assert numbers.mean() == pytest.approx(expected, abs=0.5)


def test_shot_noise_is_poisson_not_normal():
    numbers = Detector(quantum_efficiency=1, read_noise=0, gain=1, full_well=1000, black_level=0).digital_numbers(
        np.full(200000, 0.5), np.random.default_rng(0)
    )
    fraction = np.bincount(numbers, minlength=4)[:4] / numbers.size
    assert fraction == pytest.approx([0.6065, 0.3033, 0.0758, 0.0126], abs=0.005)


def test_saturation():
    detector = Detector(full_well=1000, bits=10)
    numbers = detector.digital_numbers(np.array([1e4, 1e9, 1e30]), np.random.default_rng(0))
    assert numbers.dtype == np.uint16
    assert (numbers > 0.98 * 1023).all()
    assert numbers.max() <= 1023
    # With room above the full well, reading noise is still there and nothing is cut off.
    roomy = Detector(full_well=1000, bits=12, gain=1, read_noise=3, black_level=100)
    numbers = roomy.digital_numbers(np.full(20000, 1e6), np.random.default_rng(0))
    assert numbers.mean() == pytest.approx(1100, abs=0.2)
    assert numbers.std() == pytest.approx(3, rel=0.05)


@pytest.mark.parametrize(
    ("detector", "photons"),
    [
        (Detector(quantum_efficiency=1, full_well=1000, bits=12, read_noise=0), 1000),
        (Detector(quantum_efficiency=1, full_well=1000, bits=12, read_noise=0, gain=1, black_level=0), 1000),
        (Detector(quantum_efficiency=1, full_well=1e6, bits=10, read_noise=0, gain=1, black_level=23), 1000),
    ],
    ids=["both", "full well", "largest number"],
)
def test_saturated_pixels_are_counted(detector, photons):
    """Half of the Poisson distribution lies above its mean, which is where these saturate."""
    columns = np.repeat([0.5, 1.0, 2.0, 0.0], 64)
    found = expose(Capture(columns * np.ones((256, 1)), CAMERA), detector, photons=photons)
    expected = 64 * 256 * (1 + stats.poisson.sf(999, 1000))
    assert found.metadata["exposure"]["saturated_pixels"] == pytest.approx(expected, abs=5 * 64)
    assert expose(flat(0.5), detector, photons=photons).metadata["exposure"]["saturated_pixels"] == 0


def test_saturated_pixels_of_colours_are_counted_once_and_printed(tmp_path, capsys):
    image = np.zeros((*CAMERA.shape, 3))
    image[:, :64, :2] = 9.0
    write_capture(tmp_path / "raw.exr", Capture(image, CAMERA))
    assert main(["expose", str(tmp_path / "raw.exr"), "-o", str(tmp_path / "out.exr"), "--photons", "10000"]) == 0
    assert "16384 pixels (25.00%) are saturated" in capsys.readouterr().out
    assert read_capture(tmp_path / "out.exr").metadata["exposure"]["saturated_pixels"] == 16384


@pytest.mark.parametrize(("noise", "between"), [(0.0, (0.4, 0.501)), (0.5, (0.0, 0.18))])
def test_steps_displace_the_mean_by_up_to_half_a_number_and_read_noise_mends_it(noise, between):
    """Fourteen steps over the full well, with the read noise in steps."""
    gain = 14 / 1e5
    detector = Detector(full_well=1e5, bits=5, gain=gain, black_level=4, read_noise=noise / gain, quantum_efficiency=1)
    capture = Capture(np.linspace(0, 1, 256) * np.ones((256, 1)), CAMERA)
    error = expose(capture, detector, photons=5e4).image.mean(axis=0) - capture.image[0]
    step = 1 / (gain * 5e4)
    # Means over 256 pixels: five standard deviations of noise and rounding are 0.18 steps.
    assert between[0] < np.abs(error).max() / step < between[1]
    assert abs(error.mean()) / step < 0.03


def test_defaults_use_the_whole_range_and_do_not_cut_off_the_dark():
    detector = Detector(read_noise=4, dark_electrons=9, full_well=5000, bits=12)
    assert detector.gain * detector.full_well + detector.black_level == pytest.approx(4095)
    dark = detector.digital_numbers(np.zeros(200000), np.random.default_rng(0))
    assert (dark == 0).mean() < 1e-4


def test_a_capture_is_exposed_in_its_own_units():
    capture = Capture(np.linspace(0, 1, 256) * np.ones((256, 1)), CAMERA, 633.0, "wave", {"seed": 3})
    noisy = expose(capture, Detector(), photons=4000, seed=7)
    assert noisy.image.mean(axis=0) == pytest.approx(capture.image[0], abs=0.01)
    # Shot noise dominates: the variance is the value over the number of electrons.
    assert noisy.image[:, 200:].var(axis=0).mean() == pytest.approx(capture.image[0, 200:].mean() / 2400, rel=0.05)
    assert (noisy.camera, noisy.wavelength, noisy.model) == (capture.camera, 633.0, "wave")
    assert noisy.metadata["seed"] == 3
    assert noisy.metadata["exposure"]["photons"] == 4000
    assert noisy.metadata["exposure"]["bits"] == 12


def test_the_seed_fixes_the_noise():
    first, second, third = (expose(flat(0.3), Detector(), photons=100, seed=s).image for s in (1, 1, 2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, third)


def test_colour_and_negative_values():
    image = np.stack([np.full(CAMERA.shape, v) for v in (-0.001, 0.2, 0.9)], axis=-1)
    noisy = expose(Capture(image, CAMERA), Detector(), photons=1000).image
    assert noisy.mean((0, 1)) == pytest.approx([0, 0.2, 0.9], abs=0.005)
