"""Pictures of photodiodes: sums, sides, mosaics, files; disparity against closed forms and traced pupils."""

import math

import numpy as np
import OpenEXR
import pytest
from cameras import white
from cases import facing, radiating, relative, scene_of
from refusals import refused, refuses
from scipy.signal import fftconvolve
from scipy.stats import qmc

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.design import design_warnings
from mitsuba_plenoptic.fitting import View
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import brightness_of
from mitsuba_plenoptic.refocus import RayRefocus
from tools.bench.cases import dual_pixels

CAMERA = mp.PlenopticCamera(
    focal_length=6.8, aperture_radius=6.8 / 3.6, focus_distance=1000.0, mla_focal_length=0.0043, mla_pitch=0.0024,
    detector_width=0.1536, resolution=(128, 128),
)  # fmt: skip
"""A telephone's camera, f/1.8, of 64 x 64 lenses above 2 x 2 pixels."""


def noise(*shape):
    return np.random.default_rng(0).random(shape, dtype=np.float32)


# -- pictures ----------------------------------------------------------------------------------------


def test_photodiodes_are_sums_of_pixels():
    image = noise(128, 128, 3)
    capture = mp.Capture(image, CAMERA)
    four = image.reshape(64, 2, 64, 2, 3).transpose(1, 3, 0, 2, 4)
    for layout, expected in (((2, 1), four.sum(0)[None]), ((1, 2), four.sum(1)[:, None]), ((2, 2), four)):
        np.testing.assert_allclose(mp.dual_pixel(capture, layout=layout), expected, rtol=1e-6)
    crop = CAMERA.replace(crop_offset=(4, 6), crop_size=(12, 20))
    part = mp.dual_pixel(mp.Capture(image[6:26, 4:16], crop)).values
    np.testing.assert_array_equal(part, mp.dual_pixel(capture)[:, :, 3:13, 2:8].values)


def test_near_things_lie_further_right_in_the_left_picture():
    """As for a pair of eyes; a lamp nearer than the plane in focus, rendered."""
    distance = 400.0
    scene = scene_of(CAMERA.to_sensor(), "direct", lamp=facing(distance, 0.4, **radiating()))
    halves = mp.dual_pixel(mp.render_capture(scene, spp=1024))
    left, right = (float((each * each.s).sum() / each.sum()) for each in halves[0])
    assert right - left == pytest.approx(mp.half_disparity(CAMERA, distance), rel=0.01)
    assert float(halves[0, 0].sum() / halves.sum()) == pytest.approx(0.5, abs=0.005)


def test_quad_mosaics():
    """Each lens has one colour, so that each photodiode's picture is a Bayer mosaic."""
    image = np.broadcast_to(np.array([1.0, 2.0, 3.0], np.float32), (128, 128, 3))
    quiet = mp.Detector(read_noise=0, bits=16, full_well=60000, quantum_efficiency=1, mosaic="QUAD_GRBG")
    exposed = mp.expose(mp.Capture(image, CAMERA, (650.0, 550.0, 450.0)), quiet, photons=10000)
    halves = mp.dual_pixel(exposed)
    assert halves.attrs["mosaic"] == "GRBG"
    assert halves[0, 0, :2, :2].values == pytest.approx(2 * np.array([[2.0, 1.0], [3.0, 2.0]]), rel=0.05)
    shifted = CAMERA.replace(crop_offset=(2, 0), crop_size=(8, 8))
    part = mp.Capture(exposed.image[:8, 2:10], shifted, metadata=exposed.metadata)
    assert mp.dual_pixel(part).attrs["mosaic"] == "RGGB"
    refuses("Bayer mosaics", mp.demosaic, exposed)
    bayer = mp.expose(mp.Capture(image, CAMERA), mp.Detector(mosaic="RGGB"), photons=100)
    refuses("several colours", mp.dual_pixel, bayer)
    refuses(r"layout = \(3, 1\)", mp.dual_pixel, exposed, layout=(3, 1))
    refuses("halves: they are GRBG mosaics", mp.match_halves, halves)


# -- point spreads -----------------------------------------------------------------------------------


