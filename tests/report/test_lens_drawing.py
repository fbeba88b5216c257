"""Drawings of main lenses and microlenses: what is drawn is what is traced."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from PIL import Image

from mitsuba_plenoptic import LensSystem, PlenopticCamera, read_prescription
from mitsuba_plenoptic.array import ZoneLens
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.lenses import main_lens
from mitsuba_plenoptic.prescription import Prescription, conjugate_distance
from mitsuba_plenoptic.report.lens_drawing import main_lens_figure
from mitsuba_plenoptic.report.lens_quality import behind_lens, chief, field_figures, ray_paths
from mitsuba_plenoptic.report.microlens_drawing import microlens_figure

pytest.importorskip("mitsuba_plenoptic.extensions.lensdesign")

LINE_C, LINE_F = 656.2725, 486.1327
"""Fraunhofer's lines, in nanometres."""

CAMERA = PlenopticCamera(main_lens="double_gauss", focal_length=80, aperture_radius=5, focus_distance=240)


@pytest.mark.parametrize("height", [0.0, 4.0])
def test_paths_end_where_rays_leave_the_lens(height):
    lens = main_lens(CAMERA)
    z, y = ray_paths(lens, height, 5)
    slopes = (y[1] - y[0]) / (z[1] - z[0])
    (_, last, front), (_, turned), is_open = lens.trace((0 * slopes, np.full(5, height)), (0 * slopes, slopes))
    assert np.abs(last - y[-2]).max() < 1e-12 and np.abs(front - z[-2]).max() < 1e-12 and is_open.all()
    assert z[0] == pytest.approx(np.full(5, lens.front - lens.scale * lens.numbers.length - lens.back_distance))
    assert y[-1] == pytest.approx(last + turned * (z[-1] - front), rel=1e-12)
    # In air the lens stands between its vertices, where surfaces follow each other towards the scene.
    assert (np.diff(z, axis=0) > 0).all()


@pytest.mark.parametrize(
    ("changes", "height"),
    [
        ({"main_lens": "singlet", "aperture_radius": 14}, 5.0),
        ({"main_lens": "double_gauss", "aperture_radius": 13, "focus_distance": 1e9}, 6.0),
        ({"main_lens": "cooke_triplet", "aperture_radius": 0.5, "focus_distance": 1000}, 6.0),
    ],
)
def test_spots_and_light_are_those_of_a_dense_trace(changes, height):
    """From a point before the lens, through all that its first surface takes in; light by rays back to the scene."""
    camera = CAMERA.replace(**changes)
    lens, g = main_lens(camera), camera.focus_distance
    start, slope, _ = lens.trace((0.0, height), (0.0, float(lens.chief_slope(height))))
    seen = start[1] + (g - start[2]) * slope[1]
    # All rays pass this disc, twice as wide as the entrance pupil, about the chief ray where the pupil stands.
    wide, random = 1.6 * camera.aperture_radius, np.random.default_rng(0)
    depth = lens.front - lens.scale * lens.numbers.entrance_pupil
    x, y = random.uniform(-wide, wide, (2, 200_000))
    y = y + start[1] + (depth - start[2]) * slope[1]
    (px, py), _, is_open, _ = lens.through((x, y, depth + 0 * x), (x / (depth - g), (y - seen) / (depth - g)))
    radius = np.sqrt(px[is_open].var() + py[is_open].var())
    (figures,) = field_figures(lens, [height], g)
    x, y, *_ = figures.rays[camera.main_lens.wavelength]
    assert np.sqrt(x.var() + y.var()) == pytest.approx(radius, rel=5e-3)
    # Which way the image lies about the chief ray's place.
    assert y.mean() == pytest.approx(py[is_open].mean() - height, abs=0.01 * radius)
    exit_x, exit_y = random.uniform(-1.3 * camera.pupil_radius, 1.3 * camera.pupil_radius, (2, 200_000))
    passing = [lens.ray((exit_x, exit_y), (0 * exit_x, field + 0 * exit_x))[2].mean() for field in (0.0, height)]
    assert figures.light == pytest.approx(passing[1] / passing[0], abs=4e-3)


