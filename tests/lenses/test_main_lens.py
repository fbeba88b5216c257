"""The thin lens: its rays against the ray formulas, its path against the direct formula and its own derivative."""

import numpy as np
import pytest
from drjit.llvm import Float64

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.lenses.pupil import Pupil
from mitsuba_plenoptic.lenses.thin import ThinLens, Wavefront, noll, zernike

WAVELENGTH, LAMBDA = 633.0, 633e-6
LENS = ThinLens(80.0, Pupil(5.0, 120.0), "parabolic")


def pupil_and_points(count=500, seed=0):
    """Points anywhere in the pupil, and before it from 5 mm to what counts as infinity."""
    rng = np.random.default_rng(seed)
    radius, angle = 5 * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    g = 10 ** rng.uniform(2, 6, count)
    return (radius * np.cos(angle), radius * np.sin(angle)), (*(rng.uniform(-0.05, 0.05, (2, count)) * g), g)


@pytest.mark.parametrize("array", [np.asarray, Float64], ids=["NumPy", "Dr.Jit"])
@pytest.mark.parametrize("model", ["ideal", "parabolic"])
def test_a_traced_ray_obeys_the_ray_formulas(array, model):
    place, slope = (0.4, -0.3), (0.02, -0.041)
    found, found_slope, is_open = ThinLens(80.0, Pupil(5.0, 120.0), model).trace(
        tuple(array([value]) for value in place), tuple(array([value]) for value in slope)
    )
    P = [m + 120 * t for m, t in zip(place, slope, strict=True)]
    assert np.allclose(np.ravel([np.array(p) for p in found[:2]]), P, atol=1e-12)
    assert found[2] == 0
    assert np.array(is_open).tolist() == [np.hypot(*P) <= 5.0]
    if model == "parabolic":
        cosines = [s - p / 80 for s, p in zip(np.array(slope) / np.sqrt(1 + np.dot(slope, slope)), P, strict=True)]
        expected = np.array(cosines) / np.sqrt(1 - np.dot(cosines, cosines))
    else:
        expected = [t - p / 80 for t, p in zip(slope, P, strict=True)]
    assert np.allclose(np.ravel([np.array(t) for t in found_slope]), expected, atol=1e-9)


@pytest.mark.parametrize(("distance", "vergence"), [(240.0, 1 / 120), (np.inf, 1 / 80), (80.0, 0.0)])
def test_vergence_is_that_of_the_image(distance, vergence):
    assert LENS.vergence(distance) == pytest.approx(vergence)


LENSES = {
    "paper": PlenopticCamera(),
    "lytro, parabolic": PlenopticCamera.preset("lytro").replace(lens_model="parabolic"),
    "aberrations": PlenopticCamera(wavefront=(0, 0, 0, 3.0, 5.0, 0, 4.0)),
    "aberrations, parabolic": PlenopticCamera(wavefront=(0, 0, 0, 3.0, 5.0, 0, 4.0), lens_model="parabolic"),
    "distortion": PlenopticCamera(distortion=(1e-3, -2e-6, 0, 1e-4, -2e-4)),
    "distortion, parabolic": PlenopticCamera(distortion=(-1e-3, 0, 0, 1e-4, 0), lens_model="parabolic"),
    "objective": PlenopticCamera.preset("lfm_water"),
}


@pytest.mark.parametrize("name", LENSES)
def test_rays_through_pupil_points_and_their_landing_are_those_of_trace(name):
    camera = LENSES[name]
    lens, rng = main_lens(camera), np.random.default_rng(0)
    place = np.array([camera.detector_width / 2.2]) * rng.uniform(-1, 1, (2, 200))
    radius, angle = lens.pupil.radius * np.sqrt(rng.random(200)), rng.uniform(0, 2 * np.pi, 200)
    pupil = radius * np.cos(angle), radius * np.sin(angle)
    slope = tuple(lens.pupil.slope(P, m) for P, m in zip(pupil, place, strict=True))
    start, after, is_open = lens.trace(tuple(place), slope)
    assert np.all(is_open)
    point, direction, _ = lens.ray(pupil, tuple(place))
    for one, other in zip((*start, *after), (*point, *direction), strict=True):
        assert np.allclose(one, other, rtol=1e-12, atol=1e-12)
    distance = rng.uniform(0.7, 3, 200) * abs(camera.focus_distance or 1)
    seen = *(x + (distance - start[2]) * t for x, t in zip(start, after, strict=False)), distance
    assert np.abs(np.array(lens.land(pupil, seen)) - place).max() < 1e-9 * camera.detector_width
    assert np.allclose([lens.pupil.point(m, t) for m, t in zip(place, slope, strict=True)], pupil)
    # Coma moves chief rays, too, of which `images` does not know.
    if not camera.wavefront:
        assert np.allclose(lens.images(np.stack(seen, -1)).T, lens.land((0 * angle, 0 * angle), seen), atol=1e-9)