def centroids(bank, axis):
    return ((bank * bank[axis]).sum(("t", "s")) / bank.sum(("t", "s"))).values


def test_halves_of_a_defocused_point_are_half_discs():
    """Centroids 8 R / (3 pi) apart, from before and behind the plane in focus, for blurs of 8 lenses or more."""
    for focus, depth in ((1200.0, 350.0), (500.0, 1e6)):
        each = CAMERA.replace(focus_distance=focus)
        radius = each.blur_diameter(depth) / each.mla_pitch / 2
        assert radius > 8
        bank = mp.psf_bank(each, [depth])
        left, right = centroids(bank, "s")[0, 0, 0]
        expected = mp.half_disparity(each, depth)
        assert float(mp.bank_disparity(bank)[0, 0]) == pytest.approx(right - left, rel=1e-5)
        assert abs(expected) == pytest.approx(8 * radius / (3 * math.pi))
        assert right - left == pytest.approx(expected, rel=0.005)
        assert bank.sum(("t", "s")).values.ravel() == pytest.approx([0.5, 0.5], abs=2e-3)
        above = mp.bank_disparity(mp.psf_bank(each, [depth], layout=(1, 2)), "vertical")
        assert float(above[0, 0]) == pytest.approx(expected, rel=0.005)
        quarters = mp.psf_bank(each, [depth], layout=(2, 2))
        assert centroids(quarters, "s")[0, 0].mean(0) == pytest.approx([left, right], abs=1e-3)


@pytest.mark.slow
def test_a_bank_has_the_pupil_and_the_brightness_of_each_lens():
    """Against the spread of the whole array, whose lenses are not shifted alike."""
    camera = CAMERA.replace(
        mla_cra=(0.0, 0.0, 3.0, 24.0),
        mla_transmissions=np.random.default_rng(0).uniform(0.4, 1, (90, 90)).tolist(),
        vignetting={"radius": [1.0, 0, 0, -0.6, 0, -0.6], "scale": 24 * CAMERA.mla_pitch},
    )
    bank = mp.psf_bank(camera, [700.0], [(0.0361, 0.0217)], layout=(2, 2), model="wave", wavelength=GREEN, size=13)
    index = (np.array([bank.x[0], bank.y[0]]) / CAMERA.mla_pitch - 0.5).round().astype(int)
    point = np.append(-700.0 / camera.mla_distance * np.array(camera.lattice.centre(*index)), 700.0)
    image = mp.point_spread_function(camera, point, wavelength=GREEN, method="full_field")
    left, top = 2 * (32 + index - 6)
    expected = image[top : top + 26, left : left + 26].reshape(13, 2, 13, 2).transpose(1, 3, 0, 2)
    assert relative(bank.values[0, 0], expected) < 0.004


SIZE = {"full_frame_dual": (2.68, 6720, 4480), "phone_quad": (1.22, 4032, 3024), "phone_quad_bayer": (1.12, 4000, 3000)}


@pytest.mark.parametrize("name", SIZE)
def test_presets_divide_the_light_alike_up_to_the_corner(name):
    camera = mp.PlenopticCamera.preset(name)
    assert (1e3 * camera.pixel_size, *np.array(camera.resolution) / 2) == pytest.approx(SIZE[name])
    assert [warning for wavelength in (450, 550, 650) for warning in design_warnings(camera, wavelength)] == []
    corner = (0.48 * camera.detector_width, 0.48 * camera.detector_height)
    bank = mp.psf_bank(camera, [0.7 * camera.focus_distance], [(0.0, 0.0), corner], layout=(2, 2))
    quarters = bank.sum(("t", "s")).values[0]
    for axis in (1, 2):
        assert quarters.sum(axis) == pytest.approx(0.5, abs=0.01)
    # Snell's law compresses the pupil's image along the radius, so that quarters are sectors of an ellipse.
    slope = np.array([float(bank[axis][1]) for axis in ("x", "y")]) / camera.mla_distance
    stretch = np.eye(2) + (1 - camera.mla_medium**-2) * np.outer(slope, slope)
    x, y = (side / np.linalg.norm(side) for side in stretch)
    assert slope @ slope > 0.1
    alike = math.acos(x @ y) / (2 * math.pi)
    expected = np.array([[[0.25, 0.25], [0.25, 0.25]], [[alike, 0.5 - alike], [0.5 - alike, alike]]])
    assert quarters == pytest.approx(expected, abs=0.01)


