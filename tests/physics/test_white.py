"""A white scene is as bright by waves as by rays, for every kind of camera, and its light field reads 1."""

import dataclasses
import gc

import mitsuba as mi
import numpy as np
import pytest
from cameras import CAMERAS, sky, white

from mitsuba_plenoptic import Capture, decode, render_capture
from mitsuba_plenoptic.views import micro_images, white_pixels

WAVES = (
    "square", "medium", "stretched", "three focal lengths", "circles", "gaps", "focused", "sphere", "warped",
    "unequal lenses", "vignetted", "apodised", "blurred", "ordinary", "microscope", "real",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", WAVES)
def test_scenes(name):
    scene = white(CAMERAS[name])
    rays, waves = (
        render_capture(scene, model=model, spp=spp).image.mean() for model, spp in (("ray", 256), ("wave", 16))
    )
    assert waves == pytest.approx(rays, rel=0.015)


@pytest.mark.parametrize(
    ("name", "variant"),
    [("square", "llvm_ad_mono")]
    + [
        pytest.param(name, variant, marks=pytest.mark.slow)
        for name, variant in (("focused", "llvm_ad_rgb"), ("three focal lengths", "llvm_ad_mono"))
    ],
)
def test_views_of_a_white_scene_by_waves_read_one(name, variant):
    calls = []
    with mi.variant_context(variant):
        capture = render_capture(white(CAMERAS[name]), spp=16, model="wave")
        lf = decode(capture, progress=lambda *work: calls.append(work))
        assert calls and calls[-1][0] == calls[-1][1]
        # A file with an equal camera, read when the first capture is gone.
        twin = dataclasses.replace(capture, camera=type(capture.camera).from_dict(capture.camera.to_dict()))
        del capture
        gc.collect()
        calls.clear()
        images = micro_images(twin)
        decode(twin, progress=lambda *work: calls.append(work))
    assert not calls
    for values, weight in ((lf.values.mean((2, 3)), lf.weight.values.min((2, 3))), (images.values, images.weight)):
        assert values[weight > 0].mean() == pytest.approx(1, abs=0.002)
    # By a white image of rays, up to 1.26, and more.
    whole = lf.weight.values.min((2, 3)) > 0
    assert np.abs(lf.values.mean((2, 3))[whole] - 1).max() < 0.05


def test_views_by_rays_have_the_response_of_pixels():
    camera = CAMERAS["square"].replace(pixel_response=(0.0, 1.0, 20.0, 0.5))
    for lf in (decode(sky(camera, 64), camera=camera), decode(Capture(white_pixels(camera), camera))):
        assert lf.values[lf.weight.values > 0.9].mean() == pytest.approx(1, abs=0.01)
