"""Spots and modulation transfer functions of lenses by themselves, against Optiland and closed forms."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mitsuba_plenoptic import read_prescription
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.prescription import Prescription, conjugate_distance
from mitsuba_plenoptic.report.lens_quality import behind_lens, chief, field_figures

RECORDS = Path(__file__).parent.parent / "optiland_records"
QUALITY = json.loads((RECORDS / "quality.json").read_text())

HYPERBOLOID = {
    "surfaces": [
        {"thickness": 4, "semi_aperture": 6, "glass": 1.5, "stop": True},
        {"radius": -25, "semi_aperture": 6, "conic": -(1.5**2)},
    ]
}
"""A lens that makes one point of parallel light on its axis."""


@pytest.mark.parametrize("name", [name for name in QUALITY if name != "optiland"])
def test_lenses_are_those_of_optiland(name):
    """Which lets all rays through the stop pass; its FFT takes even steps in the pupil for those of the image."""
    lens = read_prescription(RECORDS / name)
    wide = [replace(surface, semi_aperture=1.6 * surface.semi_aperture) for surface in lens.surfaces]
    wide[lens.stop] = lens.surfaces[lens.stop]
    lens, theirs = replace(lens, surfaces=tuple(wide)), QUALITY[name]
    assert lens.paraxial.focal_length == pytest.approx(theirs["focal_length"], rel=1e-6)
    shown, distance, heights = behind_lens(lens, theirs["pupil_diameter"])
    assert list(heights) == pytest.approx(theirs["fields"])
    fields = field_figures(shown, heights.values(), distance, frequencies=(10, 30, 50))
    for wavelength, spots in zip(lens.wavelengths, theirs["spots"], strict=True):
        radii = [1e3 * np.hypot(*field.rays[wavelength][:2].std(1)) for field in fields]
        assert radii == pytest.approx(spots, rel=0.01)
    mine = np.array([field.transfer for field in fields])
    assert mine == pytest.approx(np.array(theirs["mtf"]), abs=3e-3)
    assert mine[0] == pytest.approx(np.array(theirs["fft_mtf"][0]), abs=0.01)


@pytest.mark.parametrize("f_number", [5, 16])
def test_a_perfect_lens_is_limited_by_diffraction(f_number):
    lens = Prescription.from_plain(HYPERBOLOID)
    shown, distance, _ = behind_lens(lens, lens.paraxial.focal_length / f_number)
    (axis,) = field_figures(shown, [0.0], distance, frequencies=(10, 30, 50))
    slope = np.hypot(*axis.rays[lens.wavelength][2:]).max()
    # Marginal rays determine the aperture in the image.
    part = np.array([10, 30, 50]) * lens.wavelength * 1e-6 / (2 * math.sin(math.atan(slope)))
    expected = 2 / math.pi * (np.arccos(part) - part * np.sqrt(1 - part**2))
    assert axis.transfer == pytest.approx(np.array([expected] * 2), abs=5e-3)


ZEMAX = (RECORDS / "cooke_triplet.zmx").read_text().replace("DISZ INFINITY", "DISZ 300")
LENS = read_prescription(RECORDS / "cooke_triplet.zmx").paraxial
AWAY = 300 + LENS.entrance_pupil
IMAGED = (300 + LENS.front_principal) / LENS.focal_length - 1
"""The triplet for an object 300 mm before its first vertex, and the object's size over that of its paraxial image."""


@pytest.mark.parametrize(
    ("kind", "angles"),
    [
        (0, [0, 14, 20]),
        (1, [math.degrees(math.atan(height / AWAY)) for height in (0, 14, 20)]),
        (2, [math.degrees(math.atan(height * IMAGED / AWAY)) for height in (0, 14, 20)]),
        (3, []),
    ],
)
def test_fields_of_near_objects_of_any_kind(kind, angles, tmp_path):
    (tmp_path / "lens.zmx").write_text(re.sub("FTYP 0", f"FTYP {kind}", ZEMAX))
    lens = read_prescription(tmp_path / "lens.zmx")
    assert lens.object_distance == 300 and lens.fields == pytest.approx(angles, rel=1e-9)
    shown, distance, heights = behind_lens(lens)
    for angle, height in heights.items():
        # Chief rays come from object points that the entrance pupil sees at the angle.
        seen = -chief(shown, height, distance)[0] * distance
        assert seen == pytest.approx(AWAY * math.tan(math.radians(angle)), abs=1e-6)


@pytest.mark.parametrize("distance", ["inf", "500"])
def test_codev_without_apertures_has_those_of_its_pupil(distance, tmp_path):
    """The f-number is that of the paraxial marginal ray in the image."""
    text = (RECORDS / "double_gauss.seq").read_text()
    (tmp_path / "lens.seq").write_text(re.sub(r"\n  CIR.*", "", text).replace("SO 0 inf", f"SO 0 {distance}"))
    lens = read_prescription(tmp_path / "lens.seq")
    numbers, g = lens.paraxial, lens.object_distance + lens.paraxial.front_principal
    image = conjugate_distance(numbers.focal_length, g) + numbers.rear_principal
    assert (image - numbers.exit_pupil) / (2 * numbers.exit_radius) == pytest.approx(5, rel=1e-9)
    for mine, theirs in zip(lens.surfaces, read_prescription(RECORDS / "double_gauss.seq").surfaces, strict=True):
        assert mine.semi_aperture > theirs.semi_aperture or mine is lens.surfaces[lens.stop]


def test_info_of_a_lens_of_ones_own(tmp_path, capsys):
    """The lens of the page, with nothing that is not of the lens."""
    page = (Path(__file__).parent.parent.parent / "docs/guides/main_lenses.md").read_text()
    (tmp_path / "own.yaml").write_text(re.search("```yaml\n(name: Achromat.*?)```", page, re.S)[1])
    options = ["--field", "3", "--f-number", "8", "--drawing", str(tmp_path / "own.png")]
    assert main(["info", str(tmp_path / "own.yaml"), *options]) == 0 and (tmp_path / "own.png").stat().st_size > 10_000
    told = capsys.readouterr().out
    assert "f/8" in told and "Field of 2.1 deg" in told and not re.search("[Dd]etector|pixel|ideal", told)
    assert main(["info", "paper", "--field", "3"]) == 2
    assert "--field: paper, which is no lens, does not take it" in capsys.readouterr().err