GREEN = 550.0
LENSES, SAMPLES, AROUND = 12, 32, 17
"""Lenses across the recorded window, samples across a lens, and lenses across the window of a star's waves."""


def window(angle, **changes):
    """Return a telephone's camera that records lenses around a chief-ray angle in degrees, and the place of one."""
    camera = mp.PlenopticCamera.preset("phone_quad").replace(**changes)
    width, height = camera.resolution
    across = round(camera.mla_distance * math.tan(math.radians(angle)) / camera.mla_pitch)
    corner = (width // 2 + 2 * across - LENSES, height // 2 - LENSES)
    camera = camera.replace(crop_offset=corner, crop_size=(2 * LENSES, 2 * LENSES))
    return camera, ((across + 0.5) * camera.mla_pitch, 0.5 * camera.mla_pitch)


def left_of_even(camera, model, spp):
    """Return the part of an even scene's light in the left halves, and its light over the closed form by ideal rays."""
    wavelength = {"wavelength": GREEN} if model == "wave" else {}
    capture = mp.render_capture(white(camera), model=model, spp=spp, **wavelength)
    left, right = mp.dual_pixel(capture).values[0, :, 2:-2, 2:-2].mean((1, 2), dtype=float)
    return left / (left + right), (left + right) / 4 / mp.design.white_mean(camera)


def left_of_point(camera, field, model):
    """Return the part of the light of a point in focus in its left half."""
    bank = mp.psf_bank(camera, [1000.0], [field], model=model, wavelength=GREEN, size=9)
    left, right = bank.sum(("t", "s")).values.ravel()
    return float(left / (left + right))


def _through(camera, field, count):
    """Return the lens's distance from its pixels' middle, points of it, and the direction cosines of its light."""
    n, b = camera.mla_medium, camera.mla_distance
    # The chief ray's way in the medium, by Snell's law.
    height = math.hypot(*field)
    way = 0.0
    for _ in range(20):
        sine = math.sin(math.atan((height - way) / b)) / n
        way = camera.detector_distance * sine / math.sqrt(1 - sine * sine)
    shift = np.array(field) * (way / height)
    u = qmc.Sobol(4, seed=0).random(count)
    d = (u[:, :2] - 0.5) * camera.mla_pitch
    radius, angle = camera.aperture_radius * np.sqrt(u[:, 2]), 2 * np.pi * u[:, 3]
    slope = (np.array(field) - shift + d - np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)) / b
    return shift, d, slope / np.sqrt(1 + (slope**2).sum(1, keepdims=True))


def left_by_cosines(camera, field, count=2**17):
    """Return the left part of the light of pupil and lens, ray by ray: the lens turns direction cosines."""
    shift, d, cosine = _through(camera, field, count)
    behind = (cosine - d * (camera.mla_medium / camera.mla_focal_length)) / camera.mla_medium
    landed = d - shift + camera.detector_distance * behind / np.sqrt(1 - (behind**2).sum(1, keepdims=True))
    return float((np.floor(landed[:, 0] / camera.pixel_size) % 2 == 1).mean())


