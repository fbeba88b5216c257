"""Centres of micro-images in white images that are drawn from closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mitsuba_plenoptic.calibration import find_centres, read_centres, write_centres
from mitsuba_plenoptic.lightfield import LensGrid

PITCH, ROTATION, PHOTONS = 16.37, 0.3, 2000


def white_image(shape, shifted, diameters, seed=0):
    """Discs with rims a pixel soft at known places, and 2000 photons in a full pixel."""
    row = math.sqrt(0.75) * PITCH if shifted is not None else PITCH
    grid = LensGrid((PITCH, row), (11.3, 4.6), (60, 60), math.radians(ROTATION), shifted)
    centres = grid.centres().reshape(-1, 2)
    image = np.zeros(shape)
    y, x = np.indices(shape) + 0.5
    for number, (cx, cy) in enumerate(centres):
        left, top = max(0, int(cx) - 10), max(0, int(cy) - 10)
        part = np.s_[top : int(cy) + 11, left : int(cx) + 11]
        radius = diameters[number % len(diameters)] / 2
        image[part] += np.clip(radius + 0.5 - np.hypot(x[part] - cx, y[part] - cy), 0, 1)
    return np.random.default_rng(seed).poisson(PHOTONS * (0.02 + 0.98 * image)) / PHOTONS, centres


@pytest.mark.parametrize("shifted", [None, 0, 1])
@pytest.mark.parametrize("diameters", [(14.0,), (14.0, 13.4, 13.7)])
def test_centres_are_found(shifted, diameters, tmp_path):
    image, true = white_image((640, 700), shifted, diameters)
    found = find_centres(image)
    nearest = np.abs(found.pixel[:, None] + 0.5 - true).max(-1).min(1)
    assert len(found.pixel) > 1200
    error = np.array([true[np.hypot(*(true - p - 0.5).T).argmin()] - p - 0.5 for p in found.pixel])
    assert np.sqrt((error**2).sum(1).mean()) < 0.05
    assert nearest.max() < 0.2
    assert found.grid.spacing[0] == pytest.approx(PITCH, rel=1e-4)
    assert math.degrees(found.grid.rotation) == pytest.approx(ROTATION, abs=2e-3)
    assert found.light.max() == 1
    path = tmp_path / "centres.csv"
    write_centres(path, found)
    np.testing.assert_allclose(read_centres(path).pixel, found.pixel, atol=1e-4)
