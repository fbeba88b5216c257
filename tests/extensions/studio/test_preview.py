"""The preview: where the scene is, and what is poor about that."""

import re

import cases
import mitsuba as mi
import numpy as np
import pytest
from refusals import refuses

from mitsuba_plenoptic import Objective, PlenopticCamera, with_camera
from mitsuba_plenoptic.extensions.studio import preview
from mitsuba_plenoptic.extensions.studio.preview import framing_warnings, preview_figure, preview_of

CAMERA = PlenopticCamera(resolution=(256, 256), detector_width=1.024, crop_size=(256, 256))
WIDTH = 16 * 0.064 * 240 / 120  # of the field in the plane in focus


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    monkeypatch.setattr(preview, "_SPP", 1)
    monkeypatch.setattr(preview, "_OBJECTIVE_SPP", 64)
    monkeypatch.setattr(preview, "_COLUMNS", 64)


def scene_of(size, distance, across=0.0, light=None):
    """A disc of a diameter before the camera."""
    transform = mi.ScalarTransform4f()
    pose = transform.look_at([0, 0, 0], [0, 0, 1], [0, 1, 0])
    disk = transform.translate([across, 0, distance]).scale(size / 2).rotate([1, 0, 0], 180)
    sensor, sky = {"type": "perspective", "to_world": pose}, light or {"type": "constant"}
    return with_camera(cases.scene_of(sensor, "direct", light=sky, disk={"type": "disk", "to_world": disk}), CAMERA)


def test_what_is_seen_is_where_it_is():
    seen = preview_of(scene_of(WIDTH / 2, 240.0), CAMERA)
    assert seen.filled == pytest.approx(0.5, abs=1 / 64 + 1e-6)
    assert np.nanmax(np.abs(seen.distance - 240)) < 1e-3
    assert np.isfinite(seen.distance).mean() == pytest.approx(np.pi / 16, rel=0.03)
    # +x is to the left, +y up.
    assert np.nanmean(seen.points[:, :32, 0]) > 0 and np.nanmean(seen.points[:32, :, 1]) > 0


@pytest.mark.parametrize(
    ("size", "distance", "across", "words"),
    [
        (0.128, 240.0, 0.0, "the scene spans 6.25% of the picture"),
        (5.0, 60.0, 0.0, "100% of what is seen is within the focal length of 80 mm"),
        (WIDTH, 500.0, 0.0, "what is seen is from 500 to 500 mm, and only 0% of it"),
        (1.0, 240.0, 50.0, "nothing of the scene is in the picture"),
    ],
    ids=["small", "near", "far", "beside"],
)
def test_poor_framing_is_named(size, distance, across, words):
    found = framing_warnings(preview_of(scene_of(size, distance, across), CAMERA))
    assert any(words in text for text in found), found
    assert framing_warnings(preview_of(scene_of(0.8 * WIDTH, 240.0), CAMERA)) == []


MICROSCOPE = PlenopticCamera(
    main_lens=Objective(20, 0.5), mla_pitch=0.15, mla_focal_length=3, detector_width=2.4, resolution=(240, 240)
)
FIELD = 16 * 0.15 / 20


def before_microscope(size, depth, across=0.0, camera=MICROSCOPE):
    disk = mi.ScalarTransform4f().translate([across, 0, depth]).scale(size / 2).rotate([1, 0, 0], 180)
    lamp = {"type": "disk", "to_world": disk, "emitter": {"type": "area", "radiance": 1.0}}
    return with_camera(cases.scene_of({"type": "perspective"}, lamp=lamp), camera)


