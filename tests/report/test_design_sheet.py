"""The design sheet's numbers against the paper's camera, and its warnings."""

from __future__ import annotations

import math

import pytest

from mitsuba_plenoptic import PlenopticCamera, design
from mitsuba_plenoptic.design import design_warnings
from mitsuba_plenoptic.report.design_sheet import design_sheet


def values(camera, wavelength=None):
    return {(row.group, row.quantity): (row.value, row.unit) for row in design_sheet(camera, wavelength)}


def test_the_papers_camera():
    sheet = values(PlenopticCamera(), 633)
    assert sheet["Main lens", "focused distance"] == ("240", "mm")
    assert sheet["Main lens", "field width"] == ("16.38", "mm")
    assert sheet["Microlenses", "lenses"] == ("128 x 128", "")
    assert sheet["Microlenses", "f-number z/width"] == ("8", "")
    assert sheet["Microlenses", "main lens's b/D1"] == ("12", "")
    assert sheet["Detector", "pixel size"] == ("2", "um")
    assert sheet["Detector", "pixels per lens"] == ("32", "")
    assert sheet["Micro-images", "diameter"] == ("21.33", "pixels")
    assert sheet["Micro-images", "pitch"] == ("32.14", "pixels")
    # 633 nm times the microlens's f-number 8
    assert sheet["Diffraction at 633 nm", "spot of a microlens"] == ("5.064", "um")
    # (32 um)^2 / (633 nm 512 um)
    assert sheet["Diffraction at 633 nm", "Fresnel number, microlens"] == ("3.16", "")


def test_the_papers_camera_is_no_poor_design():
    assert design_warnings(PlenopticCamera()) == []
    assert design_warnings(PlenopticCamera(), 633) == []


def test_without_a_wavelength_nothing_is_said_of_diffraction():
    assert not any(group.startswith("Diffraction") for group, _ in values(PlenopticCamera()))


def test_refocusing_rows_give_bins_and_blur_at_the_ends_of_the_range():
    camera = PlenopticCamera()
    near, far = design.refocus_range(camera, 633)
    notes = [row.note for row in design_sheet(camera, 633) if row.quantity == "bin size"]
    assert notes == [f"at {near:.4g} mm", "at 240 mm", f"at {far:.4g} mm"]


def test_crop_is_told():
    camera = PlenopticCamera(crop_offset=(10, 20), crop_size=(64, 32))
    rows = {row.quantity: row for row in design_sheet(camera)}
    assert rows["recorded pixels"].value == "64 x 32"
    assert rows["recorded pixels"].note == "from column 10, row 20"


@pytest.mark.parametrize(
    ("parameters", "wavelength", "words"),
    [
        ({"aperture_radius": 10}, None, "micro-images overlap"),
        ({"aperture_radius": 3}, None, "pixels are wasted"),
        ({"mla_distance": 70}, None, "no object plane is in focus"),
        ({"resolution": (128, 128)}, None, "no refocusing"),
        ({"resolution": (2048, 2048)}, 633, "undersamples the diffraction spot"),
        ({"mla_pitch": 0.016, "mla_focal_length": 0.128, "resolution": (16384, 16384)}, 633, "hardly focus"),
    ],
)
def test_warnings(parameters, wavelength, words):
    assert any(words in warning for warning in design_warnings(PlenopticCamera(**parameters), wavelength))


def test_remedy_for_overlap_makes_micro_images_touch():
    (warning,) = design_warnings(PlenopticCamera(aperture_radius=10))
    diameter = float(warning.split("a diameter of ")[1].split(" mm")[0])
    camera = PlenopticCamera(aperture_radius=diameter / 2)
    assert camera.micro_image_diameter == pytest.approx(camera.micro_image_pitch, rel=1e-3)


@pytest.mark.parametrize("mla_distance", [70, 80])
def test_no_plane_in_focus_or_at_infinity(mla_distance):
    camera = PlenopticCamera(mla_distance=mla_distance)
    text = values(camera, 633)["Main lens", "focused distance"][0]
    assert text == ("none" if mla_distance < 80 else "infinity")
    assert not math.isnan(design.refocus_range(camera, 633)[0])
