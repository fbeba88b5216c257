"""Lens files of other programs, and our own: read rightly, or refused by file, line and rule."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import refuses

from mitsuba_plenoptic import PlenopticCamera, read_prescription
from mitsuba_plenoptic.camera.camera_files import camera_and_record
from mitsuba_plenoptic.prescription import Glass, paraxial

ZEMAX = """VERS 140124 258 36214
MODE SEQ
NAME Singlet
UNIT MM X W X CM MR CPMM
ENPD 10
ENVD 2.0E+1 1 0
GFAC 0 0
GCAT SCHOTT
FTYP 0 0 1 2 0 0 0
WAVM 1 0.4861327 1
WAVM 2 0.5875618 1
PWAV 2
SURF 0
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ INFINITY
SURF 1
  COMM front
  STOP
  TYPE EVENASPH
  CURV 0.02 0 0 0 0 ""
  PARM 1 0
  PARM 2 1.5e-06
  PARM 3 -2e-09
  CONI -0.5
  DISZ 5
  GLAS ___BLANK 1 0 1.5168 64.17 0 0 0 0 0 0
  DIAM 10 1 0 0 1 ""
SURF 2
  TYPE STANDARD
  CURV -0.01
  DISZ 60
  MEMA 11 0 0 0 1 ""
  DIAM 9 1 0 0 1 ""
SURF 3
  TYPE STANDARD
  CURV 0.0
  DISZ 0
  DIAM 5
BLNK
TOL TOFF   0   0 0 0   0 0 0
MNUM 1 1
"""

CODEV = """RDM;LEN "VERSION: 10.7; LENS VERSION: 80"
TITLE 'Singlet; of two'
EPD 10.0
DIM M
WL 587.5618 486.1327
REF 1
YAN 0.0 &
    3.0
SO 0.0 0.1e14
S 50.0 5.0 516800.641700 ! Front
  STO; CIR 10.0
  ASP
  K -0.5
  A 1.5E-6 ; B -2e-9
  CCY 0
S -100.0 60.0
  CIR EDG 11
  CIR 9.0
  PIM
