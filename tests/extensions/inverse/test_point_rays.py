"""Captures of points by rays: against Mitsuba's rays through the sensor, closed forms, and cameras nearby."""

import itertools

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error
from cases import film, scene_of

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.fitting import known_view
from mitsuba_plenoptic.points.units import brightness_at

CAMERAS = {
    "double Gauss": ({"main_lens": "double_gauss"}, 112.0),
    "aberrations": ({"wavefront": "0, 0, 0, 0.6"}, 125.0),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "aberrations")) for name in CAMERAS]
)
def test_against_rays_through_the_sensor(name):
    """A wall of several shades, as the points that rays find on it."""
    numbers, distance = CAMERAS[name]
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
        variance = part @ (x - middle) ** 2
        assert variance == pytest.approx(radius**2 / 4 + camera.pixel_size**2 / 12, rel=0.01)


def test_captures_are_continuous_in_the_camera():
    """A small step makes a small change, where borders of lenses pass over the light, too."""
    camera = PlenopticCamera(detector_width=0.256, resolution=(64, 64), **HALF)
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.1, 0.1, (20, 2)), rng.uniform(108, 114, 20)])
    rays = PointRays(camera, points, WAVELENGTH)
    images = [
        rays.image(OpticalSystem(camera.replace(mla_offset=(step, 0.0)), WAVELENGTH), np.ones(20))
        for step in np.arange(5) * 2e-5
    ]
    steps = [np.linalg.norm(b - a) for a, b in itertools.pairwise(images)]
    assert max(steps) < 1.3 * min(steps)
    assert max(steps) < 0.005 * np.linalg.norm(images[0])
