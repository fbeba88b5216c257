"""Wave refocusing: geometry of single pixels and lenses, energy, the routes against each other, bad input."""

import math

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, small_camera

from mitsuba_plenoptic import Capture, InputError, PlenopticCamera, point_spread_function, reconstruct, write_capture
from mitsuba_plenoptic.io.exr import read_exr
from mitsuba_plenoptic.refocus import planning, radiance, wave_methods
from mitsuba_plenoptic.refocus.lens_by_lens import reconstruct_lens_by_lens
from mitsuba_plenoptic.refocus.planning import plan
from mitsuba_plenoptic.refocus.wave_methods import BackwardFields, lit_window, reconstruct_subsets
from mitsuba_plenoptic.views import white_image

# Grey or random pixels and single ones are no captures, and a guard says so.
pytestmark = pytest.mark.filterwarnings("ignore:.*back through the main lens:mitsuba_plenoptic.PhysicsWarning")

SMALL = small_camera(20, **HALF)
METHODS = {"coherent": {"method": "coherent"}, "auto": {"method": "partial", "interleave": "auto"}}

most_methods = pytest.mark.parametrize("options", METHODS.values(), ids=METHODS.keys())
all_methods = pytest.mark.parametrize("options", [{"method": "ray"}, *METHODS.values()], ids=["ray", *METHODS.keys()])


def refocus(image, distance, camera=SMALL, wavelength=WAVELENGTH, method="ray", **options):
    if method != "ray":
        options["wavelength"] = wavelength
    return reconstruct(image, distance, camera=camera, method=method, **options)


@pytest.fixture
def sums(monkeypatch):
    """Make images sums over bins, not divided by white."""
    monkeypatch.setattr(radiance, "to_radiance", lambda task, sums, *_: sums[0])


def lit_inside(camera, first, last):
    """Return noise in a square of the detector, so that no light falls beside the image."""
    image = np.zeros(camera.shape, np.float32)
    image[first:last, first:last] = np.random.default_rng(0).random((last - first,) * 2)
    return image


def lens_of(p, camera):
    """Index of the chief-ray lens, written out."""
    b, z = camera.mla_distance, camera.detector_distance
    return np.floor(p * b / (b + z) / camera.mla_pitch)


def micro_image(camera, i, j, radius=None):
    """White disc under lens (i, j), of the micro-image's size or smaller."""
    px, py = (camera.pixel_coordinates(axis) for axis in (0, 1))
    b, z = camera.mla_distance, camera.detector_distance
    cx, cy = (((k + 0.5) * camera.mla_pitch) * (b + z) / b for k in (i, j))
    radius = radius or camera.micro_image_diameter / 2
    disc = np.hypot(px - cx, (py - cy)[:, None]) < radius
    return (disc & ((lens_of(px, camera) == i) & (lens_of(py, camera) == j)[:, None])).astype(np.float32)


def bin_of_pixel(p, camera, distance):
    """Bins from the centre at which the ray of a pixel through its lens's centre ends, written out."""
    b, z = camera.mla_distance, camera.detector_distance
    c = (lens_of(p, camera) + 0.5) * camera.mla_pitch
    P = c + b * (c - p) / z
    X = P + distance * ((c - p) / z - P / camera.focal_length)
    return -X * b / distance / camera.mla_pitch


def centroid(image):
    rows, columns = image.shape
    x, y = np.arange(columns) + 0.5 - columns / 2, np.arange(rows) + 0.5 - rows / 2
    total = image.sum(dtype=np.float64)
    return (image.sum(0, dtype=np.float64) @ x) / total, (image.sum(1, dtype=np.float64) @ y) / total