SI 0.0 0.0
GO
"""


def read(tmp_path, text, name="lens.zmx", encoding="utf-8"):
    (tmp_path / name).write_text(text, encoding=encoding)
    return read_prescription(tmp_path / name)


def numbers(lens):
    return [
        (s.curvature, s.thickness, s.semi_aperture, s.conic, *s.asphere, *(s.glass.numbers if s.glass else ()))
        for s in lens.surfaces
    ]


SINGLET = [(0.02, 5, 10, -0.5, 1.5e-6, -2e-9, 1.5168, 64.17), (-0.01, 0, 9, 0)]


@pytest.mark.parametrize("name, text", [("lens.zmx", ZEMAX), ("lens.SEQ", CODEV)])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-le"])
def test_both_formats_give_the_lens(tmp_path, name, text, encoding):
    lens = read(tmp_path, text, name, encoding)
    assert (lens.stop, lens.wavelength) == (0, pytest.approx(587.5618)) and lens.name.startswith("Singlet")
    for found, expected in zip(numbers(lens), SINGLET, strict=True):
        assert found == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    "kind, unit, size",
    [("ZMX", "IN", 25.4), ("ZMX", "CM", 10.0), ("ZMX", "METER", 1000.0), ("SEQ", "I", 25.4), ("SEQ", "C", 10.0)],
)
def test_units_of_length(tmp_path, kind, unit, size):
    """The lens is larger; coefficients, which are of powers of lengths, are smaller."""
    text = ZEMAX.replace("UNIT MM", f"UNIT {unit}") if kind == "ZMX" else CODEV.replace("DIM M", f"DIM {unit}")
    for found, stated in zip(numbers(read(tmp_path, text, f"lens.{kind}")), SINGLET, strict=True):
        scaled = [value * size**power for value, power in zip(stated, (-1, 1, 1, 0, -3, -5, 0, 0), strict=False)]
        assert found == pytest.approx(scaled, rel=1e-9)


def test_forms_of_glass_and_curvature(tmp_path):
    """Codes of index and Abbe number with all their digits, one index, and curvatures in the place of radii."""
    for code, index, abbe in [("620410.364", 1.62041, 36.4), ("517642", 1.517, 64.2), ("1.5168:64.17", 1.5168, 64.17)]:
        lens = read(tmp_path, CODEV.replace("516800.641700", code), "lens.seq")
        assert lens.surfaces[0].glass.numbers == pytest.approx((index, abbe), rel=1e-12)
    curved = CODEV.replace("RDM;", "RDM N;").replace("S 50.0", "S 0.02").replace("S -100.0", "S -0.01")
    assert numbers(read(tmp_path, curved, "lens.seq"))[0] == pytest.approx(SINGLET[0], rel=1e-12)
    assert read(tmp_path, CODEV.replace("STO; ", "").replace("GO", "STO S2"), "lens.seq").stop == 1
    assert read(tmp_path, ZEMAX.replace("64.17", "0")).surfaces[0].glass == Glass("index", (1.5168,), "model")
    assert read(tmp_path, ZEMAX.replace("DIAM 9 1", "CLAP 0 8 0\n  DIAM 9 1")).surfaces[1].semi_aperture == 8


OF_ZEMAX = [
    ("UNIT MM", "UNIT FT", "line 4: 'UNIT FT X W X CM MR CPMM'"), ("UNIT MM X W X CM MR CPMM\n", "", "UNIT is missing"),
    ("ENVD 2.0E+1 1 0", "ENVD 2.0E+1 0 1", "20 degrees"), ("PWAV 2", "PWAV 3", "wavelength 3"),
    ("0.5875618", "587.5618", "wavelengths = 587562"), ("TYPE EVENASPH", "TYPE COORDBRK", "'TYPE COORDBRK'"),
    ("PARM 1 0", "PARM 1 1e-4", "second power"), ("PARM 3 ", "PARM 9 ", "parameters 1 to 8"),
    ("DIAM 9 1", "CLAP 3 8 0\n  DIAM 9 1", "'CLAP 3 8 0'"),
    ("DIAM 9 1", "OBSC 0 3 0\n  DIAM 9 1", "OBSC is not understood"), ("DIAM 9 1", "DIAM 0 1", "line 29: 'SURF 2'"),
    ("GLAS ___BLANK 1", "GLAS MIRROR 0", "mirrors"), ("GLAS ___BLANK 1", "GLAS ___BLANK 4", "model glasses"),
    ("64.17 0 0", "64.17 0.01 0", "partial dispersion"), ("DISZ 5", "DISZ INFINITY", "line 26: 'DISZ INFINITY'"),
    ("MNUM 1 1", "MNUM 2 1", "'MNUM 2 1'"), ("CURV 0.0\n  DISZ 0", "CURV 0.1\n  DISZ 0", "surface 3"),
    ("DISZ 60", "DISZ 60\n  GLAS ___BLANK 1 0 1.5 50", "last surface"),
    ("DISZ INFINITY", "DISZ INFINITY\n  GLAS ___BLANK 1 0 1.5 50", "first surface"), ("SURF 2", "SURF 3", "numbered"),
    ("CONI -0.5", "CONI -0.5\n  CURV 0.03", "'CURV 0.03'"),
]  # fmt: skip
OF_CODEV = [
    ("RDM;", "", "RDM"), ("DIM M\n", "DIM M\nDIM I\n", "line 5: 'DIM I'"), ("DIM M\n", "", "DIM is missing"),
    ("REF 1", "", "primary wavelength"), ("WL 587.5618", "WL 0.5876", "wavelengths = 0.5876"),
    ("CCY 0", "ADE 45", "'ADE 45'"), ("CCY 0", "MFL 50", "'MFL 50'"), ("CCY 0", "CIR OBS 3", "obscurations"),
    ("K -0.5\n", "K -0.5 A 1E-6\n", "semicolons"), ("CCY 0", "PIM", "solve"), ("CCY 0", "TEM 60", "20 to 25 degrees"),
    ("516800.641700", "REFL", "line 10: 'S 50.0 5.0 REFL'"), ("SI 0.0", "SI -20.0", "curved"),
    ("SI 0.0 0.0\n", "", "SI"),
]  # fmt: skip


@pytest.mark.parametrize("old, new, message", OF_ZEMAX + OF_CODEV)
def test_what_a_file_may_not_hold(tmp_path, old, new, message):
    name, text = ("lens.zmx", ZEMAX) if (old, new, message) in OF_ZEMAX else ("lens.seq", CODEV)
    assert text.count(old) >= 1
    refuses(rf"{name}.*{re.escape(message)}", read, tmp_path, text.replace(old, new, 1), name)


# Of CODE V's codes Optiland drops all digits but three; and it takes the term A for that of the second power.
FOR_OPTILAND = CODEV.replace("516800.641700", "1.5168:64.17").replace("  A 1.5E-6 ; B -2e-9\n", "")


@pytest.mark.slow
@pytest.mark.parametrize("name, text", [("lens.zmx", ZEMAX), ("lens.seq", FOR_OPTILAND)])
def test_optiland_reads_the_same_lens(tmp_path, name, text):
    fileio = pytest.importorskip("optiland.fileio")
    lens = read(tmp_path, text, name)
    optic = {"zmx": fileio.load_zemax_file, "seq": fileio.load_codev_file}[name[-3:]](str(tmp_path / name))
    surfaces = [optic.surfaces[number].geometry for number in (1, 2)]
    assert [float(surface.radius) for surface in surfaces] == pytest.approx([50, -100], rel=1e-12)
    assert float(surfaces[0].k) == lens.surfaces[0].conic
    if lens.surfaces[0].asphere:
        assert tuple(np.ravel(surfaces[0].coefficients)[1:3].tolist()) == lens.surfaces[0].asphere
    assert paraxial(lens).focal_length == pytest.approx(float(optic.paraxial.f2()), rel=1e-6)


@pytest.mark.slow
def test_glasses_of_catalogues_by_just_their_names(tmp_path):
    pytest.importorskip("optiland")
    for name, index in {"N-BK7": 1.5168, "schott:SF5": 1.6727, "schott:F2": 1.62004, "CaF2:Malitson": 1.43385}.items():
        assert Glass.from_plain(name).at(587.5618) == pytest.approx(index, abs=2e-5)
    meant = {"F2": "schott:F2", "CaF2": "CaF2:", "schott:S-LAH53": "ohara:S-LAH53"}
    for name, message in meant.items():
        refuses(message, Glass.from_plain, name)
    # Beyond its data a glass has no index, rather than one of the formula.
    refuses("400 to 700 nm", Glass.from_plain("hikari:F2").at, 850)
    named = ZEMAX.replace("GLAS ___BLANK 1 0 1.5168 64.17", "GLAS {} 0 0 1.5 40")
    assert read(tmp_path, named.format("F2")).surfaces[0].glass.at(587.5618) == pytest.approx(1.62004, abs=1e-5)
    refuses(r"lens\.zmx, line 27: glass = 'UNOBTAINIUM'", read, tmp_path, named.format("UNOBTAINIUM"))
    hyphens = read(tmp_path, CODEV.replace("516800.641700", "NSSK2_SCHOTT"), "lens.seq")
    assert hyphens.surfaces[0].glass.at(587.5618) == pytest.approx(1.62229, abs=1e-5)


# Decimals of the index, and Abbe number, of the data sheets, by name.
SHEETS = """
N-BK7 51680 64.17 N-K5 52249 59.48 N-KF9 52346 51.54 N-FK5 48749 70.41 N-FK51A 48656 84.47 N-PK51 52855 76.98 N-PK52A
49700 81.61 N-PSK53A 61800 63.39 N-BAK1 57250 57.55 N-BAK2 53996 59.71 N-BAK4 56883 55.98 N-BALF4 57956 53.87 N-BAF4
60568 43.72 N-BAF10 67003 47.11 N-BASF64 70400 39.38 N-SK2 60738 56.65 N-SK4 61272 58.63 N-SK5 58913 61.27 N-SK11 56384
60.80 N-SK14 60311 60.60 N-SK16 62041 60.32 N-SSK2 62229 53.27 N-SSK5 65844 50.88 N-SSK8 61773 49.83 N-LAK7 65160 58.52
N-LAK9 69100 54.71 N-LAK10 72003 50.62 N-LAK14 69680 55.41 N-LAK21 64049 60.10 N-LAK22 65113 55.89 N-LAK33B 75500 52.30
N-LAF2 74397 44.85 N-LAF21 78800 47.49 N-LAF33 78582 44.05 N-LAF34 77250 49.62 N-LAF35 74330 49.40 N-LASF9 85025 32.17
N-LASF43 80610 40.61 N-LASF44 80420 46.50 N-KZFS4 61336 44.49 N-KZFS5 65412 39.70 N-F2 62005 36.43 F2 62004 36.37 F5
60342 38.03 LF5 58144 40.85 LLF1 54814 45.75 N-SF1 71736 29.62 N-SF4 75513 27.38 N-SF5 67271 32.25 N-SF6 80518 25.36
N-SF8 68894 31.31 N-SF10 72828 28.53 N-SF11 78472 25.68 N-SF14 76182 26.53 N-SF57 84666 23.78 N-ZK7 50847 61.19 N-BASF2
66446 36.00 SF1 71736 29.51 SF2 64769 33.85 SF4 75520 27.58 SF5 67270 32.21 SF6 80518 25.43 SF10 72825 28.41 SF11 78472
25.76 SF57 84666 23.83 SILICA 45846 67.82
"""


def test_usual_glasses_need_no_optiland(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "optiland.materials", None)
    for name, decimals, abbe in re.findall(r"(\S+) (\S+) (\S+)", SHEETS.replace("\n", " ")):
        glass = Glass.from_plain(name if name.startswith(("N-", "SILICA")) else f"schott:{name}")
        d, f, c = (glass.at(line) for line in (587.5618, 486.1327, 656.2725))
        assert d == pytest.approx(float(f"1.{decimals}"), abs=1e-5)
        assert (d - 1) / (f - c) == pytest.approx(float(abbe), abs=0.05)
    named = ZEMAX.replace("GLAS ___BLANK 1", "GLAS F2 0")
    assert read(tmp_path, named).surfaces[0].glass.at(587.5618) == pytest.approx(1.62004, abs=1e-5)
    old = named.replace("F2 0", "SK16 0").replace("1.5168 64.17", "1.6204 60.33")
    assert read(tmp_path, old).surfaces[0].glass.at(587.5618) == pytest.approx(1.6204, abs=1e-9)
    unstated, codev = old.replace("1.6204 60.33", "1.5 40"), CODEV.replace("516800.641700", "LAKN22_SCHOTT")
    for text, name, index in [(unstated, "lens.zmx", 1.62041), (codev, "lens.seq", 1.65113)]:
        with pytest.warns(UserWarning, match="its successor N-"):
            assert read(tmp_path, text, name).surfaces[0].glass.at(587.5618) == pytest.approx(index, abs=1e-5)
    refuses("230 nm: it has an index from 299.5 to 2500 nm", Glass.from_plain("N-SF11").at, 230.0)
    for maker, glass in [("HOYA SCHOTT", "F2"), ("SCHOTT", "S-LAH53"), ("OHARA", "N-BK7")]:
        text = named.replace("SCHOTT", maker).replace("GLAS F2", f"GLAS {glass}")
        refuses(f"line 27: glass = '{glass}'", read, tmp_path, text)


FRONT = {"radius": 50, "thickness": 5, "glass": 1.5, "semi_aperture": 10, "stop": True, "asphere": [1e-05, -2e-9]}
OWN = {"surfaces": [FRONT, {"radius": -70, "semi_aperture": 10}]}


@pytest.mark.parametrize("name", ["own.json", "own.yaml"])
def test_own_files_hold_numbers_as_json_writes_them(tmp_path, monkeypatch, name):
    """PyYAML takes 1e-05, which JSON writes, for text."""
    (tmp_path / name).write_text(json.dumps(OWN))
    assert read_prescription(tmp_path / name).surfaces[0].asphere == (1e-05, -2e-9)
    # A camera takes the file's name, too, wherever it takes a bundled lens's.
    monkeypatch.chdir(tmp_path)
    lens = read_prescription(name)
    assert PlenopticCamera(main_lens=name).main_lens == PlenopticCamera(main_lens=tmp_path / name).main_lens == lens
    for none in ("none.yaml", "x" * 5000, "a\0b"):
        refuses("there is no such file", PlenopticCamera, main_lens=none)
    # What else lies about does not hide a bundled lens.
    (tmp_path / "tessar").mkdir()
    assert PlenopticCamera(main_lens="tessar").main_lens.name == "Tessar"


def test_surfaces_may_touch_and_stops_may_stand_within_a_hollow(tmp_path):
    """A lens may end in an edge; a plane without glass is a place, which a lens's own surface may pass."""
    edge = {"radius": 50, "thickness": 2 * (50 - (50**2 - 10**2) ** 0.5), "glass": 1.5, "semi_aperture": 10}
    stop = {"semi_aperture": 8, "stop": True}
    camera = PlenopticCamera(main_lens={"surfaces": [stop, edge, {"radius": -50, "semi_aperture": 10}]})
    assert len(camera.main_lens.surfaces) == 3
    hollow = {"radius": -50, "thickness": 3, "glass": 1.5, "semi_aperture": 10}
    PlenopticCamera(main_lens={"surfaces": [stop, hollow, {"radius": -20, "semi_aperture": 10}]})


