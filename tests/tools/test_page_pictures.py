"""Pictures of the pages."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import mitsuba_plenoptic as mp
from tools.make_pictures import draw_from_above

pt = pytest.importorskip("mitsuba_plenoptic.particles")


@pytest.mark.needs_extension("particles")
def test_particles_from_above_are_as_a_camera_sees_them():
    """One at the left of the capture and far from the camera is at the left and the top, and so is its arrow."""
    camera = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.128, mla_pitch=0.016, mla_focal_length=0.128)
    place, move = np.array([[0.05, 0.0, 241.0]]), np.array([[0.02, 0.0, 0.5]])
    seen = np.asarray(mp.point_spread_function(camera, tuple(place[0]), wavelength=633))
    assert seen[:, :32].sum() > 5 * seen[:, 32:].sum()
    grid = pt.VoxelGrid((-0.1, -0.1, 238), (0.1, 0.1, 242), (20, 20, 20))
    figure = Figure((4, 4), 50)
    figure.add_axes((0, 0, 1, 1), frameon=False)
    draw_from_above(figure.axes[0], pt.drawn_particles(grid, place, np.ones(1), (0.01, 0.01, 0.2)), place, move)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    red, _, blue = np.moveaxis(np.asarray(canvas.buffer_rgba(), float)[..., :3], -1, 0)
    for shown in (np.where(red == blue, red, 0) * (red < 255), red - blue):
        row, column = (axis.mean() for axis in np.nonzero(shown > 100))
        assert row < 80 and column < 80