def test_lateral_colour_is_that_of_forward_rays():
    """Of one object point, through the middle of the stop, which is the first surface of the singlet: to 2 %."""
    camera = PlenopticCamera(main_lens="singlet", focal_length=80, aperture_radius=3, focus_distance=240)
    point, places = np.array([0.0, 5.0, 240.0]), []
    for wavelength in (LINE_C, LINE_F):
        lens = LensSystem.of(camera, wavelength)
        slope = (np.zeros(1), np.array([point[1] / (point[2] - lens.front)]))
        place, _, is_open, _ = lens.through(tuple(np.full(1, c) for c in point), slope)
        assert is_open.all()
        places.append(float(place[1][0]))
    (figures,) = field_figures(main_lens(camera), [abs(places[0])], 240, [])
    assert figures.colour == pytest.approx(abs(places[1]) - abs(places[0]), rel=0.02)


def test_the_bar_of_a_drawing_is_as_long_as_it_says():
    axes = main_lens_figure(main_lens(CAMERA), 240).axes[0]
    bar = axes.patches[-1].get_window_extent()
    glass, array = (axes.lines[index].get_xdata()[0] for index in (0, -1))
    pixels = abs(np.subtract(*axes.transData.transform([(glass, 0), (array, 0)])[:, 0]))
    length = float(axes.texts[-1].get_text().removesuffix(" mm"))
    assert bar.width / length == pytest.approx(pixels / abs(glass - array))


@pytest.mark.slow
def test_figures_see_pupils_that_grow_off_the_axis():
    edge, dark = field_figures(main_lens(PlenopticCamera.preset("phone")), [1.96, 4.0], 1000, frequencies=[10])
    assert 1.35 < edge.light < 1.5 and abs(edge.distortion) < 0.01
    assert dark.light == 0 and dark.colour is None and np.isnan([dark.distortion, *dark.transfer[:, 0]]).all()


def test_a_drawing_is_made(tmp_path, run, complaint):
    picture, lens = tmp_path / "lens.png", "main_lens=singlet,focus_distance=300,mla_lattice=none"
    run("info", lens, "--drawing", picture, "--dpi", 40)
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("L"))
    assert pixels.shape[1] == 424 and (pixels < 128).mean() > 0.002
    assert "no main_lens of surfaces" in complaint("info", "paper", "--drawing", picture)
    for path, rule in ((tmp_path / "none" / "lens.png", "the folder"), (tmp_path / "lens.pdf", "--dpi 40: it is for")):
        assert rule in complaint("info", lens, "--drawing", path, "--dpi", 40)


SEQ = "RDM;LEN\nDIM M\nWL 587.5618\nSO 0.0 1e13\nS {0} {1} 1.5:60.0\n STO\n CIR {2}\nS -{0} 0\n CIR {2}\nSI 0 0\nGO\n"
"""A biconvex lens, by radius, thickness and semi-aperture."""