@pytest.mark.parametrize("kind", ["json", "yaml"])
def test_files_of_a_camera_are_found_beside_its_own(tmp_path, monkeypatch, kind):
    """As in scenes; what does not lie there is found from where one works, and text is not a file."""
    folder = tmp_path / "far"
    folder.mkdir()
    monkeypatch.chdir(tmp_path)
    lens = read(folder, ZEMAX)
    (folder / "own.json").write_text(json.dumps(OWN))
    np.save(folder / "waves.npy", np.eye(8))
    (folder / "screen.json").write_text(json.dumps({"waves": "waves.npy", "width": 20}))

    def camera(**values):
        (folder / f"camera.{kind}").write_text(json.dumps({"focus_distance": 500} | values))
        return camera_and_record(Path("far") / f"camera.{kind}")[0]

    assert camera(main_lens="lens.zmx").main_lens == camera(main_lens="far/lens.zmx").main_lens == lens
    assert camera(main_lens=json.dumps(OWN)).main_lens == camera(main_lens="own.json").main_lens
    assert camera(main_lens="tessar").main_lens == read_prescription("tessar")
    assert np.array_equal(camera(phase_screen="screen.json").phase_screen.waves, np.eye(8))
    refuses(rf"far/camera\.{kind}: main_lens = 'none\.zmx'", camera, main_lens="none.zmx")


