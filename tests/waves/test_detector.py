"""The detector against the equations of EMVA 1288."""

import numpy as np
import pytest
from scipy import stats

from mitsuba_plenoptic import Capture, Detector, PlenopticCamera, expose

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(256, 256))


@pytest.mark.parametrize("photons", [0.0, 5.0, 5000.0])
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


def test_saturation():
    numbers = Detector(full_well=1000, bits=10).digital_numbers(np.array([1e4, 1e9, 1e30]), np.random.default_rng(0))
    assert numbers.dtype == np.uint16
    assert ((numbers > 0.98 * 1023) & (numbers <= 1023)).all()
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
    """Half of the Poisson distribution lies above its mean, which is where these saturate; of colours once."""
    columns = np.repeat([0.5, 1.0, 2.0, 0.0], 64)[:, None] * (1, 1, 0)
    found = expose(Capture(columns * np.ones((256, 1, 1)), CAMERA), detector, photons=photons)
    expected = 64 * 256 * (1 + 1 - (1 - stats.poisson.sf(999, 1000)) ** 2)
    assert found.metadata["exposure"]["saturated_pixels"] == pytest.approx(expected, abs=5 * 64)


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


def test_a_capture_is_exposed_in_its_own_units():
    capture = Capture(np.linspace(0, 1, 256) * np.ones((256, 1)), CAMERA, 633.0, "wave", {"seed": 3})
    noisy, again, other = (expose(capture, Detector(), photons=4000, seed=seed) for seed in (7, 7, 8))
    assert np.array_equal(noisy.image, again.image) and not np.array_equal(noisy.image, other.image)
    assert noisy.image.mean(axis=0) == pytest.approx(capture.image[0], abs=0.01)
    # Shot noise dominates: the variance is the value over the number of electrons.
    assert noisy.image[:, 200:].var(axis=0).mean() == pytest.approx(capture.image[0, 200:].mean() / 2400, rel=0.05)
    assert (noisy.camera, noisy.wavelength, noisy.model) == (capture.camera, 633.0, "wave")
    assert noisy.metadata["seed"] == 3 and noisy.metadata["exposure"]["photons"] == 4000
