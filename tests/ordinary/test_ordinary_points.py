"""Points through ordinary cameras: against the Airy pattern and sums over the pupil written here."""

import json
import math
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import scipy
from cases import relative

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError, LensSystem, PlenopticCamera
from mitsuba_plenoptic.prescription import paraxial

WAVELENGTH, FOCUS, F, A = 550.0, 300.0, 50.0, 3.0
LAMBDA, B = WAVELENGTH * 1e-6, F * FOCUS / (FOCUS - F)
AIRY = 0.61 * LAMBDA * B / A
METHODS = ("patch", "full_field")


def ordinary(pixel=0.003, resolution=(16, 16), **given):
    thin = {"focal_length": F, "mla_distance": B, "aperture_radius": A, "resolution": resolution}
    return PlenopticCamera(mla_lattice="none", detector_width=pixel * resolution[0], **thin | given)


def nodes(camera, axis, count):
    """Positions within the pixels along an axis, and the weights of their sum over each pixel."""
    places, weights = np.polynomial.legendre.leggauss(count)
    half = camera.pixel_size / 2
    return (camera.pixel_coordinates(axis)[:, None] + places * half).ravel(), weights * half


def over_pixels(camera, intensity, count):
    """The integrals over pixels of samples at `nodes`."""
    _, weights = nodes(camera, 0, count)
    rows, columns = camera.shape
    return np.einsum("iajb,a,b->ij", intensity.reshape(rows, count, columns, count), weights, weights)


def airy(camera, place, count):
    (x, _), (y, _) = (nodes(camera, axis, count) for axis in (0, 1))
    v = 2 * math.pi / LAMBDA * A * np.maximum(np.hypot(x - place[0], y[:, None] - place[1]), 1e-12) / B
    return over_pixels(camera, (2 * scipy.special.j1(v) / v) ** 2 * math.pi * (A / (LAMBDA * B)) ** 2, count)


def zernike_path(wavefront, x, y):
    """A wavefront in mm, of Noll's polynomials up to the eleventh, over a pupil of radius 1."""
    square, root = x * x + y * y, np.sqrt
    polynomials = [
        1, 2 * x, 2 * y, root(3) * (2 * square - 1), root(6) * 2 * x * y, root(6) * (x * x - y * y),
        root(8) * (3 * square - 2) * y, root(8) * (3 * square - 2) * x, root(8) * (3 * x * x * y - y**3),
        root(8) * (x**3 - 3 * x * y * y), root(5) * (6 * square**2 - 6 * square + 1),
    ]  # fmt: skip
    return 633e-6 * sum(each * polynomial for each, polynomial in zip(wavefront, polynomials, strict=False))


def huygens(camera, position, samples=80, count=3):
    """A sum of spherical waves from the pupil, which an ideal lens sends to the image of a point."""
    along = (np.arange(samples) + 0.5) * 2 / samples - 1
    x, y = (each[np.hypot(*np.meshgrid(along, along)) <= 1] for each in np.meshgrid(along, along))
    distance = 1 / (1 / F - 1 / position[2])
    at = -np.array(position[:2]) * distance / position[2]
    path = zernike_path(camera.wavefront, x, y) - np.sqrt(distance**2 + (A * x - at[0]) ** 2 + (A * y - at[1]) ** 2)
    (across, _), (down, _) = (nodes(camera, axis, count) for axis in (0, 1))
    field = np.empty((len(down), len(across)), complex)
    for row, height in enumerate(down):
        far = np.sqrt(B**2 + (A * x - across[:, None]) ** 2 + (A * y - height) ** 2)
        field[row] = (np.exp(2j * math.pi / LAMBDA * (path + far)) * B / far**2).sum(1) / LAMBDA
    step = (2 * A / samples) ** 2
    return over_pixels(camera, np.abs(field) ** 2, count) * step**2 / (len(x) * step)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("width", "resolution", "count"), [(0.25, 64, 3), (1, 32, 6), (10, 6, 50)])
def test_a_star_in_focus_is_an_airy_pattern(method, width, resolution, count, within=(0.2, 0.9)):
    camera = ordinary(width * AIRY, (resolution, resolution))
    place = np.array(within) * camera.pixel_size
    spread = mp.point_spread_function(camera, (*(-place * FOCUS / B), FOCUS), wavelength=WAVELENGTH, method=method)
    expected = airy(camera, place, count)
    x, y = (camera.pixel_coordinates(axis) - place[axis] for axis in (0, 1))
    encircled = np.cumsum((spread - expected).ravel()[np.argsort(np.hypot(x, y[:, None]), axis=None)])
    assert np.abs(encircled).max() < 0.004 and relative(spread, expected) < 0.005


STARS = {
    "coma": ((0, 0, 0, 0, 0, 0, 0.1, 0.2), (0.0, 0.0, FOCUS)),
    "astigmatism": ((0, 0, 0, 0, 0.15, 0.1), (0.02, 0.0, FOCUS)),
    "spherical": ((0,) * 10 + (0.15,), (0.0, 0.01, FOCUS)),
    "beyond focus": ((), (0.0, 0.0, 306.0)),
    "before focus": ((0, 0, 0, 0, 0, 0, 0, 0.1), (0.0, 0.0, 295.0)),
    "cut by the film": ((), (-0.12, 0.0, 320.0)),
}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * ("focus" in n)) for n in STARS])
def test_aberrated_and_defocused_stars_are_sums_over_the_pupil(name):
    wavefront, position = STARS[name]
    camera = ordinary(wavefront=wavefront)
    expected = huygens(camera, position)
    for method in METHODS:
        spread = mp.point_spread_function(camera, position, wavelength=WAVELENGTH, method=method)
        assert relative(spread, expected) < 0.01


def test_both_methods_agree_behind_a_prescription():
    camera = ordinary(main_lens="double_gauss", focal_length=None, mla_distance=None, focus_distance=2000.0)
    patch, whole = (mp.point_spread_function(camera, (0.0, 0.0, 2000.0), wavelength=550.0, method=m) for m in METHODS)
    assert 0.5 < whole.sum() < 1 and relative(patch, whole) < 0.002


def test_parameters_of_an_array_have_no_derivative():
    operator = mp.CaptureOperator(ordinary(), [(0.01, 0.0, 305.0)], wavelength=WAVELENGTH)
    for name in ("mla_pitch", "detector_distance"):
        with pytest.raises(InputError, match=rf"^{name}: mla_lattice = none"):
            operator.derivative([1.0], {name: 1.0})


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
    """Yield each point's height, its rays' slopes (Optiland's z goes with light), which pass, and how these land."""
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
    numbers = paraxial(mp.read_prescription("double_gauss_f2"))
    assert numbers.focal_length == pytest.approx(50, rel=2e-3)
    assert numbers.back_focal / numbers.focal_length == pytest.approx(0.71436, abs=1e-4)
