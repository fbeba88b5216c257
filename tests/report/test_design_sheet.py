"""The design sheet's numbers for the paper's camera and others."""

import math

import pytest

from mitsuba_plenoptic import PlenopticCamera, design
from mitsuba_plenoptic.report.sheet import design_sheet


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


def test_crop_bins_and_without_a_wavelength_nothing_of_diffraction():
    rows = {row.quantity: row for row in design_sheet(PlenopticCamera(crop_offset=(10, 20), crop_size=(64, 32)))}
    assert rows["recorded pixels"].value == "64 x 32"
    assert rows["recorded pixels"].note == "from column 10, row 20"
    assert not any(row.group.startswith("Diffraction") for row in rows.values())
    near, far = design.refocus_range(PlenopticCamera(), 633)
    notes = [row.note for row in design_sheet(PlenopticCamera(), 633) if row.quantity == "bin size"]
    assert notes == [f"at {near:.4g} mm", "at 240 mm", f"at {far:.4g} mm"]


def test_kind_resolution_and_depth_range_are_told():
    rows = values(
        PlenopticCamera(mla_distance=121.536, mla_focal_length=0.384, detector_distance=0.512, aperture_radius=4.9)
    )
    assert rows["Resolution", "kind of camera"] == ("focused, Keplerian", "")
    assert rows["Resolution", "sharpest distance"] == ("240", "mm")
    assert rows["Resolution", "effective resolution"] == ("1348 x 1348", "")
    assert rows["Resolution", "depth range"] == ("239.5 to 240.6", "mm")
    assert rows["Resolution", "virtual depth"] == ("3", "")
    assert values(PlenopticCamera())["Resolution", "kind of camera"] == ("unfocused", "")
    rows = values(PlenopticCamera.preset("raytrix"))
    assert rows["Resolution", "kind of camera"] == ("focused, Galilean", "")
    assert rows["Resolution", "depth range, together"] == ("359 to 373.1", "mm")


@pytest.mark.parametrize("mla_distance", [70, 80])
def test_no_plane_in_focus_or_at_infinity(mla_distance):
    camera = PlenopticCamera(mla_distance=mla_distance)
    text = values(camera, 633)["Main lens", "focused distance"][0]
    assert text == ("none" if mla_distance < 80 else "infinity")
    assert not math.isnan(design.refocus_range(camera, 633)[0])


def test_lateral_colour_is_told_of_glasses_that_have_it():
    camera = PlenopticCamera(main_lens="singlet", focal_length=80, aperture_radius=3, focus_distance=240)
    told = [float(row.value) for row in design_sheet(camera) if row.quantity == "lateral colour"]
    # In micrometres, at 0.7 of the field and in the corner.
    assert told[1] < -5 and told[0] == pytest.approx(0.7 * told[1], rel=0.05)
    surfaces = camera.prescription.to_plain()
    # A table that ends before line C, and an index that is the same for all.
    for glass in ({"table": [[480, 1.52], [600, 1.51]]}, 1.5):
        surfaces["surfaces"] = [each | ({"glass": glass} if "glass" in each else {}) for each in surfaces["surfaces"]]
        sheet = design_sheet(camera.replace(main_lens=surfaces))
        assert not [row for row in sheet if row.quantity == "lateral colour"]
