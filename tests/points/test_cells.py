"""Many copies of patterns, added by cells: against each copy added by itself."""

import numpy as np
import pytest
from wave_cases import in_every_lens, small_camera

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.points.tile import CopyCells


@pytest.mark.parametrize("step", [(12, 12), (9, 14), (16, 0)])
@pytest.mark.parametrize("held", [1, 3, 50])
def test_sums_are_those_of_copies_one_by_one(step, held):
    """Wherever patterns begin, with weights of any sign, and however many are multiplied together."""
    samples, rng = 40, np.random.default_rng(3)
    shifts = [rng.integers(-3, 4, (5, 2)) * step for _ in range(7)]
    places = [shift + rng.integers(48, 60, 2) for shift in shifts]
    weights = [rng.normal(size=(5, 2)).astype(np.float32) * (rng.random((5, 2)) > 0.3) for _ in shifts]
    patterns = rng.random((7, samples, samples), np.float32)
    size = np.max([place.max(0) for place in places], axis=0) + samples
    expected = np.zeros((2, *size))
    cells = CopyCells.of(shifts, samples)
    total = cells.sum(size, 2, held)
    for number, (place, weight, pattern) in enumerate(zip(places, weights, patterns, strict=True)):
        for (x, y), factors in zip(place, weight, strict=True):
            expected[:, x : x + samples, y : y + samples] += factors[:, None, None] * pattern
        if not total.free:
            total.add()
        # A pattern is written in parts.
        for part in (slice(0, 11), slice(11, samples)):
            plane, x, y = total.hold(number, place, weight)
            total.planes[plane, x:, y:][part, :samples] = pattern[part]
    np.testing.assert_allclose(total.total(), expected, atol=2e-6)


@pytest.mark.parametrize(
    ("shifts", "samples"),
    [
        pytest.param([[[0, 0], [12, 0]]] * 3, 40, id="few copies"),
        pytest.param([[[0, 0], [7, 0], [12, 9], [3, 5]]] * 3, 40, id="moved by no common width"),
        pytest.param([[[0, 0], [90, 0], [0, 90], [90, 90]]] * 3, 40, id="cells larger than patterns"),
    ],
)
def test_copies_are_added_one_by_one_where_cells_do_not_pay(shifts, samples):
    assert CopyCells.of([np.array(some) for some in shifts], samples) is None


@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
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
