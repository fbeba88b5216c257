"""The drawing of a microlens."""

import matplotlib.image
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.microlens import ZoneLens
from mitsuba_plenoptic.report.microlens_drawing import draw_microlens


@pytest.mark.parametrize("changes", [{}, {"mla_lattice": "hexagonal", "mla_medium": 1.4, "mla_shape": ZoneLens(0.4)}])
def test_draws_any_microlens(changes, tmp_path):
    draw_microlens(tmp_path / "lens.png", PlenopticCamera(**changes), 532.0)
    picture = matplotlib.image.imread(tmp_path / "lens.png")
    # Each of the three parts has colours.
    assert all((part[..., :3].std(axis=2) > 0.1).mean() > 0.01 for part in (picture[:, :560], picture[:, 600:1200]))
    assert picture[:, 1250:, :3].min() < 0.05
