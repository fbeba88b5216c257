"""Spot diagrams of ordinary cameras behind prescriptions: where rays of scene points land, against Optiland's rays."""

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import LensSystem, PlenopticCamera
from mitsuba_plenoptic.prescription import bundled_prescription, paraxial

SPOTS = json.loads((Path(__file__).parents[1] / "optiland_records" / "spots.json").read_text())["lenses"]
"""Of Optiland 0.6.3: three points of a scene, in focus on the axis."""

EXACT = 1e-6
"""Largest deviation in mm on the detector, and in the object plane of rays traced back."""

SINGLE = {"double_gauss": 5e-5, "double_gauss_f2": 5e-5, "phone": 5e-6, "singlet": 2e-5}
"""Largest deviation in mm on the detector of the sensor's rays, which are in single precision."""


def behind(name):
    """Return a camera with a bundled lens of its natural size, and its rays."""
    camera = PlenopticCamera(
        mla_lattice="none", main_lens=name, focus_distance=SPOTS[name]["focus"], detector_width=4.0, resolution=(8, 6)
    )
    return camera, LensSystem.of(camera)


def points(name):
    """Yield each point's position, its rays' slopes, which pass, and where and with which slopes these land.

    Optiland's z goes with the light, and ours against it.
    """
    for point in SPOTS[name]["points"]:
        is_open = np.array(point["open"])
        image, slopes = (np.array(point[key])[:, is_open] for key in ("image", "slopes"))
        yield point["height"], -np.array(point["towards"]), is_open, image, -slopes


@pytest.mark.parametrize("name", SPOTS)
def test_rays_of_points_land_where_optilands_do(name):
    camera, lens = behind(name)
    assert lens.back_distance == pytest.approx(SPOTS[name]["detector"], abs=1e-9)
    for height, towards, is_open, image, slopes in points(name):
        start = (0 * towards[0], height + 0 * towards[0], camera.focus_distance + 0 * towards[0])
        place, slope, passes, _ = lens.through(start, tuple(towards))
        assert 0 < is_open.sum() < is_open.size
        # Which rays the edges of the surfaces stop.
        assert np.array_equal(passes, is_open)
        np.testing.assert_allclose(np.array(place)[:, is_open], image, atol=EXACT, rtol=0)
        np.testing.assert_allclose(np.array(slope)[:, is_open], slopes, atol=EXACT, rtol=0)


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n == "phone")) for n in SPOTS])
def test_the_sensors_rays_are_of_single_precision(name):
    """Followed to the detector in double precision, each lands where the sensor started it."""
    camera, lens = behind(name)
    sensor, random = mi.load_dict(camera.to_sensor()), np.random.default_rng(0)
    place, pupil = (mi.Point2f(random.random((2, 4000)).astype(np.float32)) for _ in range(2))
    ray, weight = sensor.sample_ray(0.0, 0.5, place, pupil)
    lit = np.array(weight).reshape(-1, 4000)[0] > 0
    origin, direction = (np.array(values, np.float64)[:, lit] for values in (ray.o, ray.d))
    landed = lens.through(tuple(origin), tuple(direction[:2] / direction[2]))[0]
    size = np.array([[camera.detector_width], [camera.detector_height]])
    started = (np.array(place, np.float64)[:, lit] - 0.5) * size
    assert lit.mean() > 0.1
    assert np.abs(landed - started).max() < SINGLE[name]


def test_the_table_of_the_double_gauss_has_the_printed_focal_length_and_back_focus():
    """U.S. patent 2,673,491: f = 1, back focus 0.71436, 1:2."""
    numbers = paraxial(bundled_prescription("double_gauss_f2"))
    assert numbers.focal_length == pytest.approx(50, rel=2e-3)
    assert numbers.back_focal / numbers.focal_length == pytest.approx(0.71436, abs=1e-4)
