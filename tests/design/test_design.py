"""Focused and unfocused cameras: what they see sharply, how finely, and that rays and waves show it."""

import itertools
import math
import re

import mitsuba as mi
import numpy as np
import pytest
from cases import agreement

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera import micrometres
from mitsuba_plenoptic.design.quantities import crosstalk_lenses
from mitsuba_plenoptic.presets import PRESETS
from mitsuba_plenoptic.report.photographs import thin_lens_image

# The paper's camera, whose lenses see the main lens's image 3 z before them, or behind them.
KEPLERIAN = {"mla_distance": 121.536, "mla_focal_length": 0.384, "detector_distance": 0.512, "aperture_radius": 4.9}
GALILEAN = KEPLERIAN | {"mla_distance": 118.464, "mla_focal_length": 0.768}
FOCUSED = pytest.mark.parametrize("numbers", [KEPLERIAN, GALILEAN], ids=["keplerian", "galilean"])


@pytest.mark.parametrize(
    ("z", "focus"),
    # The spot of parallel light is a pixel wide, 2 um, for z 0.016 mm from the focus.
    [(0.512, "unfocused"), (0.5279, "unfocused"), (0.5281, "keplerian"), (0.4961, "unfocused"), (0.4959, "galilean")],
)
def test_the_focus_type_follows_from_the_spot_of_parallel_light(z, focus):
    assert mp.design.focus_type(mp.PlenopticCamera(detector_distance=z)) == focus


def test_numbers_of_the_focused_cameras():
    for numbers, name, side in ((KEPLERIAN, "keplerian", 1), (GALILEAN, "galilean", -1)):
        camera = mp.PlenopticCamera(**numbers)
        assert mp.design.focus_type(camera) == name and crosstalk_lenses(camera) == 1
        assert mp.design.mla_object_distances(camera) == pytest.approx((side * 1.536,))
        assert mp.design.best_distances(camera) == pytest.approx((240,))
        assert mp.design.virtual_depth(camera, 240) == pytest.approx(side * 3)
    assert mp.PlenopticCamera(**KEPLERIAN).focus_distance == pytest.approx(234.083, abs=1e-3)
    assert mp.design.best_distances(mp.PlenopticCamera()) == pytest.approx((240,))
    assert mp.design.mla_object_distances(mp.PlenopticCamera()) == (math.inf,)


def test_a_multi_focus_camera_may_be_of_several_kinds():
    camera = mp.PlenopticCamera(mla_lattice="hexagonal", mla_focal_length=(0.512, 0.4, 0.7), detector_distance=0.512)
    assert mp.design.focus_types(camera) == ("unfocused", "keplerian", "galilean")
    assert mp.design.focus_type(camera) == "mixed"
    assert mp.design.best_distances(camera)[0] == pytest.approx(240)
    assert all(len(limits) == 2 for limits in mp.design.depth_ranges(camera))


@FOCUSED
def test_rays_of_a_pixel_meet_in_the_best_plane_and_nowhere_else(camera_dict, numbers):
    sensor = mi.load_dict(camera_dict(**numbers))
    camera = sensor.camera
    rng = np.random.default_rng(0)
    count = 4096
    # Pixel near a micro-image's centre, so that its rays are not cut by the pupil.
    place = np.full(count, (256 + 17.3) / 512, np.float32)
    lens = mi.Point2f(*rng.random((2, count), dtype=np.float32))
    ray, weight = sensor.sample_ray(0, 0.5, mi.Point2f(mi.Float(place), mi.Float(place)), lens)
    assert np.array(weight).min() > 0

    def spread(distance):
        return np.ptp(np.array(ray(distance / ray.d.z))[:2], axis=1)

    np.testing.assert_allclose(spread(240.0), 0, atol=1e-3)
    for distance in (236.0, 245.0):
        expected = mp.design.lens_footprint(camera, distance, camera.mla_focal_lengths[0]) * camera.bin_size(distance)
        np.testing.assert_allclose(spread(distance), expected, rtol=0.01)


@FOCUSED
def test_a_focused_camera_gives_the_detectors_resolution_over_the_virtual_depth(numbers):
    camera = mp.PlenopticCamera(**numbers)
    found = mp.design.effective_resolution(camera, 240)
    # Perwass and Wietzke; the image is not as wide as the MLA by its distance from there.
    assert found.ratio == pytest.approx(1 / 3 * 120 / camera.mla_distance)
    assert found.columns == pytest.approx(4096 * found.ratio)
    assert found.line_width == pytest.approx(2 * 3 * 0.002)
    assert mp.design.suitable_oversample(camera, 240) == 10
    # 633 nm make a spot of 5.06 um, more than a pixel.
    assert mp.design.effective_resolution(camera, 240, 633).ratio == pytest.approx(found.ratio * 2 / 5.064)


