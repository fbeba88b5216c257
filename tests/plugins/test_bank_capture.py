"""Captures by the rays of a kernel bank, against those by exact point spreads."""

import mitsuba as mi
import numpy as np
import pytest
from stopped_runs import StoppedError, stopped_before
from wave_cases import CAMERAS, LATTICES, capture, error, small_camera

from mitsuba_plenoptic import InputError, estimate_capture, render_capture
from mitsuba_plenoptic.io.checkpoints import Checkpoint

NEAR = 222.0
"""Distance of a wall that the paper's camera blurs over 6.3 lenses."""

SOME = {
    "square": {},
    "focused": CAMERAS["focused"],
    "turned, cropped": CAMERAS["turned, cropped"] | {"crop_offset": (150, 180)},
    "three focal lengths": LATTICES["three focal lengths"],
}


def scene_of(camera, *, distance=NEAR, radius=10.0, texture=1.0, pixel_format="luminance"):
    """Return a scene with a square wall that shines."""
    place = mi.ScalarTransform4f().translate([0, 0, distance]) @ mi.ScalarTransform4f().scale([radius, radius, -1])
    wall = {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": texture}}
    sensor = camera.to_sensor()
    sensor["film"]["pixel_format"] = pixel_format
    return mi.load_dict({"type": "scene", "sensor": sensor, "integrator": {"type": "path"}, "wall": wall})


def board(tiles):
    """Return a checkerboard of so many tiles in both directions."""
    return {"type": "checkerboard", "to_uv": mi.ScalarTransform4f().scale([tiles / 2, tiles / 2, 1])}


def by_bank(scene, **options):
    return render_capture(scene, **{"model": "wave", "method": "bank", "accuracy": 0.03, "spp": 16} | options)


@pytest.mark.parametrize("name", ["square", pytest.param("turned, cropped", marks=pytest.mark.slow)])
def test_white_has_the_energy_of_rays(name):
    camera = small_camera(4, **SOME[name] | {"crop_offset": (0, 0), "crop_size": None})
    scene = scene_of(camera)
    by_rays = render_capture(scene, model="ray", spp=256)
    assert by_bank(scene, spp=4).image.mean() == pytest.approx(by_rays.image.mean(), rel=0.01)


def test_few_points_far_out_of_focus_are_the_banks():
    # Blurred over 40 lenses, patches hold many points but not few, whose diffracted light does not average out.
    scene = scene_of(small_camera(4), distance=490.0, radius=60.0)
    by_rays = render_capture(scene, model="ray", spp=64)
    by_waves = render_capture(scene, model="wave", radiators_per_lens=2, spp=4)
    assert by_waves.image.mean() == pytest.approx(by_rays.image.mean(), rel=0.01)


@pytest.mark.parametrize("pixels", [64], ids=lambda count: f"{512 // count} um pixels")
def test_coarse_pixels_are_cut_into_bins_that_hold_the_spots_of_lenses(pixels):
    camera = small_camera().replace(resolution=(pixels, pixels))
    scene = scene_of(camera)
    by_rays = render_capture(scene, model="ray", spp=64)
    assert by_bank(scene, spp=4).image.mean() == pytest.approx(by_rays.image.mean(), rel=0.01)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name != "square")) for name in SOME],
)
def test_a_wall_is_that_of_exact_spreads(name):
    camera = small_camera(10, **SOME[name])
    radius = 1.5 * camera.mla_pitches[0] * NEAR / camera.mla_distance
    scene = scene_of(camera, radius=radius)
    image = by_bank(scene, spp=16).image
    steps = (np.arange(24) + 0.5) / 12 - 1
    x, y = (part.ravel() * radius for part in np.meshgrid(steps, steps))
    points = np.column_stack([x, y, np.full(len(x), NEAR)])
    exact = capture(camera, points, np.ones(len(points)), accuracy=0.003)
    exact *= np.vdot(image, exact) / np.vdot(exact, exact)
    assert error(image, exact) < 0.025


@pytest.mark.slow
def test_colours_share_the_samples_of_the_finest():
    mi.set_variant("llvm_ad_rgb")
    scene = scene_of(small_camera(4).replace(resolution=(32, 32)), pixel_format="rgb")
    image = by_bank(scene).image
    exact = render_capture(scene, model="wave", method="patch", accuracy=0.01, spp=1).image
    assert image.shape == (32, 32, 3)
    for channel in range(3):
        assert error(image[..., channel], exact[..., channel]) < 0.03


def test_a_scene_in_focus_needs_no_bank():
    scene = scene_of(small_camera(2), distance=240.0, radius=0.3)
    exact = render_capture(scene, model="wave", method="patch", spp=2).image
    np.testing.assert_array_equal(by_bank(scene, spp=2, accuracy=0.01).image, exact)


@pytest.mark.slow
def test_the_noise_is_that_of_seeds():
    """A textured light is noise by the place of each ray alone."""
    scene = scene_of(small_camera(4), distance=300.0, texture=board(100))
    captures = [by_bank(scene, seed=seed, noise=True) for seed in range(6)]
    spread = np.sqrt(np.var([capture.image for capture in captures], axis=0, ddof=1).mean())
    assert spread > 0
    assert np.sqrt(np.mean([capture.noise**2 for capture in captures])) == pytest.approx(spread, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [False, True])
def test_a_capture_goes_on_where_it_was_stopped(tmp_path, monkeypatch, noise):
    monkeypatch.setattr("mitsuba_plenoptic.capture.lens_rays._BLOCK_BYTES", 2**15)
    scene, path = scene_of(small_camera(2), texture=board(60)), tmp_path / "raw.checkpoint"
    options = {"spp": 4, "accuracy": 0.1, "noise": noise}
    with stopped_before(lambda sums: len(sums) == 1), pytest.raises(StoppedError), Checkpoint(path) as checkpoint:
        by_bank(scene, checkpoint=checkpoint, **options)
    other = scene_of(small_camera(2), texture=board(61))
    with pytest.raises(InputError, match="scene_digest"), Checkpoint(path, "resume") as checkpoint:
        by_bank(other, checkpoint=checkpoint, **options)
    calls = []
    with Checkpoint(path, "resume") as checkpoint:
        resumed = by_bank(scene, checkpoint=checkpoint, progress=lambda *call: calls.append(call), **options)
    whole = by_bank(scene, **options)
    assert calls[0][0] > 0 and calls[-1][0] == calls[-1][1]
    np.testing.assert_array_equal(resumed.image, whole.image)
    if noise:
        np.testing.assert_array_equal(resumed.noise, whole.noise)


def test_the_estimate_knows_the_rays():
    scene = scene_of(small_camera())
    options = {"model": "wave", "accuracy": 0.03, "radiators_per_lens": 1}
    few, many = (estimate_capture(scene, method="bank", spp=spp, **options) for spp in (4, 64))
    assert many.seconds > few.seconds > 0
    assert many.memory > 0