@all_methods
@pytest.mark.parametrize(("column", "row"), [(320 + 16, 320 + 16), (172, 462)], ids=["axis", "off"])
def test_a_lit_pixel_goes_where_geometry_says(options, column, row):
    image = np.zeros(SMALL.shape, np.float32)
    image[row, column] = 1
    px, py = SMALL.pixel_coordinates(0)[column], SMALL.pixel_coordinates(1)[row]
    for result in refocus(image, [105.0, 120.0, 140.0], **options):
        expected = [bin_of_pixel(p, SMALL, result.distance) for p in (px, py)]
        # Both pixels look through the inner half of the pupil, which keeps nearly all of their diffracted light.
        np.testing.assert_allclose(centroid(result.image), expected, atol=0.1)


def test_what_passes_the_pupil_lands_in_the_image():
    image, distances = lit_inside(SMALL, 220, 420), [112.0, 120.0, 132.0]
    lit = lit_window(image, SMALL)
    fields = BackwardFields(SMALL, WAVELENGTH, plan(SMALL, WAVELENGTH, distances, lit), interleave=1)
    (left, right), (top, bottom) = lit
    passed = sum(fields.power(field) for field in fields.at_pupil(np.sqrt(image[top:bottom, left:right])))
    assert 0.05 * image.sum() < passed < image.sum()
    for total in reconstruct_subsets(image, SMALL, distances, WAVELENGTH):
        assert total.sum() == pytest.approx(passed, rel=5e-3)


@pytest.mark.parametrize("oversample", [2, 10])
def test_fine_bins_of_single_lenses_are_those_of_full_fields(oversample):
    # In focus, where the power of a lens changes within a few bins; sums of few samples would be some percent off.
    image = micro_image(SMALL, 2, -3)
    at = [SMALL.focus_distance]
    full = reconstruct_subsets(image, SMALL, at, WAVELENGTH, oversample=oversample)[0]
    bins = (oversample, 4 * oversample)
    single, finer = (reconstruct_lens_by_lens(image, SMALL, at, WAVELENGTH, oversample=n)[0] for n in bins)
    assert np.linalg.norm(full - single) <= 1e-2 * np.linalg.norm(full)
    count = len(single)
    assert np.linalg.norm(finer.reshape(count, 4, count, 4).sum((1, 3)) - single) <= 1e-5 * np.linalg.norm(single)


def test_without_the_relay_planes_out_of_focus_stay_blurred():
    """A point at 140 mm, back at its distance: the literal reading of the paper spreads it widely."""
    X = -0.5 * SMALL.bin_size(140.0)
    spread = point_spread_function(SMALL, (X, X, 140.0), wavelength=WAVELENGTH)
    with_relay, without = (refocus(spread, 140.0, method="partial", relay=relay).image for relay in (True, False))
    assert without.max() < 0.5 * with_relay.max()


@all_methods
def test_finer_bins_add_up_to_the_coarse_ones(options, sums):
    image = lit_inside(SMALL, 250, 390)
    coarse, fine = (refocus(image, 127.5, oversample=count, **options) for count in (1, 3))
    assert fine.image.shape == (60, 60)
    assert fine.bin_size == pytest.approx(coarse.bin_size / 3)
    added = fine.image.reshape(20, 3, 20, 3).sum((1, 3))
    np.testing.assert_allclose(added, coarse.image, atol=5e-3 * coarse.image.max())


@most_methods
def test_pixels_below_zero_leave_no_light_on_average(options):
    """Noise of mean zero beside a lit square: cut off at zero it would be light."""
    dark = np.random.default_rng(1).normal(0, 0.02, SMALL.shape).astype(np.float32)
    image = lit_inside(SMALL, 256, 384) + dark
    without, noisy = (refocus(pixels, 120.0, **options).image for pixels in (image - dark, image))
    cut = refocus(np.maximum(image, 0), 120.0, **options).image
    beside = np.ones((20, 20), bool)
    beside[6:14, 6:14] = False
    assert abs(noisy[beside].mean()) < 0.1 * cut[beside].mean()
    np.testing.assert_allclose(noisy[8:12, 8:12], without[8:12, 8:12], rtol=0.1)


