"""Scenes by waves behind an objective: against sums of points, of which each part of the stop gets its light."""

import math

import mitsuba as mi
import numpy as np
import pytest
from cameras import CAMERAS

from mitsuba_plenoptic import CaptureOperator, render_capture
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight

CAMERA = CAMERAS["microscope"].replace(detector_width=1.05, resolution=(105, 105))
PLACE, RADIUS = (0.006, -0.004), 0.006
CELLS = 48
AXIS = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1


def disc(depth, tilt=0.0):
    """An even light, turned about y by some degrees from facing the objective."""
    turned = mi.ScalarTransform4f().translate([*PLACE, depth]).rotate([0, 1, 0], 180 - tilt).scale(RADIUS)
    return {"type": "disk", "to_world": turned, "emitter": {"type": "area", "radiance": 1.0}}


def scene_of(objects):
    return mi.load_dict({"type": "scene", "sensor": CAMERA.to_sensor(), "integrator": {"type": "path"}} | objects)


def lambert(tilt):
    """Power over the stop that a point of the disc sends, over that of a point which radiates evenly."""
    sx, sy = 0.5 * AXIS, 0.5 * AXIS[:, None]
    cosine = np.sqrt(1 - np.minimum(sx**2 + sy**2, 0.25))
    return np.maximum(math.cos(tilt) * cosine + math.sin(tilt) * sx, 0)


def points_of(depth, tilt, step=3e-4):
    u = np.arange(-RADIUS + step / 2, RADIUS, step)
    x, y = (values[np.hypot(*grid) < RADIUS] for grid in [np.meshgrid(u, u)] for values in grid)
    points = np.column_stack([PLACE[0] + x * math.cos(tilt), PLACE[1] + y, np.full(len(x), depth) + x * math.sin(tilt)])
    area = math.pi * (20 * RADIUS) ** 2 * math.cos(tilt) / len(points)
    return points, np.full(len(points), radiance_weight(CAMERA, main_lens(CAMERA), area))


def exact(points, weights, over_stop):
    table = np.broadcast_to(over_stop, (len(points), CELLS, CELLS))
    return CaptureOperator(CAMERA, points, wavelength=550, pupil_weights=table).forward(weights)


@pytest.mark.slow
@pytest.mark.parametrize(("depth", "tilt", "limit"), [(0.02, 0, 0.02), (0.01, 40, 0.03)])
def test_a_disc_is_the_sum_of_its_points(depth, tilt, limit):
    """Facing the objective, and turned by an angle at which Lambert's law matters."""
    expected = exact(*points_of(depth, math.radians(tilt)), lambert(math.radians(tilt)))
    scene = scene_of({"light": disc(depth, tilt)})
    one, two = (render_capture(scene, model="wave", wavelength=550, spp=256, seed=seed).image for seed in (0, 1))
    # Without the noise, which is another one in each.
    assert np.vdot(one - expected, two - expected) < (limit * np.linalg.norm(expected)) ** 2
    assert one.sum() + two.sum() == pytest.approx(2 * expected.sum(), rel=0.01)


def test_what_the_objective_sets_is_not_exposed():
    exposed = {name.rsplit(".", 1)[-1] for name in mi.traverse(scene_of({})).properties}
    assert {"mla_pitch", "detector_distance"} <= exposed
    assert not {"focal_length", "aperture_radius", "mla_distance"} & exposed
