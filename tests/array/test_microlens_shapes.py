"""Microlenses of any shape, by rays and waves, against surfaces and propagation computed here."""

import json

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, error, sky, small_camera
from drjit.llvm import Float64

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.array import Conic, Sampled, ZoneLens
from mitsuba_plenoptic.fields.microlens_orders import PlaneFactor, axis_orders
from tools.bench.cases.arrays import GREEN, SHAPES, X, Y, bumpy, path_of, propagated

LINE_D = 587.5618
"""Helium's yellow line, in nanometres."""

shapes = pytest.mark.parametrize("name", SHAPES)


def test_a_paraboloid_has_the_orders_of_a_parabolic_phase():
    camera = mp.PlenopticCamera(mla_medium=1.4, mla_shape=Conic(0.2, -1.0, glass=1.6))
    assert camera.mla_focal_length == pytest.approx(1.4 * 0.2 / 0.6)
    plain = camera.replace(mla_shape=None, mla_focal_length=camera.mla_focal_length)
    along, across = (axis_orders(plain, GREEN, 30, axis)[0] for axis in (0, 1))
    found = PlaneFactor(camera, GREEN, 31 * GREEN * 1e-6 / 0.064 * np.sqrt(2)).orders()
    middle = found.shape[0] // 2
    found = found[middle - 30 : middle + 31, middle - 30 : middle + 31]
    assert np.abs(found - across[:, None] * along).max() < 1e-4
    assert error(found, across[:, None] * along) < 1e-4


@shapes
def test_phases_are_those_of_their_definitions(name):
    x, y = np.random.default_rng(0).uniform(-0.032, 0.032, (2, 400))
    for wavelength in (532.0, 550.0):
        difference = SHAPES[name].waves(x, y, wavelength) - path_of(name, x, y, wavelength) / (wavelength * 1e-6)
        if name == "relief":
            # Samples have jumps at places of their own.
            difference = difference[np.abs(difference - np.median(difference)) < 0.5]
            assert len(difference) > 350
        turned = np.exp(2j * np.pi * (difference - (difference[0] if name != "metasurface" else 0)))
        assert np.abs(turned / turned.mean() - 1).max() < 0.02


@shapes
def test_slopes_are_those_of_the_phase(name):
    shape, (x, y), step = SHAPES[name], np.random.default_rng(1).uniform(-0.031, 0.031, (2, 300)), 1e-6
    for axis, found in enumerate(shape.slopes(x, y)):
        by = (step, 0) if axis == 0 else (0, step)
        change = (shape.waves(x + by[0], y + by[1], LINE_D) - shape.waves(x - by[0], y - by[1], LINE_D)) / (2 * step)
        # Within zones the path of a relief follows the design wavelength's phase, and its first order this one's.
        ratio = LINE_D / 532.0 if name in ("zones", "relief") else 1.0
        smooth = np.abs(change) < 1e3
        assert smooth.mean() > 0.95
        assert np.allclose(found[smooth], ratio * change[smooth] * LINE_D * 1e-6, atol=2e-5)
    lanes = [Float64(values) for values in (x, y)]
    assert np.allclose(np.array(shape.waves(*lanes, GREEN)), shape.waves(x, y, GREEN))
    for one, other in zip(shape.slopes(*(mi.Float(values) for values in (x, y))), shape.slopes(x, y), strict=True):
        assert np.allclose(np.array(one), other, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "method"),
    [("sampled", "patch"), *(pytest.param(name, "full_field", marks=pytest.mark.slow) for name in SHAPES)],
)
def test_point_spreads_against_propagation(name, method):
    camera = small_camera(2, **HALF, mla_shape=SHAPES[name], mla_medium=1.3)
    position = np.array([0.03, -0.02, 114.0])
    found = mp.point_spread_function(camera, position, wavelength=GREEN, method=method)
    assert error(found, propagated(camera, name, position, GREEN)) < 0.005


@pytest.mark.parametrize(("name", "rotation"), [("sphere", 0.0), ("sampled", 20.0)])
def test_rays_refract_at_the_surface(name, rotation):
    """The tangential component of n times the direction changes by the gradient of the path."""
    camera = small_camera(2, mla_shape=SHAPES[name], mla_medium=1.3, mla_rotation=rotation)
    sensor = mi.load_dict(camera.to_sensor())
    film, lens = np.random.default_rng(1).random((2, 2, 1000)).astype(np.float32)
    ray, weight = sensor.sample_ray(0.0, 0.5, mi.Point2f(film), mi.Point2f(lens))
    p = (film.T.astype(float) - 0.5) * camera.detector_width
    chief = p * 120 / (120 + camera.detector_distance / 1.3)
    centre = np.stack(camera.lattice.centre(*camera.lattice.cell(*chief.T)), -1)
    offset = np.stack(camera.lattice.aperture_point(*lens.astype(float)), -1)
    within = np.column_stack([centre + offset - p, np.full(len(p), camera.detector_distance)])
    within *= 1.3 / np.linalg.norm(within, axis=1)[:, None]
    u, v = camera.lattice.to_frame(*offset.T)
    step = 1e-6
    turn = [
        (path_of(name, u + a, v + b, LINE_D) - path_of(name, u - a, v - b, LINE_D)) / (2 * step)
        for a, b in ((step, 0), (0, step))
    ]
    before = within[:, :2] + np.stack(camera.lattice.from_frame(*turn), -1)
    pupil = centre + offset + 120 * (before / np.sqrt(1 - (before**2).sum(1))[:, None])
    is_open = (pupil**2).sum(1) <= 25
    assert (np.array(weight)[0] > 0).mean() == pytest.approx(is_open.mean(), abs=0.002)
    assert np.abs(np.array(ray.o)[:2].T - pupil)[is_open].max() < 2e-3


