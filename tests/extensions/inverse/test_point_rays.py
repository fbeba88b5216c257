"""Points by rays and of volumes: against Mitsuba's rays, closed forms, and cameras nearby."""

import itertools

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error
from cases import film, scene_of

from mitsuba_plenoptic import PlenopticCamera, load_scene, render_capture, volume_points
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.fitting import known_view
from mitsuba_plenoptic.points.units import brightness_at


@pytest.mark.slow
@pytest.mark.parametrize(
    ("numbers", "distance"), [({"main_lens": "double_gauss"}, 112.0), ({"wavefront": "0, 0, 0, 0.6"}, 125.0)]
)
def test_against_rays_through_the_sensor(numbers, distance):
    """A wall of several shades, as the points that rays find on it."""
    texture = mi.Bitmap(np.random.default_rng(1).uniform(0.2, 1, (4, 4, 1)).astype(np.float32))
    light = {"type": "bitmap", "bitmap": texture, "raw": True}
    place = mi.ScalarTransform4f().translate([0.05, 0.03, distance]).rotate([0, 1, 0], 180).scale(0.25)
    camera = {"type": "plenoptic", "detector_width": 0.256, "film": film(64, 64), **HALF, **numbers}
    wall = {"type": "rectangle", "to_world": place, "light": {"type": "area", "radiance": light}}
    scene = scene_of(camera, "direct", wall=wall)
    traced = np.array(mi.render(scene, spp=1024))[..., 0]
    camera = PlenopticCamera.from_sensor(scene.sensors()[0])
    view = known_view(traced, scene, camera, wavelength=WAVELENGTH, points_per_lens=256)
    rays = PointRays(camera, view.points, WAVELENGTH, view.pupil_weights)
    system = OpticalSystem(camera, WAVELENGTH)
    image = rays.image(system, brightness_at(system, view.points) * view.weights)
    assert error(image, traced) < 0.03
    assert image.mean() == pytest.approx(traced.mean(), rel=0.02)


def test_a_point_in_focus_is_a_disc_behind_one_lens():
    """Its radius is that of the pupil times z / b, about the line from the pupil's middle."""
    camera = PlenopticCamera(detector_width=0.128, resolution=(128, 128), **HALF)
    centre, g = 0.03, 120.0
    point = np.array([[-centre * g / 60, -centre * g / 60, g]])
    image = PointRays(camera, point, WAVELENGTH).image(OpticalSystem(camera, WAVELENGTH), np.ones(1))
    assert image.sum() == pytest.approx(1, abs=1e-9)
    x = (np.arange(128) + 0.5 - 64) * camera.pixel_size
    rows, columns = image.sum(1), image.sum(0)
    # Through the lens at 0.032, off whose centre the point's image lies: z (q / b - (q - c) / f2) from the image q.
    z = camera.detector_distance
    middle = centre + z * (centre / 60 - (centre - 0.032) / camera.mla_focal_length)
    radius = 2.5 * z / 60
    for part in (rows, columns):
        assert part @ x == pytest.approx(middle, abs=2e-5)
        # The variance of a disc along an axis is a quarter of its radius squared; pixels add a twelfth of theirs.
        assert part @ (x - middle) ** 2 == pytest.approx(radius**2 / 4 + camera.pixel_size**2 / 12, rel=0.01)


def test_captures_are_continuous_in_the_camera():
    """A small step makes a small change, where borders of lenses pass over the light, too."""
    camera, rng = PlenopticCamera(detector_width=0.256, resolution=(64, 64), **HALF), np.random.default_rng(2)
    rays = PointRays(camera, np.column_stack([rng.uniform(-0.1, 0.1, (20, 2)), rng.uniform(108, 114, 20)]), WAVELENGTH)
    moved = [camera.replace(mla_offset=(2e-5 * step, 0.0)) for step in range(5)]
    images = [rays.image(OpticalSystem(each, WAVELENGTH), np.ones(20)) for each in moved]
    steps = [np.linalg.norm(b - a) for a, b in itertools.pairwise(images)]
    assert max(steps) < 1.3 * min(steps)
    assert max(steps) < 0.005 * np.linalg.norm(images[0])


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
    etendue = 13 * np.pi * 1e-3**2 * 2 * np.pi * (1 - np.cos(camera.objective.half_angle))
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
