"""The parts of the study of when rays fail that have closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from tools.bench.cases.ray_limits import WAVELENGTH, difference
from tools.bench.measures import spot_filtered


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
