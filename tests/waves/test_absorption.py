"""An absorbing medium behind the microlenses, against the law of Beer and Lambert along paths and orders."""

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, radiating, scene_of

from mitsuba_plenoptic import PlenopticCamera, render_capture

STEEP = {
    "focal_length": 50.0, "aperture_radius": 16.0, "mla_distance": 51.0, "mla_pitch": 0.04, "mla_medium": 1.5,
    "mla_focal_length": 0.06, "detector_width": 0.04 * 4, "resolution": (32, 32),
}  # fmt: skip
"""Lenses of f/1, in units of which the absorption is strong."""


def test_rays_lose_light_along_their_paths():
    sensors = [mi.load_dict(PlenopticCamera(**STEEP, mla_absorption=each).to_sensor()) for each in (0.0, 15.0)]
    film, lens = np.random.default_rng(1).random((2, 2, 500)).astype(np.float32)
    (_, clear), (_, dimmed) = (sensor.sample_ray(0.0, 0.5, mi.Point2f(film), mi.Point2f(lens)) for sensor in sensors)
    clear, dimmed = np.array(clear)[0], np.array(dimmed)[0]
    camera = sensors[0].camera
    # Rays of an ideal main lens start on the pupil, from where they meet the array.
    sensor_point = (film - 0.5) * camera.detector_width
    chief = sensor_point * 51 / (51 + camera.reduced_distance)
    offset = np.stack(camera.lattice.aperture_point(*lens.astype(float)))
    crossing = np.stack(camera.lattice.centre(*camera.lattice.cell(*chief))) + offset
    path = np.sqrt(((crossing - sensor_point) ** 2).sum(0) + 0.06**2)
    passes = clear > 0
    assert passes.sum() > 50 and np.ptp(path[passes]) > 0.003
    assert np.allclose(dimmed[passes], clear[passes] * np.exp(-15 * path[passes]), rtol=1e-4)


def white(camera, **options):
    return render_capture(scene_of(camera.to_sensor(), wall=facing(900.0, 900.0, **radiating())), **options).image


def transmitted(**options):
    cameras = (PlenopticCamera(**STEEP, mla_absorption=each) for each in (0.0, 15.0))
    clear, dimmed = (white(camera, **options)[8:-8, 8:-8].mean() for camera in cameras)
    return dimmed / clear


@pytest.mark.slow
def test_white_walls_against_the_mean_over_paths():
    """By ideal lenses all paths from the points of a lens to the micro-image of the pupil are equally frequent."""
    m = (np.arange(60) + 0.5) / 60 * 0.04 - 0.02
    p = (np.arange(60) + 0.5) / 30 - 1
    x, y, u, v = np.meshgrid(m, m, p * 16 * 0.04 / 51, p * 16 * 0.04 / 51, sparse=True)
    path = np.sqrt((x - u) ** 2 + (y - v) ** 2 + 0.06**2)
    inside = np.broadcast_to(u**2 + v**2 <= (16 * 0.04 / 51) ** 2, path.shape)
    expected = np.exp(-15 * path)[inside].mean()
    # A constant factor of perpendicular light differs.
    assert expected < 0.97 * np.exp(-15 * 0.06)
    assert transmitted(model="ray", spp=64) == pytest.approx(expected, rel=0.003)
    assert transmitted(model="wave", wavelength=550.0, spp=16) == pytest.approx(expected, rel=0.005)