def thin_rows(surfaces):
    """Paraxial focal length by matrices, of (curvature, thickness, index behind)."""
    height, slope, before = 1.0, 0.0, 1.0
    for curvature, thickness, behind in surfaces:
        slope, before = (before * slope - height * curvature * (behind - before)) / behind, behind
        height += thickness * slope
    return -1 / slope


def zemax_of(rows):
    """A file of (curvature, thickness, glass, further lines) between object and image."""
    head = "VERS 1\nMODE SEQ\nNAME t\nUNIT MM X W X CM MR CPMM\nWAVM 1 0.5875618 1\nPWAV 1\nSURF 0\n  DISZ INFINITY\n"
    parts = [
        f"SURF {number}\n  TYPE STANDARD\n  CURV {c}\n  DISZ {d}\n" + (f"  GLAS {glass}\n" if glass else "") + more
        for number, (c, d, glass, more) in enumerate([*rows, (0.0, 0.0, "", "  DIAM 10\n")], start=1)
    ]
    return head + "".join(parts)


def test_picked_up_model_glasses_dummy_planes_and_newer_keywords_of_zemax(tmp_path):
    model, picked, open_ = "___BLANK 1 0 1.62 36.3 0 0 0 0 0 0", "___BLANK 2 2 1.5 50 0 0 0 0 0 0", "  DIAM 12\n"
    rows = [
        (0.0, 10.0, "", "  DIAM 0\n"), (0.02, 5.0, model, open_ + "  STOP\n  VCON 1\n"), (-0.02, 5.0, "", open_),
        (0.0, 2.0, "", "  DIAM 0\n"), (0.0125, 5.0, picked, open_), (-0.0125, 60.0, "", open_), (0.0, 3.0, "", ""),
    ]  # fmt: skip
    lens = read(tmp_path, zemax_of(rows))
    assert [surface.thickness for surface in lens.surfaces] == [5, 7, 5, 0] and lens.stop == 0
    assert lens.image_distance == 63 and read(tmp_path, zemax_of(rows).replace("INFINITY", "20")).object_distance == 30
    expected = thin_rows([(0.02, 5, 1.62), (-0.02, 7, 1), (0.0125, 5, 1.62), (-0.0125, 0, 1)])
    assert paraxial(lens, 587.5618).focal_length == pytest.approx(expected, rel=1e-6)
    rows[4] = (0.0125, 5.0, picked.replace("2 2", "2 6"), open_)
    refuses("surface 6", read, tmp_path, zemax_of(rows))


