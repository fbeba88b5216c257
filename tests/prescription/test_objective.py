"""Microscopes as plain data: what an objective is, what follows from it, and what is refused."""

import json
import math

import mitsuba as mi
import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.report.sheet import design_sheet

AIR = mp.Objective(20, 0.5)
FOURIER = mp.Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)


def test_a_sensor_takes_an_objective_as_text_and_as_a_file(tmp_path):
    camera = mp.PlenopticCamera(main_lens=AIR, detector_width=0.128, resolution=(64, 64), mla_tilt=(1.0, 0.0))
    assert (camera.focal_length, camera.aperture_radius) == pytest.approx((10, 5))
    assert mp.PlenopticCamera.from_sensor(mi.load_dict(camera.to_sensor())) == camera
    file = tmp_path / "objective.json"
    file.write_text(json.dumps(AIR.to_plain()))
    assert mp.PlenopticCamera.from_sensor(mi.load_dict(camera.to_sensor() | {"main_lens": str(file)})) == camera


def test_presets_have_touching_micro_images():
    for name, half_angle in (("lfm", math.asin(0.5)), ("lfm_water", math.asin(0.5 / 1.33))):
        camera = mp.PlenopticCamera.preset(name)
        assert camera.objective.half_angle == pytest.approx(half_angle)
        # The lenses of the real one are f/19.5, not f/20.
        touching = 1 if name == "lfm" else 19.464 / 20
        assert camera.micro_image_diameter == pytest.approx(touching * camera.mla_pitch)
        assert camera.micro_image_pitch == camera.mla_pitch
        assert camera.blur_diameter(-0.02) == pytest.approx(2 * 20 * 0.02 * math.tan(half_angle))
        assert mp.design.white_mean(camera) == pytest.approx(math.pi / 4 * touching**2)
    # The file that describes the real one tells its tube lens.
    assert mp.PlenopticCamera.preset("lfm_water").objective.tube_focal_length == 180


def test_the_sheet_of_a_microscope():
    rows = {(row.group, row.quantity): row.value for row in design_sheet(mp.PlenopticCamera.preset("lfm"), 550)}
    assert rows["Objective", "object seen"] == "665.6"
    assert rows["Array", "lens pitch in the object"] == "7.5"
    assert rows["Diffraction at 550 nm", "objective's limit"] == "1818"
    fourier = mp.PlenopticCamera(main_lens=FOURIER, mla_pitch=0.5, mla_focal_length=20, detector_width=4)
    rows = {(row.group, row.quantity): row.value for row in design_sheet(fourier, 550)}
    assert rows["Array", "image of the stop"] == "2.5"
    assert rows["Array", "numerical aperture of a lens"] == "0.1"
    assert rows["Array", "field stop"] == "none"
    assert mp.design.design_warnings(fourier, 550) == mp.design.overlap_warnings(fourier)
    slow = mp.PlenopticCamera.preset("lfm").replace(mla_focal_length=1.0, detector_distance=1.0)
    assert any("micro-images fill 33% of their pitch" in text for text in mp.design.design_warnings(slow))


def test_limits_of_deconvolution_follow_the_depth():
    camera = mp.PlenopticCamera.preset("lfm")
    near, far = (mp.design.resolution_limit(camera, depth, 550) for depth in (0.03, -0.1))
    assert near.in_focus and not far.in_focus
    assert far.waves == pytest.approx(0.15 / (0.94 * 550e-6 * 20 * 0.1))
    assert far.pixels == pytest.approx(3 / (2 * 20 * 0.0065 * 0.1))
    assert far.lenses == pytest.approx(20 / 0.3)
    assert mp.design.resolution_limit(camera, 1e-6, 550).waves == pytest.approx(1 / 550e-6)


def test_parallax_is_told_in_the_image_of_the_stop_only():
    camera = mp.PlenopticCamera(main_lens=FOURIER, mla_pitch=0.5, mla_focal_length=20, detector_width=4)
    assert mp.design.lenses_across_stop(camera) == pytest.approx(5)
    assert mp.design.parallax(camera, 1.25) == pytest.approx(-20 * 20 / 50 * math.tan(math.radians(30)))
    refuses("1.25", mp.design.parallax, camera, 1.3)
    refuses("Fourier", mp.design.parallax, mp.PlenopticCamera.preset("lfm"), 0.1)
    refuses("no microscope", mp.design.native_field, mp.PlenopticCamera())
    refuses(r"mla_tilt = \(1.0, 0.0\)", camera.replace, mla_tilt=(1.0, 0.0))


def width_seen(camera, depth, pixels, points):
    """Width at a depth between two rays, each from a detector point through a point of the microlens on the axis."""
    seen = []
    for pixel, point in zip(pixels, points, strict=True):
        slope = (point - pixel) / camera.reduced_distance - point / camera.mla_focal_length
        start, behind, _ = main_lens(camera).trace((np.float64(point), 0.0), (np.float64(slope), 0.0))
        seen.append(start[0] + (depth - start[2]) * behind[0])
    return abs(seen[1] - seen[0])


@pytest.mark.parametrize("arrangement", ["image", "fourier"])
@pytest.mark.parametrize("detector_distance", [20.0, 21.5])
def test_at_the_ends_of_the_depth_of_field_a_lens_blurs_by_a_pixel(arrangement, detector_distance):
    further = {"fourier_focal_length": 50} if arrangement == "fourier" else {}
    lens = mp.Objective(20, 0.3, 1.33, arrangement=arrangement, **further)
    array = {"mla_pitch": 0.5, "mla_focal_length": 20, "detector_distance": detector_distance}
    camera = mp.PlenopticCamera(main_lens=lens, **array, detector_width=4, resolution=(800, 800))
    ends = mp.design.depth_of_field(camera)
    half, pixel = camera.mla_pitch / 2, camera.pixel_size
    for depth in ends:
        lens = width_seen(camera, depth, (0, 0), (-half, half))
        assert lens == pytest.approx(width_seen(camera, depth, (-pixel / 2, pixel / 2), (0, 0)), rel=0.05)
    # Lenses focused on a real image before them see nearer depths in the image of the stop, and farther ones elsewhere.
    side = np.sign(detector_distance - 20) * (1 if arrangement == "image" else -1)
    assert ends[0] < ends[1] and {-1: ends[1] < 0, 0: ends[0] == -ends[1], 1: ends[0] > 0}[side]


def test_depth_of_field_is_levoys():
    """Of matched micro-images, N^2 wavelengths n / 2 NA^2 from end to end, N being the spots in each."""
    array = {"mla_pitch": 0.15, "mla_focal_length": 30, "detector_width": 3, "resolution": (8000, 8000)}
    camera = mp.PlenopticCamera(main_lens=mp.Objective(20, 0.05, 1.33), **array)
    spots = 0.15 / mp.design.spot_radius(camera, 550)
    near, far = mp.design.depth_of_field(camera, 550)
    assert far - near == pytest.approx(spots**2 * 550e-6 * 1.33 / (2 * 0.05**2), rel=2e-3)