@most_methods
def test_far_planes(options):
    """A point there, captured by waves, comes back; pixels see two bins of so far a plane."""
    camera, far = small_camera(8, **HALF), 1e7
    X, Y = (u * camera.mla_pitch / camera.mla_distance * far for u in (-1.5, 2.5))
    spread = point_spread_function(camera, (X, Y, far), wavelength=WAVELENGTH)
    image = refocus(spread, math.inf, camera, **options).image
    row, column = np.unravel_index(np.argmax(image), image.shape)
    assert abs(column - 4 - 1) <= 1 and abs(row - 4 + 3) <= 1


def test_strips_of_the_detector_add_up_to_the_whole(monkeypatch):
    image = lit_inside(SMALL, 200, 440)
    whole = reconstruct_subsets(image, SMALL, [112.5], WAVELENGTH)[0]
    assert len(plan(SMALL, WAVELENGTH, [112.5], lit_window(image, SMALL)).strips) == 1
    monkeypatch.setattr(wave_methods, "plan", lambda *given: planning._plan(*given, 3))
    monkeypatch.setattr(wave_methods, "require_feasible", lambda made: None)
    parts = reconstruct_subsets(image, SMALL, [112.5], WAVELENGTH)[0]
    assert np.linalg.norm(parts - whole) < 2e-3 * np.linalg.norm(whole)


def test_bins_are_sampled_finely_enough(monkeypatch, sums):
    """Ten bins per lens show interference that single samples of them would smooth."""
    camera = small_camera(8, **HALF)
    options = {"method": "coherent", "oversample": 10}
    made = refocus(white_image(camera), 127.5, camera, **options).image
    for samples in ("_DIRECTION_SAMPLES", "_FINE_DIRECTION_SAMPLES"):
        monkeypatch.setattr(planning, samples, 15.0)
    exact = refocus(white_image(camera), 127.5, camera, **options).image
    assert np.linalg.norm(made - exact) < 2e-3 * np.linalg.norm(exact)


def test_pixels_too_coarse_for_the_wave_are_subdivided():
    coarse = SMALL.replace(resolution=(160, 160))
    image = lit_inside(coarse, 65, 95)
    fine = np.repeat(np.repeat(image, 4, 0), 4, 1)
    # The radiance differs as the white of coarse pixels does.
    a, b = (
        sum(reconstruct_subsets(pixels, camera, [125.0], WAVELENGTH)) * camera.pixel_size**2
        for pixels, camera in ((image, coarse), (fine, SMALL))
    )
    np.testing.assert_allclose(a, b, atol=1e-2 * b.max())


def test_the_command_writes_method_and_camera_into_the_header(tmp_path, run, complaint):
    camera = small_camera(2, **HALF)
    raw, out = tmp_path / "raw.exr", tmp_path / "out.exr"
    write_capture(raw, Capture(np.ones(camera.shape), camera, 633.0))
    arguments = ["reconstruct", raw, "-o", out, "--distance", "115", "--method", "partial"]
    run(*arguments, "--interleave", "auto", "--oversample", "2", "--no-relay")
    image, _, header = read_exr(out)
    assert (image.shape, header["method"], header["distance"]) == ((4, 4), "partial", 115.0)
    assert header["options"] == {"interleave": "auto", "oversample": 2, "relay": False, "wavelength": [633.0]}
    assert PlenopticCamera.from_dict(header["camera"]) == camera
    assert "interleave = 9" in complaint(*arguments, "--interleave", "9")


def test_few_lenses_far_apart_need_little_memory(monkeypatch):
    """One by one, with sums of 1026 x 1026 samples, and in full fields, of 2048 x 2048 pixels."""
    camera = small_camera(64)
    image = np.zeros(camera.shape, np.float32)
    image[100:124, 100:124] = image[-124:-100, -124:-100] = 1
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", "0.04")
    assert reconstruct_lens_by_lens(image, camera, [160.0], WAVELENGTH)[0].any()
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", "0.01")
    for propagate, what in ((reconstruct_lens_by_lens, "lens by lens"), (reconstruct_subsets, "wave reconstruction")):
        with pytest.raises(InputError, match=f"{what}: it would need"):
            propagate(image, camera, [160.0], WAVELENGTH)