def test_apertures_of_neighbours_and_unused_private_glasses_of_codev(tmp_path):
    cemented = "S -40.0 3.0 620000.364000\nS -100.0 0.0\n  CIR 11.0\nS 0.0 60.0\n"
    private = "PRV\n  PWL 550.0\n  'NOA61' LAU 2.36390625 0.0 0.025493134\nEND\n"
    text = CODEV.replace("SO ", private + "SO ", 1)
    start = text.index("S -100.0")
    text = text[:start] + cemented + text[text.index("SI 0.0") :]
    lens = read(tmp_path, text, "lens.seq")
    assert [surface.semi_aperture for surface in lens.surfaces] == [10.0, 11.0, 11.0]
    expected = thin_rows([(1 / 50, 5, 1.5168), (-1 / 40, 3, 1.62), (-1 / 100, 0, 1)])
    assert paraxial(lens, 587.5618).focal_length == pytest.approx(expected, rel=1e-4)
    refuses("a glass of PRV is not read", read, tmp_path, text.replace("620000.364000", "'NOA61'"), "lens.seq")


@pytest.mark.parametrize(("old", "new"), [("EPD 10", "EPD 10\nNA 0.08"), ("GO", "VUY 0 0.3\nGO"), ("YAN", "YRI")])
def test_what_limits_the_light_is_left_out_with_a_warning(tmp_path, old, new):
    with pytest.warns(UserWarning, match="left out"):
        lens = read(tmp_path, CODEV.replace(old, new).replace("SI 0.0 0.0", "SI 0.0 0.3"), "lens.seq")
    assert lens.image_distance == 60.3 and lens.surfaces == read(tmp_path, CODEV, "lens.seq").surfaces


