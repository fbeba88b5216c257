"""Many copies of patterns, added by cells: against each copy added by itself."""

import numpy as np
import pytest
from cameras import in_every_lens, small_camera

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.points.tile import CopyCells


@pytest.mark.parametrize("lattice", ["square", pytest.param("hexagonal", marks=pytest.mark.slow)])
def test_captures_are_the_same_either_way(monkeypatch, lattice):
    """Of many radiators that share patterns, on lattices of which every second row lies half a lens aside, too."""
    camera = small_camera(8, mla_lattice=lattice)
    points = in_every_lens(camera, 5, 225.0)
    weights = np.random.default_rng(2).random((len(points), 2))
    used = []
    choose = CopyCells.of
    monkeypatch.setattr(CopyCells, "of", lambda *given: used.append(choose(*given)) or used[-1])
    by_cells = CaptureOperator(camera, points, wavelength=550.0, accuracy=0.1).forward(weights)
    assert any(used), "no copies were added by cells"
    monkeypatch.setattr(CopyCells, "of", lambda *given: None)
    one_by_one = CaptureOperator(camera, points, wavelength=550.0, accuracy=0.1).forward(weights)
    assert np.linalg.norm(by_cells - one_by_one) <= 2e-6 * np.linalg.norm(one_by_one)
