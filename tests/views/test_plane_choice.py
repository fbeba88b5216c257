"""Depth maps: the choice among planes, doubt where patterns repeat, and micro-images of focused cameras."""

import dataclasses
import functools

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, scene_of
from light_field_cases import blobs, fall_off_of, of_square_lenses, straight_rays
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views import depth_map, distance_of, micro_images, white_image
from mitsuba_plenoptic.views.agreement import finer_stripes
from mitsuba_plenoptic.views.plane_choice import LENSES, VIEWS, Disagreement, choose, indications
from mitsuba_plenoptic.views.repetition import wrong_by_repetition

PLANES, SHAPE, TRUE = 41, (9, 11), 17.3
INVERSE = np.linspace(1 / 200, 1 / 300, PLANES)
SAMPLES = 6000.0


def found(deviation, contrast=0.3, inverse=INVERSE):
    """Views whose deviation on each plane, as a fraction of the one to be explained, is given; all bins alike."""
    ratio = np.tile(np.square(deviation)[:, None, None], (1, *SHAPE))
    samples = np.full(ratio.shape, SAMPLES)
    return Disagreement(ratio, samples, np.full(SHAPE, contrast), inverse, samples)


@pytest.mark.parametrize(("samples", "times"), [(VIEWS, 3), (LENSES, 2)])
def test_a_valley_as_deep_elsewhere_makes_unsure(samples, times):
    def rivals(depth):
        aside, other = (np.abs(np.arange(PLANES) - plane) for plane in (TRUE, 31))
        return found(1 - 0.9 * np.exp(-((aside / 1.5) ** 2)) - depth * np.exp(-((other / 1.5) ** 2)))

    ambiguous, clear = (choose(rivals(depth), samples, 0.01).probability for depth in (0.88, 0.1))
    # Wrong at least so many times as often.
    assert np.all(1 - ambiguous > times * (1 - clear))


def test_neighbours_beyond_an_edge_are_a_minority():
    # Half of the field shows one plane, half another, twelve planes apart.
    best = np.where(np.arange(40) < 20, 14.0, 26.0)
    ratio = np.square(1 - 0.95 * np.exp(-(((np.arange(PLANES)[:, None, None] - best) / 1.5) ** 2)))
    ratio = np.tile(ratio, (1, 20, 1))
    samples = np.full(ratio.shape, SAMPLES)
    edge = Disagreement(ratio, samples, np.full(ratio.shape[1:], 0.3), INVERSE, samples)
    agreeing = indications(edge, VIEWS, 0.01)[2]
    assert agreeing.min() > 0.5
    # Of a Gaussian window of 3 bins about the last bin before the edge, half a bin more than half is before it.
    assert agreeing[10, 19] == pytest.approx(ndtr(0.5 / 3), abs=0.02)
    probability = choose(edge, VIEWS, 0.01).probability
    assert probability.min() >= 0.5
    # A bin beside an edge may have the edge for all of its evidence.
    assert probability[:, 19:21].max() < 0.9 < probability[:, :10].min()


@pytest.mark.parametrize(("true", "known"), [(3.0, False), (12.0, True), (188.0, True), (197.0, False)])
def test_what_is_within_the_tolerance_of_an_end_is_unknown(true, known):
    # Planes are 0.17 to 0.25 % apart.
    inverse = np.linspace(1 / 200, 1 / 300, 201)
    deviation = 1 - 0.95 * np.exp(-(((np.arange(201) - true) / 1.5) ** 2))
    probability = choose(found(deviation, inverse=inverse), VIEWS, 0.01).probability
    assert np.all(probability > 0.9 if known else probability == 0)


@pytest.mark.parametrize("rise", [0.1, 0.03])
def test_a_valley_before_planes_that_cannot_be_compared_is_closed_by_less(rise):
    # Down to plane 14, then up by a fraction of the depth to plane 17; beyond that, a gap or planes like the last.
    planes = np.arange(PLANES)
    logarithm = np.where(planes < 14, -3 + 0.3 * (14 - planes), np.minimum(-3 + rise * (planes - 14), -3 + 3 * rise))
    logarithm = np.minimum(np.where(planes > 24, 0, logarithm), 0)
    logarithm[17:25] = np.nan
    before_gap = choose(found(np.exp(logarithm)), VIEWS, 0.01).probability
    at_the_end = choose(found(np.exp(logarithm[:17]), inverse=INVERSE[:17]), VIEWS, 0.01).probability
    assert np.all(before_gap > 0.5 if rise == 0.1 else before_gap == 0)
    assert np.all(at_the_end == 0)