@FOCUSED
def test_at_the_ends_of_the_depth_range_a_point_is_a_pixel_wide(numbers):
    camera = mp.PlenopticCamera(**numbers)
    ((near, far),) = mp.design.depth_ranges(camera)
    assert near < 240 < far
    for distance in (near, far):
        a = camera.mla_distance - 1 / (1 / camera.focal_length - 1 / distance)
        behind = 1 / (1 / camera.mla_focal_lengths[0] - 1 / a)  # where the microlens images the point
        assert camera.row_pitch * abs(1 - camera.detector_distance / behind) == pytest.approx(camera.pixel_size)
    # With diffraction less is asked for.
    ((nearer, farther),) = mp.design.depth_ranges(camera, 633)
    assert nearer < near < far < farther


@FOCUSED
def test_the_depth_range_ends_where_a_point_is_seen_once(numbers):
    camera = mp.PlenopticCamera(**numbers)
    assert mp.design.lenses_across(camera, 240) == pytest.approx(1.96)
    (wide,), (narrow,) = (mp.design.depth_ranges(c) for c in (camera, camera.replace(aperture_radius=2.4)))
    # Nearer to the MLA the main lens's image of a point spreads over fewer lenses: at its far end, or its near one.
    side = 0 if mp.design.focus_type(camera) == "keplerian" else 1
    assert narrow[1 - side] == wide[1 - side]
    assert narrow[side] != wide[side]
    assert mp.design.lenses_across(camera.replace(aperture_radius=2.4), narrow[side]) == pytest.approx(1)
    assert mp.design.depth_ranges(camera.replace(aperture_radius=1.0)) == [None]


@FOCUSED
def test_the_refocusable_range_ends_at_one_sample_per_lens(numbers):
    camera = mp.PlenopticCamera(**numbers)
    near, far = mp.design.refocus_range(camera)
    assert near < 240 < far
    for distance in np.linspace(near, far, 9)[1:-1]:
        assert mp.design.effective_resolution(camera, distance).samples_per_lens > 1
    for distance in (near, far):
        assert mp.design.effective_resolution(camera, distance).samples_per_lens == pytest.approx(1, rel=0.03)
    assert mp.design.refocus_range(mp.PlenopticCamera()) == pytest.approx((188.521, 330.154), abs=1e-3)


def test_focused_at_infinity_there_is_a_far_end_at_infinity():
    # Keplerian: the image of what is far lies in the focal plane, 1.536 mm before the MLA.
    camera = mp.PlenopticCamera(**KEPLERIAN | {"mla_distance": 81.536})
    assert mp.design.best_distances(camera) == (pytest.approx(math.inf),) or mp.design.best_distances(camera)[0] > 1e12
    ((near, far),) = mp.design.depth_ranges(camera)
    assert far == math.inf
    assert near > 10_000


def test_refocused_to_the_best_distance_it_is_the_thin_lenses_image(oversample=8):
    scene = mp.load_scene("keplerian", parameters={"detector_width": 0.768, "resolution": 384})
    capture = mp.render_capture(scene, spp=64)
    reference = thin_lens_image(scene, capture.camera, 240, 512, oversample)
    image = mp.reconstruct(capture, 240, oversample=oversample).image.astype(float)
    # The narrow detector's border sees the pupil in part only.
    inner = slice(2 * oversample, -2 * oversample)
    scale, ((psnr, correlation),) = agreement([image[inner, inner]], [reference[inner, inner]])
    assert scale == pytest.approx(1, abs=0.01)
    assert psnr >= 27.0 and correlation >= 0.995


# -- presets and scenes, and what is told of them ---------------------------------------------------


def test_presets():
    assert mp.PlenopticCamera.preset("paper") == mp.PlenopticCamera()
    lytro, raytrix = mp.PlenopticCamera.preset("lytro"), mp.PlenopticCamera.preset("raytrix")
    assert mp.design.focus_type(lytro) == "unfocused"
    assert lytro.f_number == pytest.approx(1.92)
    assert lytro.pixels_per_lens == pytest.approx(10)
    assert lytro.focus_distance == pytest.approx(230, abs=0.1)
    assert mp.design.focus_type(raytrix) == "galilean"
    assert raytrix.f_number == pytest.approx(4, abs=1e-3)
    assert raytrix.pixel_size == pytest.approx(0.0055)
    # The three focal lengths make one depth range.
    ranges = sorted(mp.design.depth_ranges(raytrix))
    assert all(first[1] > second[0] for first, second in itertools.pairwise(ranges))
    for name, camera in (("galilean", mp.PlenopticCamera(**GALILEAN)), ("lytro", lytro), ("raytrix", raytrix)):
        assert mp.PlenopticCamera.from_sensor(mp.load_scene(name).sensors()[0]) == camera
    with pytest.raises(mp.InputError, match="preset = 'nikon'"):
        mp.PlenopticCamera.preset("nikon")