@pytest.mark.parametrize(
    "given, expected",
    [
        ((12, 0, 0, 0, 11, 9, 10), (12, 12, 12, 12, 11, 9, 10)),
        ((10, 9, 11, 0, 12, 0, 8), (10, 9, 11, 12, 12, 12, 8)),
        ((0, 9, 0, 8, 0, 0, 0), (9, 9, 9, 8, 8, 8, 8)),
    ],
    ids=["run with the stop", "single ones", "ends"],
)
def test_surfaces_without_an_aperture_of_codev_take_the_wider_of_the_nearest(tmp_path, caplog, given, expected):
    rows = [(61.47, 6, 1.517), (-44.64, 2.5, 1.673), (-129.94, 5, 1), (0, 5, 1)]
    rows += [(80, 5, 1.517), (-60, 2, 1.673), (-200, 60, 1)]

    def of(apertures):
        text = "RDM;LEN\nDIM M\nWL 587.5618\nREF 1\nSO 0.0 1e13\n"
        for index, ((radius, gap, n), aperture) in enumerate(zip(rows, apertures, strict=True)):
            text += f"S {radius} {gap}" + (f" {n}:50.0\n" if n > 1 else "\n") + "  STO\n" * (index == 3)
            text += f"  CIR {aperture}\n" * (aperture > 0)
        return text + "SI 0.0 0.0\nGO\n"

    with caplog.at_level("INFO", logger="mitsuba_plenoptic"):
        lens = read(tmp_path, of(given), "lens.seq")
    assert [surface.semi_aperture for surface in lens.surfaces] == list(expected)
    assert lens == read(tmp_path, of(expected), "lens.seq")
    numbers = ", ".join(str(number) for number, aperture in enumerate(given, start=1) if not aperture)
    (remark,) = (record.getMessage() for record in caplog.records)
    assert f"surface {numbers}:" in remark
    refuses("line 6: 'S 61.47 6 1.517:50.0': surface 1", read, tmp_path, of([0] * 7), "lens.seq")