FOCUSED = {"mla_focal_length": 0.384, "mla_distance": 121.536, "aperture_radius": 4.9}
SLOPES = np.concatenate([-1 / np.linspace(2, 9, 30), 1 / np.linspace(2, 9, 30)])


@functools.cache
def blank(lattice="square"):
    camera = mp.PlenopticCamera(detector_width=1.024, resolution=(256, 256), mla_lattice=lattice).replace(**FOCUSED)
    return micro_images(np.ones(camera.shape), camera=camera)


def showing(pattern, lattice="square"):
    """Micro-images that show a function of v, u and a random number of each lens."""
    images = blank(lattice)
    v, u = np.indices(images.weight.shape[2:], dtype=float)
    phase = np.random.default_rng(0).random((*images.weight.shape[:2], 1, 1))
    values = (pattern(v, u, phase) * np.ones(images.weight.shape)).astype(np.float32)
    return dataclasses.replace(images, values=(values * (images.weight > 0))[..., None])


def stripes(period, noise=0.0, level=False):
    random = np.random.default_rng(1)

    def pattern(v, u, phase):
        values = 0.5 + 0.1 * np.sin(2 * np.pi * ((v if level else u) / period + phase))
        return values + noise * random.normal(size=values.shape)

    return pattern


@pytest.mark.parametrize(("lattice", "level"), [("square", True), ("hexagonal", False)])
def test_stripes_are_doubted_the_more_the_finer_they_are(lattice, level):
    wrong = [wrong_by_repetition(showing(stripes(period, level=level), lattice), SLOPES) for period in (3, 4, 6)]
    assert wrong[0].shape == blank(lattice).bins.shape
    # Of periods of 3, 4, and 5 or more pixels 12, 55 and 84 % of the depths were right.
    for found, least, most in zip(wrong, (0.74, 0.49, 0.12), (0.76, 0.51, 0.17), strict=True):
        assert least < found.min() <= found.max() < most


@pytest.mark.parametrize("width", [0.0, 1.0, 2.0])
def test_random_texture_and_edges_do_not_repeat(width):
    random = np.random.default_rng(2)

    def texture(v, u, phase):
        values = random.normal(size=(*phase.shape[:2], *v.shape))
        return 0.5 + 0.1 * (gaussian_filter(values, (0, 0, width, width)) if width else values)

    assert np.median(wrong_by_repetition(showing(texture), SLOPES)) < 0.05
    assert wrong_by_repetition(showing(lambda v, u, phase: u > 3 + 5 * phase), SLOPES).max() < 0.05
    assert wrong_by_repetition(showing(lambda v, u, phase: 0.5 + 0 * u), SLOPES).max() == 0


def test_what_interpolation_between_lenses_adds_to_fine_stripes_is_doubted_where_views_were_moved():
    # Upright stripes on a hexagonal array, as of 1.3 lenses: two frequencies of rows, and a change of contrast.
    t, s = np.indices((48, 48))
    image = 0.5 + (0.02 + 0.01 * np.sin(s / 5)) * np.cos(2 * np.pi * 0.23 * s) * np.cos(2 * np.pi * 0.42 * t)
    image += 0.006 * np.random.default_rng(0).normal(size=image.shape)
    moved = np.ones(image.shape, dtype=bool)
    assert np.median(finer_stripes(image, moved)) > 0.45
    # Where no view was moved, random texture may be as fine.
    fine = 0.5 + 0.05 * np.random.default_rng(0).normal(size=image.shape)
    assert np.median(finer_stripes(fine, ~moved)) < 0.3
    assert np.median(finer_stripes(gaussian_filter(fine, 1), moved)) < 0.1