def left_of_star(camera, field, count=2**12):
    """Return the same by plane waves from the pupil through thin phases, for a point imaged on a lens's centre."""
    shift, *_ = _through(camera, field, 1)
    centre = np.array(field) - shift
    n, k, pitch = camera.mla_medium, 2e6 * math.pi / GREEN, camera.mla_pitch
    u = qmc.Sobol(2, seed=0).random(count)
    radius, angle = camera.aperture_radius * np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    pupil = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    slope, chief = (centre - pupil) / camera.mla_distance, centre / camera.mla_distance
    cosine = slope / np.sqrt(1 + (slope**2).sum(1, keepdims=True))
    base = chief / math.sqrt(1 + chief @ chief)
    x = ((np.arange(AROUND * SAMPLES) + 0.5) / SAMPLES - AROUND / 2) * pitch
    waves = [np.exp(1j * k * np.outer(x, cosine[:, axis] - base[axis])) for axis in (0, 1)]
    # Equal powers from equal areas of the pupil.
    arriving = (waves[1] * (1 - (cosine**2).sum(1))) @ waves[0].T
    inner = x - np.round(x / pitch) * pitch
    along = np.exp(-0.5j * k * n * inner**2 / camera.mla_focal_length)
    step = np.fft.fftfreq(len(x), 1 / len(x)) * (2 * math.pi / k / (AROUND * pitch))
    square = n * n - (base[0] + step) ** 2 - (base[1] + step[:, None]) ** 2
    axial = np.where(square > 0, np.exp(1j * k * camera.detector_distance * np.sqrt(np.abs(square))), 0)
    moved = np.exp(1j * k * (step[:, None] * shift[1] + step * shift[0]))
    light = (np.abs(np.fft.ifft2(np.fft.fft2(arriving * np.outer(along, along)) * axial * moved)) ** 2).sum(0)
    return float(light.reshape(AROUND, 2, -1)[:, 0].sum() / light.sum())


def test_lenses_aligned_by_snells_law_halve_the_light():
    """Of an even scene and of a point; parabolic rays have coma, and all rays the light of the closed form."""
    camera, field = window(20)
    left, light = left_of_even(camera, "ray", 8192)
    assert left == pytest.approx(0.5, abs=0.01)
    assert light == pytest.approx(1, abs=0.01)
    assert left_of_point(camera, field, "ray") == pytest.approx(0.5, abs=0.01)
    camera, field = window(20, lens_model="parabolic")
    left, light = left_of_even(camera, "ray", 8192)
    assert left == pytest.approx(left_by_cosines(camera, field), abs=0.006)
    assert light == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_halves_by_waves_are_sums_of_plane_waves():
    camera, field = window(30)
    _, light = left_of_even(camera, "wave", 64)
    # A little is turned into evanescent waves.
    assert light == pytest.approx(0.998, abs=0.004)
    assert left_of_point(camera, field, "wave") == pytest.approx(left_of_star(camera, field, 2**11), abs=0.005)


def test_light_strays_over_the_whole_detector():
    stray = mp.StrayLight([[0.2, 0.2], [0.2, 0.2]])
    bank, strayed = (mp.psf_bank(CAMERA.replace(stray_light=x), [400.0], size=19) for x in (0.0, stray))
    within = (2 * 19) ** 2 / np.prod(CAMERA.resolution)
    assert float(strayed.sum()) == pytest.approx(float(bank.sum()) * (1 + 0.2 * within), rel=1e-5)


@pytest.mark.parametrize("model", ["ray", "wave"])
def test_a_bank_at_infinity_is_the_limit_of_far_points(model):
    far, infinite = mp.psf_bank(CAMERA, [1e9, math.inf], [(0.02, -0.015)], model=model, size=19).values
    assert np.linalg.norm(infinite - far) < 1e-4 * np.linalg.norm(far)


@pytest.mark.slow
def test_vignetted_halves_follow_the_traced_pupil():
    """The double Gauss on the axis, at the edge and in the corner, against rays from the scene's point."""
    for row in dual_pixels.centroids(names=("double Gauss, f/3",)):
        assert row["off"] < 0.005, row
        assert row["off_light"] < 0.003, row


def of_camera(**changes):
    camera = CAMERA.replace(**changes)
    return mp.dual_pixel(mp.Capture(np.zeros(camera.shape, np.float32), camera))


test_other_cameras_and_mistakes_of_banks_are_refused = refused(
    (lambda: of_camera(mla_pitch=0.0036), "mla_pitch = 0.0036"),
    (lambda: of_camera(mla_lattice="hexagonal"), "mla_lattice = hexagonal"),
    (lambda: of_camera(mla_offset=(0.0012, 0.0)), "between two lenses"),
    (lambda: of_camera(crop_offset=(1, 0), crop_size=(126, 128)), "between two lenses"),
    (lambda: mp.psf_bank(CAMERA, [500.0], [1.0]), r"fields of shape \(1,\): "),
    (lambda: mp.psf_bank(CAMERA, [500.0], [(5.0, 0.0)]), r"fields = \(5, 0\)"),
)


