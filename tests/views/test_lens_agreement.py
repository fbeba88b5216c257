"""Depth of focused cameras from micro-images, on textured walls that Mitsuba renders at known distances."""

import functools

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, scene_of
from light_field_cases import blobs, fall_off_of, of_square_lenses, straight_rays
from scipy.ndimage import gaussian_filter

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views import depth_map, distance_of, micro_images, white_image

MULTI_FOCUS = mp.PlenopticCamera.preset("raytrix").replace(detector_width=2.64, resolution=(480, 384))
# Of 16 pixels a lens, of which micro-images cover nine; lenses blur what is in front by up to half of their width.
BLURRED = {
    "three focal lengths": ({"mla_lattice": "hexagonal", "mla_focal_length": (0.768, 0.72, 0.82),
                             "mla_distance": 118.464, "aperture_radius": 4.3}, 264),
    "one focal length": ({"mla_focal_length": 0.384, "mla_distance": 121.536, "aperture_radius": 4.9}, 221),
}  # fmt: skip


@functools.cache
def wall(distance, blurred=None, **changes):
    """Render a wall with a random pattern, some pixels fine, before a camera of three focal lengths or of `BLURRED`."""
    camera = MULTI_FOCUS.replace(**changes)
    if blurred:
        camera = mp.PlenopticCamera(detector_width=1.536, resolution=(384, 384)).replace(**BLURRED[blurred][0])
    pattern = gaussian_filter(np.random.default_rng(1).normal(size=(256, 256)), 1.0, mode="wrap")
    pattern = np.clip(0.5 + 0.25 * pattern / pattern.std(), 0.02, 0.98).astype(np.float32)
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(pattern[..., None])}
    card = facing(distance, 14.0, bsdf={"type": "diffuse", "reflectance": texture})
    capture = mp.render_capture(scene_of(camera.to_sensor(), "direct", sky={"type": "constant"}, card=card), spp=64)
    capture.metadata["distance"] = distance
    return capture


def errors(capture):
    """Relative errors of the best guesses, away from the border."""
    lf = mp.decode(capture)
    found = depth_map(lf, 335, 385, micro_images=micro_images(capture))
    inner = found.isel(s=slice(3, -3), t=slice(3, -3))
    return np.abs(distance_of(lf, inner.disparity.values) / capture.metadata["distance"] - 1)


@pytest.mark.parametrize(
    ("distance", "turned"),
    [(366, {}), pytest.param(352, {"mla_rotation": 7.0, "mla_offset": (0.03, -0.02)}, marks=pytest.mark.slow)],
)
def test_depth_of_a_hexagonal_array_of_three_focal_lengths(distance, turned):
    """Its lenses are sharp at 364, 368 and 370 mm: between these and in front of them."""
    error = errors(wall(distance, **turned))
    assert np.median(error) < 0.005
    assert np.percentile(error, 90) < 0.01


@pytest.mark.parametrize("camera", [pytest.param("three focal lengths", marks=pytest.mark.slow), "one focal length"])
def test_lenses_out_of_focus_do_not_move_depths(camera):
    distance = BLURRED[camera][1]
    capture = wall(distance, camera)
    lf = mp.decode(capture)
    found = depth_map(lf, micro_images=micro_images(capture)).isel(s=slice(5, -5), t=slice(5, -5))
    assert abs(np.median(distance_of(lf, found.disparity.values)) / distance - 1) < 0.004


# Where lenses are sharp before the array, and where the card's image is, in detector distances; its texture in lenses;
# photons; brightness of the corners.
@pytest.mark.filterwarnings("ignore:white")
@pytest.mark.parametrize("case", [(3, 3, 1.5, 1000, 0.2), (-3, -15.3, 0.8, 1000, 1),
                                  pytest.param((-3, -6, 0.4, 1000, 1), marks=pytest.mark.slow)])  # fmt: skip
def test_light_of_the_next_lens_and_a_falling_white_do_not_move_depths(case):
    focused, image, coarseness, photons, corner = case
    camera = of_square_lenses(20, 14, focused)
    distance = 1 / (1 / 50 - 1 / (62.5 - image))
    dim = fall_off_of(camera, corner)
    light = blobs(distance, camera.mla_pitch * distance / 62.5, coarseness)
    seen = mp.Capture((straight_rays(camera, light) * dim).astype("f4"), camera)
    if photons:
        seen = mp.expose(seen, mp.Detector(), photons=photons, seed=1)
    lf = mp.decode(seen, white=white_image(camera) * dim)
    found = depth_map(lf)
    error = distance_of(lf, found.disparity.values) / distance - 1
    for region in (np.s_[3:-3, 3:-3], np.s_[2:6, 2:6]):
        assert abs(np.median(error[region])) < 0.003
        assert found.confidence.values[region].mean() > 0.9


def test_micro_images_of_a_square_array_are_the_light_field():
    camera = mp.PlenopticCamera.preset("paper").replace(
        detector_width=0.512, resolution=(256, 256), mla_focal_length=0.384, mla_distance=121.536, aperture_radius=4.9
    )
    image = np.random.default_rng(3).random(camera.shape, dtype=np.float32)
    lf, images = mp.decode(image, camera=camera), micro_images(image, camera=camera)
    np.testing.assert_array_equal(images.values[..., 0].transpose(2, 3, 0, 1), lf.values)
    np.testing.assert_array_equal(images.weight.transpose(2, 3, 0, 1), lf.weight.values)
    assert images.grid == images.bins