MULTI_FOCUS = mp.PlenopticCamera.preset("raytrix").replace(detector_width=2.64, resolution=(480, 384))
# Of 16 pixels a lens, of which micro-images cover nine; lenses blur what is in front by up to half of their width.
BLURRED = mp.PlenopticCamera(detector_width=1.536, resolution=(384, 384), **FOCUSED)


def wall(distance, camera, pattern=None, spp=16, **options):
    random = gaussian_filter(np.random.default_rng(1).normal(size=(256, 256)), 1.0, mode="wrap")
    pattern = np.clip(0.5 + 0.25 * random / random.std(), 0.02, 0.98) if pattern is None else pattern
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(pattern[..., None].astype(np.float32))}
    card = facing(distance, 14.0, bsdf={"type": "diffuse", "reflectance": texture})
    scene = scene_of(camera.to_sensor(), "direct", sky={"type": "constant"}, card=card)
    return mp.render_capture(scene, spp=spp, **options)


def test_light_that_rises_evenly_is_not_sure():
    """Noise of these 64 samples a pixel moves its depth by 5 %."""
    capture = wall(360, MULTI_FOCUS, np.tile(np.linspace(0.2, 1, 256), (256, 1)), 64)
    found = depth_map(mp.decode(capture), 330, 400, micro_images=micro_images(capture))
    assert (found.confidence.values > 0.9).mean() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("distance", "turned"), [(366, {}), (352, {"mla_rotation": 7.0, "mla_offset": (0.03, -0.02)})])
def test_depth_of_a_hexagonal_array_of_three_focal_lengths(distance, turned):
    """Its lenses are sharp at 364, 368 and 370 mm: between these and in front of them."""
    capture = wall(distance, MULTI_FOCUS.replace(**turned))
    lf = mp.decode(capture)
    found = depth_map(lf, 335, 385, micro_images=micro_images(capture)).isel(s=slice(3, -3), t=slice(3, -3))
    error = np.abs(distance_of(lf, found.disparity.values) / distance - 1)
    assert np.median(error) < 0.005 and np.percentile(error, 90) < 0.01


@pytest.mark.slow
def test_lenses_out_of_focus_do_not_move_depths(distance=221):
    capture = wall(distance, BLURRED)
    lf = mp.decode(capture)
    found = depth_map(lf, micro_images=micro_images(capture)).isel(s=slice(5, -5), t=slice(5, -5))
    assert abs(np.median(distance_of(lf, found.disparity.values)) / distance - 1) < 0.004


@pytest.mark.parametrize(("model", "texels", "changes"), [
    ("wave", 32, {}), ("wave", 10, {}), ("wave", 10, {"mla_lattice": "hexagonal"}),
    ("ray", 32, {"detector_blur": 0.004}), ("ray", 32, {"distortion": (0.06, 0, 0, 0, 0)}),
    ("ray", 32, {"aperture_radius": 4.1}),
])  # fmt: skip
def test_neither_blur_nor_distortion_nor_overlap_moves_depths(model, texels, changes, recwarn):
    """A spot's middle is 0.9 pixels from its first zero."""
    camera = mp.PlenopticCamera(focal_length=42, **{
        "aperture_radius": 2.9, "focus_distance": 350, "mla_pitch": 0.05, "mla_focal_length": 0.35,
        "detector_width": 0.9, "resolution": (216, 216),
    } | changes)  # fmt: skip
    lf = mp.decode(wall(600, camera, np.random.default_rng(1).random((texels, texels)), model=model))
    error = depth_map(lf, 480, 800).depth.values / 600 - 1
    corners = np.hypot(*(np.indices(error.shape) - 8.5)) > 8
    assert abs(np.median(error[3:-3, 3:-3])) < 0.004 and (model == "wave" or abs(np.nanmedian(error[corners])) < 0.005)
    assert any("overlap" in str(each.message) for each in recwarn) == ("aperture_radius" in changes)