def test_the_path_is_that_of_the_direct_formula():
    """(|P - X| - |X| - P^2 / 2 f1) / lambda, which loses digits as the lengths' difference does."""
    (Px, Py), (X, Y, g) = pupil, point = pupil_and_points()
    far = np.sqrt(X**2 + Y**2 + g**2)
    expected = (np.sqrt((Px - X) ** 2 + (Py - Y) ** 2 + g**2) - far - (Px**2 + Py**2) / 160) / LAMBDA
    lost = 4 * np.finfo(float).eps * far / LAMBDA
    assert (np.abs(LENS.path(pupil, point, WAVELENGTH) - expected) < lost + 1e-9).all()
    of_drjit = LENS.path(tuple(map(Float64, pupil)), tuple(map(Float64, point)), WAVELENGTH)
    assert np.allclose(np.array(of_drjit), LENS.path(pupil, point, WAVELENGTH), rtol=0, atol=1e-8)


@pytest.mark.parametrize("distance", [8.0, 20.0, 1e4])
def test_paths_behind_an_ideal_lens_are_equal_to_the_image(distance):
    """Also to a virtual image, in front of the lens."""
    lens = ThinLens(10.0, Pupil(3.0, 12.0))
    point = 0.3 * distance, -0.1 * distance, distance
    x, y = np.random.default_rng(1).uniform(-2, 2, (2, 50))
    image = 1 / (1 / 10.0 - 1 / distance)
    X, Y = (-coordinate * image / distance for coordinate in point[:2])
    lengths = (np.sqrt((x - u) ** 2 + (y - v) ** 2 + image**2) for x, y, u, v in ((0, 0, X, Y), (x, y, X, Y)))
    expected = np.sign(image) * (next(lengths) - next(lengths))
    assert lens.path((x, y), point, 500.0) * 500e-6 == pytest.approx(expected, abs=1e-9)
    step = 1e-5
    for axis, found in enumerate(lens.cosines((x, y), point)):
        ends = (lens.path((x + side * step * (1 - axis), y + side * step * axis), point, 500.0) for side in (1, -1))
        assert found == pytest.approx((next(ends) - next(ends)) * 500e-6 / (2 * step), abs=1e-6)


def test_orthonormal_in_nolls_order():
    # The table of Noll (1976).
    expected = [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3), (4, 0), (4, 2)]
    assert [noll(j) for j in range(1, 13)] == expected
    nodes, weights = np.polynomial.legendre.leggauss(16)
    angle = 2 * np.pi * np.arange(64) / 64
    radius = np.sqrt((nodes + 1) / 2)[:, None]
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    values = np.array([np.polynomial.polynomial.polyval2d(x, y, zernike(j)) for j in range(1, 37)])
    assert np.allclose(np.einsum("iab,jab,a->ij", values, values, weights / 2) / 64, np.eye(36), atol=1e-12)
    # Defocus: root of 3 times 2 r^2 - 1.
    assert Wavefront([0, 0, 0, 1.0], 2.0).path(2.0, 0.0) == pytest.approx(3**0.5 * 633e-6)


def test_slopes_are_derivatives():
    wavefront, h = Wavefront(np.random.default_rng(0).normal(size=36).tolist(), 5.0), 1e-4
    across = (wavefront.path(1 + h, 0.5) - wavefront.path(1 - h, 0.5)) / (2 * h)
    up = (wavefront.path(1, 0.5 + h) - wavefront.path(1, 0.5 - h)) / (2 * h)
    assert wavefront.slope(1.0, 0.5) == pytest.approx((across, up), rel=1e-6)
