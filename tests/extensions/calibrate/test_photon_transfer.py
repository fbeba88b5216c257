"""Gain and read noise from white and dark exposures of a wave white capture, against the detector that made them."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import sky
from refusals import refused, refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.extensions.calibrate.photon_transfer import SensorNoise

CAMERA = mp.PlenopticCamera(
    main_lens=mp.Objective(magnification=20, numerical_aperture=0.5), mla_pitch=0.125, mla_focal_length=2.433,
    detector_width=0.25, resolution=(55, 55),
)  # fmt: skip
"""A microscope of 27.5 pixels a lens, 2 x 2 of them."""

DETECTORS = {
    "16 bits": mp.Detector(quantum_efficiency=0.7, full_well=30000, read_noise=1.5, bits=16, gain=2.1, black_level=101),
    "12 bits": mp.Detector(full_well=30000, read_noise=6, bits=12, gain=0.13, black_level=64),
    "8 bits": mp.Detector(full_well=500, read_noise=3, bits=8, gain=0.45, black_level=12),
}


@pytest.fixture(scope="module")
def white():
    """The wave capture of four lenses, mirrored many times."""
    mi.set_variant("llvm_ad_mono")
    image = sky(CAMERA, 64, "wave", wavelength=510)
    return np.pad(image / image.max(), 605, mode="symmetric")


def numbers_of(image, detector, seed, part=0.8):
    """Return the digital numbers of an exposure whose brightest pixels reach a part of the range."""
    rows, columns = image.shape
    camera = CAMERA.replace(resolution=(columns, rows), detector_width=columns * CAMERA.pixel_size)
    range_of = (2**detector.bits - 1 - detector.black_level) / detector.gain
    scale = detector.quantum_efficiency * part * min(detector.full_well, range_of)
    photons = scale / detector.quantum_efficiency**2
    exposed = mp.expose(mp.Capture(image.astype(np.float32), camera), detector, photons=photons, seed=seed).image
    electrons = exposed.astype(float) * photons * detector.quantum_efficiency
    return np.rint(electrons * detector.gain + detector.black_level)


@pytest.mark.parametrize("bits", [12, pytest.param(8, marks=pytest.mark.slow)])
def test_single_pictures_give_gain_and_noise(white, bits):
    """Within 2 %, though the micro-images vary a hundred times as much as the noise."""
    detector = DETECTORS[f"{bits} bits"]
    # With few bits it takes many pixels.
    white = white if bits == 8 else white[:700, :700]
    bright, dark = numbers_of(white, detector, 1), numbers_of(0 * white, detector, 2)
    found = mp.photon_transfer(bright, dark, bits=detector.bits)
    assert found.gain == pytest.approx(detector.gain, rel=0.02)
    assert found.read_noise == pytest.approx(detector.read_noise, rel=0.02)
    assert found.dark_offset == pytest.approx(detector.black_level, abs=0.02)
    assert found.detector.black_level == detector.black_level
    assert abs(found.gain - detector.gain) < 4 * found.gain_deviation
    assert found.gain_deviation < 0.02 * detector.gain
    assert (found.saturated_pixels, found.dead_pixels, found.hot_pixels) == (0, 0, 0)


def test_pairs_do_not_count_what_differs_from_pixel_to_pixel(white):
    """Unequal pixels, by 1 % and by two digital numbers, and a lamp that flickers by 3 %."""
    white = white[:700, :700]
    detector, random = DETECTORS["16 bits"], np.random.default_rng(3)
    unequal, offsets = (1 + 0.01 * random.normal(size=white.shape)).clip(0), random.normal(0, 2, white.shape)
    bright = [numbers_of(white * unequal, detector, seed, part) + offsets for seed, part in ((1, 0.8), (2, 0.776))]
    dark = [numbers_of(0 * white, detector, seed) + offsets for seed in (3, 4)]
    pair, single = mp.photon_transfer(bright, dark), mp.photon_transfer(bright[0], dark[0])
    assert pair.gain == pytest.approx(detector.gain, rel=0.01)
    assert pair.read_noise == pytest.approx(detector.read_noise, rel=0.02)
    assert np.polyfit(pair.signal, pair.variance, 1)[0] == pytest.approx(detector.gain, rel=0.03)
    assert single.gain > 1.5 * detector.gain


def test_bad_pixels_are_counted_and_left_out(white):
    detector, part = DETECTORS["16 bits"], white[:600, :600]
    bright, dark = numbers_of(part, detector, 1), numbers_of(0 * part, detector, 2)
    plain = mp.photon_transfer(bright, dark)
    # Some of them at the pictures' borders, none among the saturated ones below.
    middle = np.concatenate([np.argwhere(part > 0.98)[::4000], [(0, 0), (0, 300), (599, 40), (300, 599)]])
    middle = np.unique(middle[np.abs(middle - [301.5, 202]).max(1) > 3], axis=0)
    bright[tuple(middle.T)] = detector.black_level
    dark[100, 101] = 900
    bright[300:304, 200:205] = 65535
    found = mp.photon_transfer(bright, dark)
    assert (found.saturated_pixels, found.dead_pixels, found.hot_pixels) == (20, len(middle), 1)
    assert found.gain == pytest.approx(plain.gain, rel=0.01)


@pytest.mark.parametrize(("kind", "level"), [("even", 1.02), ("slope", 0.98), ("lenses", 1.5)])
def test_full_wells_below_the_largest_number(white, kind, level):
    """Of pairs the pixels below the full well tell the gain, unless there are none; single pictures are refused."""
    detector = mp.Detector(quantum_efficiency=1, full_well=8000, read_noise=4, bits=16, gain=0.5, black_level=100)
    light = {"even": np.ones((300, 300)), "slope": np.ones((300, 1)) * np.linspace(0, 1.05, 300), "lenses": white}[kind]
    light = light[-300:, -300:]
    pairs = []
    for seed in range(4):
        random = np.random.default_rng(seed)
        bright = [detector.digital_numbers(level * 8000 * light, random).astype(float) for _ in range(2)]
        dark = [detector.digital_numbers(0 * light, random).astype(float) for _ in range(2)]
        refuses("full wells cut off their noise", mp.photon_transfer, bright if kind == "even" else bright[0], dark)
        pairs += [] if kind == "even" else [mp.photon_transfer(bright, dark)]
    # Single pairs of so few pixels scatter by 2 %, and their mean is 1 to 2 % too small.
    assert kind == "even" or np.mean([found.gain for found in pairs]) == pytest.approx(0.5, rel=0.035)
    assert all(found.saturated_pixels > 1000 for found in pairs)


DIM = np.random.default_rng(0).normal(100, 2, (40, 50)).round()

test_bad_input = refused(
    (lambda: mp.photon_transfer(DIM[:, :-1] * 9, DIM), r"dark of shape \(40, 50\)"),
    (lambda: mp.photon_transfer(DIM, DIM), "white: its mean is"),
    (lambda: mp.photon_transfer(DIM * 90, DIM, bits=12), "bits = 12"),
    (lambda: mp.photon_transfer(DIM * 9, np.maximum(DIM - 100, 0)), "dark: .* of its pixels are 0"),
    (lambda: mp.photon_transfer(DIM * 0 + 65535, DIM), "white: 2000 pixels"),
)


def test_without_a_dark_picture_neighbours_tell_the_noise():
    random = np.random.default_rng(0)
    sensor = mp.Detector(quantum_efficiency=1, gain=0.5, read_noise=6, full_well=20000, bits=16)
    white, dark = (sensor.digital_numbers(np.full((300, 300), level), random).astype(float) for level in (9000.0, 0.0))
    found = SensorNoise.of(white, None, np.where(np.arange(300) < 200, white, dark))
    assert found.gain == pytest.approx(0.5, rel=0.05)
    assert found.dark_variance == pytest.approx(36 + 1 / 3, rel=0.2)
    assert "no dark picture" in found.source