def test_a_lens_file_is_judged_where_parallel_light_is_in_focus(tmp_path, capsys, radius=0.5, gap=0.1):
    (tmp_path / "lens.seq").write_text(SEQ.format(radius, gap, 0.1))
    focal_length = 1 / (0.5 * (2 / radius - 0.5 * gap / (1.5 * radius**2)))
    drawing = ["--drawing", str(tmp_path / "lens.png"), "--dpi", "40"]
    assert main(["info", str(tmp_path / "lens.seq"), *drawing, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    values = {row["quantity"]: row["value"] for row in told["sheet"]}
    assert float(values["focal length"]) == pytest.approx(focal_length, rel=1e-6)
    assert values["image plane"] == values["paraxial focus"]
    spots = [float(row["value"]) for row in told["sheet"] if row["quantity"] == "spot"]
    # Third-order spherical aberration of a ray at the edge of this aperture is below 3 h^3 / f^2.
    edge = float(values["entrance pupil's diameter"]) / 2
    assert 0 < spots[0] < 1e3 * 3 * edge**3 / focal_length**2
    assert Image.open(tmp_path / "lens.png").size[0] == 424


NO_IMAGE = {
    "its focal length is -49.67 mm": SEQ.format(-50, 2, 5).replace("--", ""),
    "no detector": SEQ.format(50, 2, 5).replace("S 50", "S 0 90\n STO\n CIR 2\nS 50").replace("60.0\n STO", "60.0"),
}


@pytest.mark.parametrize("rule", NO_IMAGE)
def test_a_lens_file_that_forms_no_image_is_refused_by_its_own_numbers(rule, tmp_path, complaint):
    (tmp_path / "lens.seq").write_text(NO_IMAGE[rule])
    told = complaint("info", tmp_path / "lens.seq")
    assert f"{tmp_path}/lens.seq: " in told and rule in told
    assert not re.search("main_lens|mla_distance|aperture_radius|focus_distance", told)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--microlens", "micro.png"], "no such option: --microlens"),
        (["--pupil", "3", "--f-number", "8"], "--pupil, --f-number: give one of the two"),
        (["-D", "radius=3"], "no such option: -D"),
        (["--unit", "m"], "no such option: --unit"),
    ],
)
def test_options_that_a_lens_file_does_not_take_are_refused(options, words, tmp_path, complaint):
    path = tmp_path / "lens.seq"
    path.write_text(SEQ.format(50, 2, 5))
    assert complaint("info", path, *options).startswith(words.format(path=path))


def test_draws_any_microlens(tmp_path):
    camera = PlenopticCamera(mla_lattice="hexagonal", mla_medium=1.4, mla_shape=ZoneLens(0.4))
    microlens_figure(camera, 532.0).save(tmp_path / "lens.png")
    picture = matplotlib.image.imread(tmp_path / "lens.png")
    # Each of the three parts has colours.
    assert all((part[..., :3].std(axis=2) > 0.1).mean() > 0.01 for part in (picture[:, :560], picture[:, 600:1200]))
    assert picture[:, 1250:, :3].min() < 0.05


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
    text = (RECORDS / "double_gauss.seq").read_text()
    (tmp_path / "lens.seq").write_text(re.sub(r"\n  CIR.*", "", text).replace("SO 0 inf", f"SO 0 {distance}"))
    lens = read_prescription(tmp_path / "lens.seq")
    numbers, g = lens.paraxial, lens.object_distance + lens.paraxial.front_principal
    image = conjugate_distance(numbers.focal_length, g) + numbers.rear_principal
    assert (image - numbers.exit_pupil) / (2 * numbers.exit_radius) == pytest.approx(5, rel=1e-9)
    for mine, theirs in zip(lens.surfaces, read_prescription(RECORDS / "double_gauss.seq").surfaces, strict=True):
        assert mine.semi_aperture > theirs.semi_aperture or mine is lens.surfaces[lens.stop]


def test_info_of_a_lens_of_ones_own(tmp_path, capsys):
    page = (Path(__file__).parent.parent.parent / "docs/guides/main_lenses.md").read_text()
    (tmp_path / "own.yaml").write_text(re.search("```yaml\n(name: Achromat.*?)```", page, re.S)[1])
    options = ["--field", "3", "--f-number", "8", "--drawing", str(tmp_path / "own.png")]
    assert main(["info", str(tmp_path / "own.yaml"), *options]) == 0 and (tmp_path / "own.png").stat().st_size > 10_000
    told = capsys.readouterr().out
    assert "f/8" in told and "Field of 2.1 deg" in told and not re.search("[Dd]etector|pixel|ideal", told)
    assert main(["info", "paper", "--field", "3"]) == 2
    assert "no such option: --field" in capsys.readouterr().err