# Where lenses are sharp before the array, and where the card's image is, in detector distances; its texture in lenses;
# brightness of the corners.
@pytest.mark.filterwarnings("ignore:white")
@pytest.mark.parametrize(
    "case",
    [(3, 3, 1.5, 0.2), *(pytest.param((-3, *case, 1), marks=pytest.mark.slow) for case in ((-15.3, 0.8), (-6, 0.4)))],
)
def test_light_of_the_next_lens_and_a_falling_white_do_not_move_depths(case):
    focused, image, coarseness, corner = case
    camera = of_square_lenses(20, 14, focused)
    distance = 1 / (1 / 50 - 1 / (62.5 - image))
    dim = fall_off_of(camera, corner)
    light = blobs(distance, camera.mla_pitch * distance / 62.5, coarseness)
    seen = mp.Capture((straight_rays(camera, light) * dim).astype("f4"), camera)
    seen = mp.expose(seen, mp.Detector(), photons=1000, seed=1)
    lf = mp.decode(seen, white=white_image(camera) * dim)
    found = depth_map(lf)
    error = distance_of(lf, found.disparity.values) / distance - 1
    for region in (np.s_[3:-3, 3:-3], np.s_[2:6, 2:6]):
        assert abs(np.median(error[region])) < 0.003 and found.confidence.values[region].mean() > 0.9


RESPONSE = (0.0, 1.0, 5.0, 0.6, 12.0, 0.2)


# Where lenses are sharp before the array, and where the card's image is, in detector distances and in mm.
@pytest.mark.slow
@pytest.mark.parametrize("case", [
    (None, -5, {"mla_tilt": (1.0, -1.0), "pixel_response": RESPONSE}),
    (-3, -6, {"mla_tilt": (-1.0, 0.4), "pixel_response": RESPONSE}),
    (None, 3, {"mla_tilt": (0.0, 1.0), "mla_medium": 1.5, "detector_distance": 0.75, "mla_focal_length": 0.75}),
    (3, 3, {"mla_tilt": (1.0, 0.3), "mla_lattice": "hexagonal"}),
    (3, 3, {"mla_tilt": (1.0, 1.0), "crop_offset": (15, 10), "crop_size": (180, 180)}),
])  # fmt: skip
def test_tilted_arrays_and_responses_do_not_move_depths(case):
    focused, image, changes = case
    camera = of_square_lenses(*(20, 10, focused) if focused else (10, 20)).replace(**changes)
    distance = 1 / (1 / 50 - 1 / (62.5 - image))
    light = blobs(distance, camera.row_pitch * distance / 62.5, 0.6 if focused else 0.75)
    seen = mp.Capture(straight_rays(camera, light), camera)
    lf = mp.decode(seen)
    found = depth_map(lf, micro_images=micro_images(seen) if focused else None)
    error = distance_of(lf, found.disparity.values) / distance - 1
    for region in (np.s_[3:-3, 3:-3], np.s_[2:6, 3:-3], np.s_[-6:-2, 3:-3], np.s_[3:-3, 2:6], np.s_[3:-3, -6:-2]):
        assert abs(np.median(error[region])) < 0.003 and found.confidence.values[region].mean() > 0.9


@pytest.mark.slow
def test_what_moves_by_hundredths_of_a_lens_is_not_sure():
    """A hundredth of the distance moves views of this camera at the pupil's rim by 0.009 of a lens."""
    camera = of_square_lenses(10, 14).replace(
        detector_distance=0.16, mla_focal_length=0.16, mla_distance=6.0, focal_length=5.7, aperture_radius=0.75,
        mla_pitch=0.04 * 6 / 6.16, detector_width=0.56,
    )  # fmt: skip
    distance = 1.2 * camera.focus_distance
    light = blobs(distance, 0.6 * camera.row_pitch * distance / 6, 0.8)
    found = depth_map(mp.decode(straight_rays(camera, light).astype(np.float32), camera=camera))
    assert found.confidence.values[3:-3, 3:-3].mean() < 0.8


def test_micro_images_of_a_square_array_are_the_light_field():
    camera = mp.PlenopticCamera(detector_width=0.512, resolution=(256, 256)).replace(**FOCUSED)
    image = np.random.default_rng(3).random(camera.shape, dtype=np.float32)
    lf, images = mp.decode(image, camera=camera), micro_images(image, camera=camera)
    np.testing.assert_array_equal(images.values[..., 0].transpose(2, 3, 0, 1), lf.values)
    np.testing.assert_array_equal(images.weight.transpose(2, 3, 0, 1), lf.weight.values)
    assert images.grid == images.bins