def test_a_microscope_sees_through_its_objective():
    depth, across = 0.02, 0.25 * FIELD
    seen = preview_of(before_microscope(0.1 * FIELD, depth, across), MICROSCOPE)
    assert np.nanmax(np.abs(seen.distance - depth)) < 1e-6 and seen.filled == pytest.approx(0.1, abs=2 / 64)
    # As far from the axis at every depth, +x to the left.
    size = FIELD / seen.picture.shape[1]
    column, row = (np.average(np.arange(64) + 0.5, weights=seen.picture.sum(axis)) for axis in (0, 1))
    assert (32 - column) * size == pytest.approx(across, abs=size / 4) and row == pytest.approx(32, abs=0.3)
    # The sine condition fills the cone evenly in |sin|^2, and the disc evenly in r^2: the mean square on one axis is
    # d^2 <tan^2> / 2 + r^2 / 4.
    cone = -1 - np.log(1 - 0.5**2) / 0.5**2
    spread = np.average((np.arange(64) + 0.5 - column) ** 2, weights=seen.picture.sum(0)) * size**2
    assert spread == pytest.approx(depth**2 * cone / 2 + (0.05 * FIELD) ** 2 / 4, rel=0.03)
    # A blurred object loses no light.
    focused = preview_of(before_microscope(0.1 * FIELD, 0.0), MICROSCOPE)
    assert seen.picture.sum() == pytest.approx(focused.picture.sum(), rel=0.05)
    assert focused.picture.max() == 1


def test_the_field_stop_is_the_field_of_a_fourier_microscope():
    lens = Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50, field_stop=0.5)
    camera = MICROSCOPE.replace(main_lens=lens, mla_pitch=0.5, mla_focal_length=20)
    seen = preview_of(before_microscope(4 * FIELD, 0.0, camera=camera), camera)
    assert seen.picture.shape == (64, 64) and seen.view.field(0.0) == pytest.approx((0.05, 0.05))
    # Fully lit within the disc, dark in the corners beyond it.
    assert seen.picture[32, 32] == 1 and seen.picture[3, 3] == 0 and np.isnan(seen.distance[3, 3])
    assert seen.picture.mean() == pytest.approx(np.pi / 4, rel=0.01)
    assert any(
        "which is sharp under each microlens" in t
        for t in framing_warnings(preview_of(before_microscope(4 * FIELD, 0.1, camera=camera), camera))
    )


def test_framing_before_a_microscope(tmp_path):
    seen = preview_of(before_microscope(0.8 * FIELD, 0.5), MICROSCOPE)
    (text,) = framing_warnings(seen)
    assert re.search("what is seen is from 500 to 500 um, and only 0% of it from -97.* to 97.* um, which", text), text
    small = preview_of(before_microscope(0.1 * FIELD, 0.0), MICROSCOPE)
    assert any("of the picture" in text for text in framing_warnings(small))
    preview_figure("small", small).save(tmp_path / "look.png")
    assert (tmp_path / "look.png").stat().st_size > 0


def test_a_camera_without_a_plane_in_focus_is_refused():
    refuses("mla_distance = 79: ", preview_of, scene_of(1.0, 240.0), CAMERA.replace(mla_distance=79.0))


def test_the_plan_shows_the_left_of_a_camera_that_looks_to_the_right_above():
    picture, plan = preview_figure("left", preview_of(scene_of(WIDTH / 4, 240.0, WIDTH / 4), CAMERA)).axes[:2]
    (outline,) = plan.patches[1:]
    low, high = outline.get_xy().min(0), outline.get_xy().max(0)
    assert (low + high) / 2 == pytest.approx([240.0, WIDTH / 4], rel=0.05)
    assert high - low == pytest.approx([0, WIDTH / 4], abs=WIDTH / 20)
    assert plan.get_xlabel() == "mm from the main lens"
    assert "200" in [tick.get_text() for tick in plan.get_xticklabels()]
    assert np.diff(plan.get_xlim()) > 0 and np.diff(plan.get_ylim()) > 0
    # The picture beside has it at the left.
    columns = np.asarray(picture.images[1].get_array())[..., 3].sum(0)
    assert columns[:32].sum() > 0 == columns[32:].sum() and np.diff(picture.get_xlim()) > 0


def test_colours_are_seen_and_what_is_in_focus_is_tinted():
    mi.set_variant("llvm_ad_rgb")
    scene = scene_of(WIDTH / 2, 240.0, light={"type": "constant", "radiance": {"type": "rgb", "value": [1, 0.5, 0.25]}})
    seen = preview_of(scene, CAMERA)
    red, green, blue = seen.picture[32, 32]
    assert (green / red, blue / red) == pytest.approx((0.5, 0.25))
    tinted = preview_figure("disc", seen).axes[0].images[1].get_array()[..., 3] > 0
    assert (tinted == np.isfinite(seen.distance)).all()
