"""How the copies of point spreads shift at the pixels, and which of them are counted where the lattice moves."""

import numpy as np
import pytest
from wave_cases import HALF, WAVELENGTH, error, in_every_lens, small_camera

from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points import accuracy
from mitsuba_plenoptic.points.derivatives.plan import DerivativePlan
from mitsuba_plenoptic.points.field_grid import Grid
from mitsuba_plenoptic.points.recorder import STEPS, Recorder


@pytest.mark.parametrize("degrees", [0.0, 11.0])
@pytest.mark.parametrize("axis", [0, 1])
def test_pixels_that_move_see_a_smooth_light_move_against_them(axis, degrees):
    """A Gaussian spot, whose samples are known wherever it stands."""
    camera = small_camera(2, mla_rotation=degrees)
    points = np.array([[0.0, 0.0, 240.0]])
    grid = Grid.of(OpticalSystem(camera, WAVELENGTH), accuracy.derivative_band_for(0.02, 1), points)
    size = np.ceil(np.array(camera.detector_width) / grid.pitch).astype(np.int64)[None]
    recorder = Recorder(camera, grid, 0 * size, size)
    box, (x, y) = recorder.box, grid.pitch
    column = (box.left + np.arange(box.columns)) * x + grid.origin[0]
    row = (box.top + np.arange(box.rows)) * y + grid.origin[1]
    turned = np.deg2rad(degrees)
    across = column * np.cos(turned) - row[:, None] * np.sin(turned)
    down = column * np.sin(turned) + row[:, None] * np.cos(turned)

    def spot(step):
        place = [across, down]
        place[axis] = place[axis] + step
        square = (place[0] - 0.004) ** 2 + (place[1] + 0.007) ** 2
        return recorder.record(np.exp(-square / (2 * 0.012**2))[None].astype(np.float32)).astype(np.float64)

    found = recorder.record(np.exp(-((across - 0.004) ** 2 + (down + 0.007) ** 2) / (2 * 0.012**2))[None], STEPS[axis])
    assert error(found, (spot(1e-3) - spot(-1e-3)) / 2e-3) < 0.005


def test_little_of_what_copies_show_of_a_moved_lattice_is_left_out(monkeypatch):
    monkeypatch.setattr(accuracy, "_FEW", 8)
    camera = small_camera(2, **HALF)
    points = np.concatenate([in_every_lens(camera, 4, 118.0), [[0.01, 0.0, 122.0], [0.02, -0.01, 125.0]]])
    plan = DerivativePlan(OpticalSystem(camera, WAVELENGTH), points, None, 0.1)
    weights = np.ones((len(points), 1))
    counted = plan.moving(weights)
    moved = np.add.reduceat(np.abs(plan._shifts).sum(1), plan._first)
    assert counted.any() and not counted[moved == 0].any()
    assert moved[~counted].sum() <= 0.1 * 0.1 * moved.sum()
    assert not plan.moving(0 * weights).any()
