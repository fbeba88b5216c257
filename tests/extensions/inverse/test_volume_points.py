"""Volumes of emitters as points, and the built-in scenes that have such volumes."""

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import load_scene, render_capture, volume_points


def test_voxels_become_points_in_the_order_of_the_axes():
    values = np.zeros((2, 3, 4))
    values[1, 0, 3] = 5
    points, weights = volume_points(values, (0, 0, -1), (4, 6, 1))
    assert np.array_equal(points, [[3.5, 1, 0.5]])
    assert weights == [5 * 1 * 2 * 1]


def test_grids_of_mitsuba_are_taken(tmp_path):
    values = np.random.default_rng(0).random((3, 4, 5)).astype(np.float32)
    path = str(tmp_path / "volume.vol")
    mi.VolumeGrid(values).write(path)
    points, weights = volume_points(mi.VolumeGrid(path), (0, 0, 0), (1, 1, 1))
    again = volume_points(values, (0, 0, 0), (1, 1, 1))
    assert np.array_equal(points, again[0])
    assert np.allclose(weights, again[1])
    # As `gridvolume` has it in the unit cube.
    volume = mi.load_dict({"type": "gridvolume", "filename": path, "filter_type": "nearest", "raw": True})
    for point, weight in zip(points[::7], weights[::7], strict=True):
        it = mi.Interaction3f()
        it.p = mi.Point3f(point)
        assert volume.eval_1(it)[0] / 60 == pytest.approx(weight, rel=1e-5)


def test_beads_send_what_their_size_says():
    """A sphere of radiance 1 has the etendue pi r^2 times the solid angle, wherever it lies."""
    capture = render_capture(load_scene("beads"), model="ray", spp=64)
    camera = capture.camera
    half_angle = camera.objective.half_angle
    etendue = 13 * np.pi * 1e-3**2 * 2 * np.pi * (1 - np.cos(half_angle))
    # Behind the tube lens it is the same: the area of pixels times the solid angle of a lens.
    seen = capture.image.sum() * camera.pixel_size**2 * (camera.mla_pitch / camera.detector_distance) ** 2
    assert seen == pytest.approx(etendue, rel=0.08)


def test_fibres_are_as_thin_from_the_objective_as_from_near_by():
    """Mitsuba's cylinders of this width are twice as wide from 10 mm away."""
    scene, width, count = load_scene("fibres"), 0.225, 700
    assert 0.01 < np.mean(render_capture(scene, model="ray", spp=4).image > 0) < 0.5
    places = np.stack(np.meshgrid(*2 * [np.linspace(-width / 2, width / 2, count)]), -1).reshape(-1, 2).T
    for start in (-10.0, -0.2):
        hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(*places, start), mi.Vector3f(0, 0, 1)))
        seen = hit.is_valid().numpy()
        # Their lengths across the axis times 1 um, less where they cross.
        assert seen.mean() * width**2 == pytest.approx(1.12e-3, rel=0.03)
        # Their outsides shine.
        assert (hit.wi.numpy()[2][seen] > 0).mean() > 0.99
