"""The medium behind the microlenses: rays and waves in it, and the lengths of air that do the same near the axis."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error, sky, small_camera

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.points.point_spread import point_fields

GLASS = {"mla_medium": 1.5, "mla_focal_length": 0.768, "detector_distance": 0.8}
"""Lengths in a medium; in air two thirds of them have the same effect near the axis."""
AIR = {"mla_focal_length": 0.512, "detector_distance": 0.8 / 1.5}

ON_CHIP = {
    "focal_length": 50.0, "aperture_radius": 9.0, "mla_distance": 51.0, "mla_pitch": 0.0056, "mla_medium": 1.5,
    "mla_focal_length": 0.012, "detector_width": 0.0056 * 8, "resolution": (64, 64),
}  # fmt: skip
"""Steep microlenses, of f/1.4 in air."""


def rays_of(camera, count=2000):
    """Return the samples that rays of a sensor are made of, and the rays: origins, directions and weights."""
    sensor = mi.load_dict(camera.to_sensor())
    film, lens = np.random.default_rng(1).random((2, 2, count)).astype(np.float32)
    ray, weight = sensor.sample_ray(0.0, 0.5, mi.Point2f(film), mi.Point2f(lens))
    return film, lens, np.array(ray.o), np.array(ray.d), np.array(weight)[0]


@pytest.mark.parametrize("changes", [GLASS, ON_CHIP], ids=["plenoptic", "on-chip"])
def test_rays_against_snell_at_a_thin_element(changes):
    """At a thin element the tangential component of n times the direction changes by the slope of its path."""
    camera = mp.PlenopticCamera(**{"detector_width": 0.512, "lens_model": "parabolic"} | changes)
    n, b, f1 = camera.mla_medium, camera.mla_distance, camera.focal_length
    film, lens, origin, direction, weight = rays_of(camera)
    p = (film.T.astype(float) - 0.5) * camera.detector_width
    # The lens of the chief ray, which passes the middle of the pupil.
    chief = p * b / (b + camera.detector_distance / n)
    assert len(mp.design.crosstalk_neighbours(camera)) == 1
    centre = (np.floor(chief / camera.mla_pitch) + 0.5) * camera.mla_pitch
    m = centre + (lens.T - 0.5) * camera.mla_pitch
    within = np.column_stack([m - p, np.full(len(p), camera.detector_distance)])
    within *= n / np.linalg.norm(within, axis=1)[:, None]
    before = within[:, :2] - n * (m - centre) / camera.mla_focal_length
    pupil = m + b * before / np.sqrt(1 - (before**2).sum(1))[:, None]
    after = before - pupil / f1
    after = np.column_stack([after, np.sqrt(1 - (after**2).sum(1))])
    is_open = (pupil**2).sum(1) <= camera.aperture_radius**2
    assert np.array_equal(weight > 0, is_open)
    assert np.abs(origin[:2].T - pupil)[is_open].max() < 1e-4
    assert np.abs(direction.T - after)[is_open].max() < 1e-5


def test_an_ideal_microlens_in_a_medium_is_stigmatic():
    """All rays of a detector point through one lens meet in its conjugate plane."""
    camera = small_camera(1, **GLASS | {"detector_distance": 0.9}, mla_offset=(0.032, 0.032))
    sensor = mi.load_dict(camera.to_sensor())
    lens = np.random.default_rng(1).random((2, 500)).astype(np.float32)
    ray, weight = sensor.sample_ray(0.0, 0.5, mi.Point2f([0.55], [0.48]), mi.Point2f(lens))
    o, d = np.array(ray.o, float), np.array(ray.d, float)
    (a,) = mp.design.mla_object_distances(camera)
    assert 1 / a + 1.5 / 0.9 == pytest.approx(1.5 / 0.768)
    (distance,) = mp.design.best_distances(camera)
    assert np.ptp((o[:2] + d[:2] / d[2] * distance)[:, np.array(weight)[0] > 0], axis=1).max() < 1e-3


def test_near_the_axis_a_medium_is_a_shorter_length_of_air():
    """Design and ray reconstruction see no difference; a relation compares point spreads."""
    cameras = [small_camera(**changes) for changes in (GLASS, AIR)]
    for figure in (
        mp.design.mla_f_number, mp.design.mla_object_distances, mp.design.best_distances,
        lambda camera: mp.design.depth_ranges(camera, 550.0), lambda camera: mp.design.spot_radius(camera, 550.0),
        lambda camera: camera.micro_image_pitch, lambda camera: camera.micro_image_diameter,
    ):  # fmt: skip
        glass, air = (np.array(figure(camera)) for camera in cameras)
        assert np.all(glass == air) or np.allclose(glass, air, rtol=1e-12)
    image = np.random.default_rng(2).random(cameras[0].shape, np.float32)
    found, expected = (mp.reconstruct(image, 230.0, camera=camera).image for camera in cameras)
    assert error(found, expected) < 1e-6


def test_waves_against_an_angular_spectrum_in_the_medium():
    camera = small_camera(4, **HALF, **GLASS)
    fields = point_fields(camera, np.array([0.05, -0.03, 112.5]), wavelength=WAVELENGTH)
    lam, pitch, count = WAVELENGTH * 1e-6, fields.mla.pitch, fields.mla.samples.shape
    x, y = (fields.mla.origin[axis] + np.arange(count[1 - axis]) * pitch for axis in (0, 1))
    i, j = camera.lattice.cell(*np.meshgrid(x, y))
    cx, cy = camera.lattice.centre(i, j)
    path = -1.5 * ((x - cx) ** 2 + (y[:, None] - cy) ** 2) / (2 * 0.768)
    spectrum = np.fft.fft2(fields.mla.samples * np.exp(2j * np.pi * path / lam))
    fx, fy = (np.fft.fftfreq(size, pitch) for size in (count[1], count[0]))
    axial = np.sqrt(np.maximum((1.5 / lam) ** 2 - fx**2 - fy[:, None] ** 2, 0))
    expected = np.fft.ifft2(spectrum * np.exp(2j * np.pi * 0.8 * (axial - 1.5 / lam)))
    assert error(np.abs(fields.detector.samples) ** 2, np.abs(expected) ** 2) < 0.02


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


@pytest.mark.slow
def test_white_by_waves_is_dimmed_by_the_mean_over_paths():
    """By ideal lenses all paths from the points of a lens to the micro-image of the pupil are equally frequent."""
    m = (np.arange(60) + 0.5) / 60 * 0.04 - 0.02
    p = ((np.arange(60) + 0.5) / 30 - 1) * 16 * 0.04 / 51
    x, y, u, v = np.meshgrid(m, m, p, p, sparse=True)
    path = np.sqrt((x - u) ** 2 + (y - v) ** 2 + 0.06**2)
    inside = np.broadcast_to(u**2 + v**2 <= (16 * 0.04 / 51) ** 2, path.shape)
    cameras = (PlenopticCamera(**STEEP, mla_absorption=each) for each in (0.0, 15.0))
    clear, dimmed = (sky(camera, 16, "wave", wavelength=550.0)[8:-8, 8:-8].mean() for camera in cameras)
    assert dimmed / clear == pytest.approx(np.exp(-15 * path)[inside].mean(), rel=0.005)