def test_rays_of_each_colour_follow_its_first_order():
    mi.set_variant("llvm_ad_spectral")
    sensor = mi.load_dict(small_camera(1, mla_shape=ZoneLens(0.5), mla_offset=(0.032, 0.032)).to_sensor())
    lens = mi.Point2f(np.random.default_rng(1).random((2, 50)).astype(np.float32))
    ray, _ = sensor.sample_ray(0.0, np.linspace(0.1, 0.9, 50).astype(np.float32), mi.Point2f(0.5), lens)
    wavelength = np.array(ray.wavelengths)[0]
    m = (np.array(lens) - 0.5) * 0.064
    # From the detector's centre, at the line d in focus, by slope differences (lambda / lambda_d - 1) m / F.
    cosine = m / np.sqrt((m**2).sum(0) + 0.5**2) - m * wavelength / LINE_D / 0.5
    pupil = m + 120 * cosine / np.sqrt(1 - (cosine**2).sum(0))
    assert np.ptp(wavelength) > 100
    assert np.abs(np.array(ray.o)[:2] - pupil).max() < 2e-3


def white_micro_image(camera, name, wavelength, step=5e-4):
    """Return the micro-image of a wall behind a lens on the axis: its spot, moved over the image of the pupil."""
    count, pixels = 256, round(camera.mla_pitch / camera.pixel_size)
    place = (np.arange(count) - count // 2) * step
    x, y = np.meshgrid(place, place)
    z, b, lam = camera.reduced_distance, camera.mla_distance, wavelength * 1e-6
    along = (np.arange(200) + 0.5) / 200 * camera.mla_pitch - camera.mla_pitch / 2
    u, v = np.meshgrid(along, along)
    path = path_of(name, u, v, wavelength) + (u * u + v * v) * (1 / z + 1 / b) / 2
    wave = np.exp(-2j * np.pi * np.outer(place, along) / (lam * z))
    spot = np.abs(wave @ np.exp(2j * np.pi * path / lam) @ wave.T) ** 2
    # At the middles of steps, of which pixels have a whole number.
    inside = np.hypot(x + step / 2, y + step / 2) <= camera.pupil_radius * z / b
    image = np.fft.ifft2(np.fft.fft2(np.fft.ifftshift(spot)) * np.fft.fft2(inside)).real
    # The window is two lenses wide: neighbours bring the light that leaves it, and that of the next ones.
    image = sum(np.roll(image, (down, right), (0, 1)) for down in (0, count // 2) for right in (0, count // 2))
    each = round(camera.pixel_size / step)
    half = pixels * each // 2
    inner = image[count // 2 - half : count // 2 + half, count // 2 - half : count // 2 + half]
    return inner.reshape(pixels, each, pixels, each).mean((1, 3)) / spot.sum()


@pytest.mark.slow
def test_signed_rays_of_a_wall_against_its_moved_spot(name="sampled"):
    camera = small_camera(3, **HALF, mla_shape=SHAPES[name], mla_offset=(0.032, 0.032)).replace(resolution=(48, 48))
    found, expected = sky(camera, 64, "wave", wavelength=GREEN)[16:32, 16:32], white_micro_image(camera, name, GREEN)
    assert error(found, expected) < 0.025


@shapes
def test_shapes_from_their_forms(name, tmp_path):
    shape = SHAPES[name]
    camera = mp.PlenopticCamera(mla_shape=shape)
    text = json.dumps(shape.to_plain())
    (tmp_path / "lens.json").write_text(text)
    for given in (text, tmp_path / "lens.json"):
        assert mp.PlenopticCamera(mla_shape=given) == camera
    assert hash(mp.PlenopticCamera.from_json(camera.to_json())) == hash(camera)
    assert mi.load_string(f'<scene version="3.0.0">{camera.to_xml()}</scene>').sensors()[0].camera == camera
    assert camera.replace(mla_medium=1.5).mla_focal_length == pytest.approx(1.5 * camera.mla_focal_length)
    assert camera.replace(mla_shape=None).mla_focal_length == camera.mla_focal_length


def test_samples_from_files(tmp_path):
    height = bumpy(X, Y).astype(np.float32)
    np.save(tmp_path / "height.npy", height)
    mi.Bitmap(height).write(str(tmp_path / "height.exr"))
    shapes = [Sampled(given, 0.066) for given in (height, tmp_path / "height.npy", str(tmp_path / "height.exr"))]
    assert shapes[0] == shapes[1] == shapes[2]