# -- disparity ---------------------------------------------------------------------------------------


def test_matching_moved_pictures_finds_the_move():
    scene = np.random.default_rng(0).random((64, 80))
    pair = np.stack([scene[:, 10:74], scene[:, 7:71]], axis=-1)
    pixels = np.repeat(pair[:, None], 2, axis=1).reshape(128, 128).astype(np.float32)
    found = mp.match_halves(mp.dual_pixel(mp.Capture(pixels, CAMERA)), window=9, search=5)
    assert found[10:-10, 10:-10].values == pytest.approx(3.0, abs=0.2)
    flat = mp.match_halves(mp.dual_pixel(mp.Capture(np.ones((128, 128), np.float32), CAMERA)), window=9, search=5)
    assert np.isnan(flat.values).all()
    # What one lens shows, however bright, counts in its windows alone.
    pixels[64:66, 80:82] *= 1000
    lit = mp.match_halves(mp.dual_pixel(mp.Capture(pixels, CAMERA)), window=9, search=5)
    assert lit[10:-10, 10:25].values == pytest.approx(3.0, abs=0.2)
    refuses("1 pictures along v", mp.match_halves, mp.dual_pixel(mp.Capture(pixels, CAMERA)), "vertical")


@pytest.mark.parametrize(("disparity", "side"), [(0.5, 4), (-0.77, 16), (2.37, 16), (-3.5, 4)])
def test_matching_finds_the_disparity_of_half_discs(disparity, side):
    """Coloured patches of half a lens and of two, blurred by half discs on eight samples a lens, and noise."""
    lenses, radius = 72, 3 * np.pi / 8 * 8 * abs(disparity)
    x = (np.arange(-405, 405) + 0.5) / 9
    inside = np.hypot(x, x[:, None]) < radius
    discs = [(inside & (way * x > 0)).reshape(90, 9, 90, 9).mean((1, 3)) for way in (disparity, -disparity)]
    camera = CAMERA.replace(detector_width=0.0024 * lenses, resolution=(2 * lenses, 2 * lenses))
    for seed in range(3):
        scene = np.kron(np.random.default_rng(seed).random((3, 8 * 84 // side, 8 * 84 // side)), np.ones((side, side)))
        pair = [fftconvolve(scene, disc[None] / disc.sum(), "same", axes=(1, 2))[:, 48:-48, 48:-48] for disc in discs]
        samples = np.stack(pair).reshape(2, 3, lenses, 8, lenses, 8).mean((3, 5))
        pixels = np.repeat(samples.transpose(2, 3, 0, 1)[:, None], 2, axis=1).reshape(2 * lenses, 2 * lenses, 3)
        capture = mp.Capture(pixels.astype(np.float32), camera, (610.0, 550.0, 465.0))
        halves = mp.dual_pixel(mp.expose(capture, mp.Detector(), photons=1000, seed=seed))
        found = mp.match_halves(halves)[16:-16, 16:-16]
        assert float(found.median()) == pytest.approx(-disparity, abs=0.1)
        assert np.isfinite(found).mean() > 0.5


FAST = mp.PlenopticCamera(
    focal_length=2.0, aperture_radius=0.55, mla_distance=2.2, mla_pitch=0.0028 * 2.2 / (2.2 + 0.004 / 1.5),
    mla_focal_length=0.004, mla_medium=1.5, detector_width=0.28, resolution=(200, 200),
)  # fmt: skip
"""A camera of f/1.8, of lenses aligned to chief rays by a smaller pitch."""


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "least"), [({"lens_model": "parabolic"}, 0.97), ({"aperture_radius": 0.07}, 0.93)])
def test_banks_are_as_wide_as_aberrated_and_diffracted_light(changes, least):
    """A point in focus: 13 lenses of aberration, and an Airy pattern whose third dark ring has 94 % of the light."""
    for model in ("ray", "wave"):
        bank = mp.psf_bank(FAST.replace(**changes), [FAST.focus_distance], model=model)
        assert least < float(bank.sum()) <= 1.001, model


def test_the_command(tmp_path, run, complaint):
    capture = mp.Capture(noise(128, 128), CAMERA)
    mp.write_capture(tmp_path / "raw.exr", capture)
    said = run("dual", tmp_path / "raw.exr", "-o", tmp_path / "halves.exr")
    assert said.endswith("2 x 1 pictures of 64 x 64 lenses\n")
    parts = {part.name(): part for part in OpenEXR.File(str(tmp_path / "halves.exr"), separate_channels=True).parts}
    assert list(parts) == ["left", "right", "sum"]
    np.testing.assert_array_equal(parts["right"].channels["Y"].pixels, mp.dual_pixel(capture)[0, 1])
    assert "2 x 2 pictures" in run("dual", tmp_path / "raw.exr", "-o", tmp_path / "four.png", "--layout", "2x2")
    assert "--layout" in complaint("dual", tmp_path / "raw.exr", "-o", tmp_path / "x.exr", "--layout", "3x1")


ALIGNED_LENSES = 5


def around(part):
    """Return the crop of five by five lenses at a part of the half diagonal, and the middle lens's indices."""
    camera = mp.PlenopticCamera.preset("phone_quad")
    half = np.array(camera.resolution) // 2
    index = (part * half / 2).astype(int)
    corner = half + 2 * index - (ALIGNED_LENSES - 1)
    return camera.replace(crop_offset=tuple(corner.tolist()), crop_size=(2 * ALIGNED_LENSES, 2 * ALIGNED_LENSES)), index


def test_regular_lenses_are_where_the_aligned_ones_are():
    camera, index = around(part := 0.95)
    i, j = (np.array([-2.0, 0.0, 2.0]) + start for start in index)
    place, near = camera.lattice.regular.centre(i, j), camera.regular.lattice.centre(i, j)
    assert not camera.regular.mla_cra
    shift = np.array(camera.lattice.centre(i, j)) - place
    assert np.max(np.abs(shift)) > part * 2e-4
    for regular_place, aligned, aside in zip(near, place, shift, strict=True):
        assert regular_place == pytest.approx(aligned + aside, abs=2e-6)


def test_points_are_captured_as_banks_have_them():
    camera, index = around(0.9)
    distance, field = 0.98 * camera.focus_distance, [camera.lattice.regular.centre(*index.astype(float).tolist())]
    lens = np.array(camera.lattice.centre(*index.astype(float)))
    point = (*(-lens * distance / camera.mla_distance), distance)
    operator = mp.CaptureOperator(camera, [point], wavelength=550, accuracy=0)
    bank = mp.psf_bank(camera, [distance], field, layout=(2, 2), model="wave", size=ALIGNED_LENSES)[0, 0]
    image = operator.forward([1.0]).reshape(ALIGNED_LENSES, 2, ALIGNED_LENSES, 2).transpose(1, 3, 0, 2)
    assert image.sum() > 0.2
    assert np.linalg.norm(image - bank.values) < 0.01 * np.linalg.norm(image)


@pytest.mark.filterwarnings("ignore:fit")
def test_methods_of_regular_arrays_take_aligned_presets():
    """A small crop, as full presets need much memory."""
    camera, _ = around(0.5)
    regular, distance = camera.regular, camera.focus_distance
    place = np.array([camera.pixel_coordinates(axis).mean() for axis in (0, 1)])
    points = [(*(-place * distance / camera.mla_distance), distance)]
    image = mp.CaptureOperator(camera, points, wavelength=550).forward([1.0])
    view = View(brightness_of(regular, main_lens(regular)) * image, points, [1.0], noise=1e-3)
    fit = mp.fit(camera, view, "mla_focal_length", wavelength=550, accuracy=0.01, steps=2)
    assert fit.camera.mla_focal_length == pytest.approx(camera.mla_focal_length, rel=1e-3)
    assert not fit.camera.mla_cra
    assert RayRefocus(camera, distance).camera == regular


def test_dual_pixels_whose_spots_are_wider_than_a_pixel_are_told():
    camera = mp.PlenopticCamera.preset("phone_quad")
    (warning,) = mp.design.design_warnings(camera, 550 * mp.design.mla_fresnel_number(camera, 550) / 0.49)
    assert "their Fresnel number is 0.49" in warning