@pytest.mark.parametrize(("numbers", "wavelength", "words"), [
    (KEPLERIAN | {"resolution": (2048, 2048)}, 633, "undersamples the diffraction spot"),
    ({"detector_width": 819.2}, None, "a pixel is 0.2 mm wide: .*micrometres"),
    ({"mla_lattice": "none", "detector_width": 819.2}, None, "ten focal lengths: .* micrometres"),
    ({"mla_pitch": 64}, None, "pitch of the lenses is 64 mm: .* micrometres"),
    ({"detector_width": 400, "mla_distance": 81}, None, "field of view spans 148.* degrees: .* micrometres"),
    ({"detector_width": 400, "mla_distance": 500, "focal_length": 40}, None, "ten focal lengths: .* micrometres"),
])  # fmt: skip
def test_warnings(numbers, wavelength, words):
    found = mp.design.design_warnings(mp.PlenopticCamera(**numbers), wavelength)
    assert any(re.search(words, warning) for warning in found)


def test_micrometres_and_metres_are_named_where_cameras_are_used():
    """Nothing looks so in a camera that exists, nor before a microscope's lens or a collimator."""
    for name in ("lytro", "raytrix", "raytrix_double_gauss"):
        assert mp.design.design_warnings(mp.PlenopticCamera.preset(name)) == []
    for name in PRESETS:
        assert micrometres(mp.PlenopticCamera.preset(name)) == []
    assert micrometres(mp.PlenopticCamera.preset("lfm").replace(resolution=(4, 4))) == []
    sheet = {"f_number": 2.8, "focal_length": 50, "focus_distance": 320, "lenses": 72, "pixels_per_lens": 10}
    with pytest.warns(UserWarning, match=r"a pixel is 5.5 mm wide: .* micrometres"):
        assert mp.PlenopticCamera.matched(**sheet | {"pixels_per_lens": 2}, pixel_size=5.5).detector_width == 792
    camera = mp.PlenopticCamera(detector_width=8.192, resolution=(16, 16))
    with pytest.warns(UserWarning, match=r"a pixel is 0.512 mm wide: .* micrometres"):
        mp.with_camera(mp.load_scene("letters", parameters={"resolution": 16}), camera)
    small = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.128)
    capture = mp.Capture(np.ones(small.shape, np.float32), small)
    with pytest.raises(mp.InputError, match=r"distance = 0.24: .* metres"):
        mp.reconstruct(capture, 0.24)


def test_no_warnings_where_all_is_well():
    narrow = {"lens_model": "parabolic", "detector_width": 2.048, "resolution": (1024, 1024)}
    for numbers, wavelength in ((KEPLERIAN, None), (GALILEAN, None), ({}, None), ({}, 633), (narrow, 633)):
        assert mp.design.design_warnings(mp.PlenopticCamera(**numbers), wavelength) == []
    # The MLA stands within the focal length, as it must to see what is far.
    far = mp.PlenopticCamera(**GALILEAN | {"mla_distance": 79.0})
    assert not any("no object plane" in text for text in mp.design.design_warnings(far))


def test_the_aberration_of_a_parabolic_lens_over_the_field(width=8.0):
    """That of third order, less piston, tilt and defocus fitted on a grid over the pupil, then the mean defocus."""
    camera = mp.PlenopticCamera(detector_width=width, resolution=(256, 256))
    a, b, g, f = camera.aperture_radius, camera.mla_distance, camera.focus_distance, camera.focal_length
    x, y = np.meshgrid(*[np.linspace(-a, a, 401)] * 2)
    x, y = x[x * x + y * y <= a * a], y[x * x + y * y <= a * a]
    square, found = x * x + y * y, []
    for slope in np.linspace(0, math.sqrt(2) * width * (1 - 1 / 256) / 2 / b, 5):
        path = square**2 / 8 * (1 / g**3 + 1 / b**3) - square * x * slope / 2 * (1 / g**2 - 1 / b**2)
        path += (x * slope) ** 2 / 2 / f + square * slope**2 / 4 / f
        terms = np.stack([np.ones_like(x), x, y, square], axis=1)
        fitted = np.linalg.lstsq(terms, path, rcond=None)[0]
        found.append((path - terms @ fitted, fitted[3]))
    mean = np.mean([defocus for _, defocus in found])
    worst = max(np.ptp(path + (defocus - mean) * square) for path, defocus in found) / 633e-6
    assert mp.design.parabolic_aberration(camera, 633) == pytest.approx(worst, rel=0.03)
    assert mp.design.parabolic_aberration(mp.PlenopticCamera.preset("paper_double_gauss"), 550) == 0
