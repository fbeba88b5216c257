"""The command that compares a real light field with simulated ones."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import scipy.ndimage
from PIL import Image
from refusals import refused, refuses

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, load_scene, render_capture
from mitsuba_plenoptic.extensions.calibrate.white_frames import sensor_pictures
from mitsuba_plenoptic.extensions.prediction import point_patterns, study
from mitsuba_plenoptic.extensions.prediction.withheld import TESTS, Ratio
from mitsuba_plenoptic.views import white_image

LETTERS = Path(os.environ.get("MITSUBA_PLENOPTIC_DATA", "/nowhere")) / "letters_ulf"

CAMERA = PlenopticCamera(
    main_lens={"magnification": 20, "numerical_aperture": 0.4, "immersion": 1.33},
    mla_pitch=0.125, mla_focal_length=2.5, detector_distance=2.5, mla_rotation=0.2, mla_offset=(0.02, -0.03),
    detector_width=2.0, resolution=(192, 192),
)  # fmt: skip

THIN = PlenopticCamera(
    focal_length=200, aperture_radius=3.06, mla_distance=400, mla_pitch=0.3, mla_focal_length=18.6, mla_rotation=0.2,
    mla_offset=(0.05, -0.03), detector_width=4.2, resolution=(210, 210), detector_blur=0.012,
)  # fmt: skip
"""As the camera of the real letters, with larger pixels."""


def record(folder, camera, white):
    """Write pictures of 16 bits, two numbers an electron, and the camera roughly: points in a volume, or two planes."""
    random = np.random.default_rng(0)
    points = np.column_stack([random.uniform(-0.04, 0.04, (60, 2)), random.uniform(-0.01, 0.01, 60)])
    if camera.objective is None:
        planes = random.choice([385.0, 420.0], 150)
        points = np.column_stack([random.uniform(-1.5, 1.5, (150, 2)) * planes[:, None] / 400, planes])
    light = CaptureOperator(camera, points, wavelength=550.0).forward(random.exponential(size=len(points)))
    light = light / light.max() + 0.02 * white
    for name, image in (("white", white), ("light", light), ("dark", 0 * light)):
        values = random.poisson(8000 * image.clip(0)) * 2.0 + random.normal(100, 2, image.shape)
        Image.fromarray(values.round().clip(0, 65535).astype(np.uint16)).save(folder / f"{name}.tif")
    (folder / "camera.json").write_text(json.dumps(camera.replace(mla_offset=(0, 0)).to_dict()))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("real")
    record(folder, CAMERA, scipy.ndimage.gaussian_filter(white_image(CAMERA), 0.6))
    return folder, sensor_pictures(folder / "white.tif", light_field=folder / "light.tif", dark=folder / "dark.tif")


@pytest.fixture
def empty(tmp_path):
    """Files without content, for what is refused before they are read."""
    for name in ("light.tif", "white.tif", "dark.tif"):
        (tmp_path / name).touch()
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA.to_dict()))
    return tmp_path


def command(folder, *others):
    files = {"--real": "light.tif", "--white": "white.tif", "--dark": "dark.tif", "--camera": "camera.json"}
    given = [word for option, name in files.items() for word in (option, str(folder / name))]
    return ["compare", *given, "--wavelength", "550", "-o", str(folder / "out"), *others]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["objective", "planes", "search"])
def test_a_picture_by_waves_is_predicted_better_by_waves(kind, tmp_path, monkeypatch, run):
    camera = {"objective": CAMERA, "planes": THIN, "search": THIN.replace(mla_lattice="hexagonal")}[kind]
    # The fit of a white picture knows diffraction, and would take its lack for stray light below 0.
    sky = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant", "radiance": 1.0}}
    scene = load_scene(sky | {"camera": camera.replace(detector_blur=0.6 * camera.pixel_size).to_sensor()})
    white = render_capture(scene, model="wave", wavelength=550.0, spp=256).image
    record(tmp_path, camera, white / white.max())
    monkeypatch.setattr(point_patterns, "_WIDEST", 2.5)
    monkeypatch.setattr(study, "_SEARCHED", (0.5, 1.5))
    monkeypatch.setattr(study, "SEEDS", 2)
    monkeypatch.setattr(study, "ITERATIONS", 15)
    words = command(tmp_path, "--part", "0.1,0.1,0.9,0.9")
    words += ["--plane", "385", "--plane", "420"] if kind == "planes" else []
    if kind == "search":
        del words[words.index("--dark") : words.index("--dark") + 2]
    out = run(*words)
    assert "of withheld pixels, waves are better" in out
    assert ("no dark picture" in out) == (kind == "search")
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["ratios"]["pixels"]["low"] > 1
    # A search may put a third plane between these, whose steps are coarse here.
    found = np.array([[385, 420]] if kind == "objective" else results["distances"]).ravel()
    assert max(min(abs(found - plane)) for plane in (385, 420)) < 8
    assert results["verdict"] in out
    assert "<img" in (tmp_path / "out" / "report.html").read_text()
    # Finished runs are not repeated.
    monkeypatch.setattr(study, "fit_scene", None)
    run(*words, "--resume")


def test_a_light_field_40_numbers_low_has_the_same_electrons(recorded):
    white, light, dark = recorded[1]
    right = study.Pictures(white, light, dark).electrons
    with pytest.warns(UserWarning, match="numbers below the dark picture"):
        low = study.Pictures(white, light - 40, dark).electrons
    assert np.abs(low - right).max() < 0.01 * right.mean()


def test_dead_hot_and_clipped_pixels_are_left_out(recorded):
    white, light, dark = recorded[1]
    bad = np.random.default_rng(0).random(light.shape) < 0.004
    np.place(stuck := light.copy(), bad, [0, 65535, 7 * light.max() // 2])
    good = study.Pictures(white, stuck, dark).good.reshape(light.shape)
    assert good[bad].mean() < 0.2 < 0.999 < good[~bad].mean()
    for wrong, words in (light.clip(0, 150), "largest value"), (dark, "no light"):
        refuses(f"light field: .*{words}", study.Pictures, white, wrong, dark)


@pytest.mark.parametrize(("waves", "words"), [(3.0, "waves are better"), (30.0, "Neither waves nor rays explain")])
def test_residuals_far_above_the_noise_have_no_winner(waves, words):
    clear, other = Ratio(waves, 2 * waves, 1.9, 2.1), Ratio(2.0, 1.0, 0.4, 0.6)
    answer = study.Answer(dict.fromkeys(TESTS, clear), {}, {}, {}, {"waves": clear, "rays": other}, [], "")
    assert words in answer.verdict


@pytest.mark.slow
@pytest.mark.skipif(not LETTERS.exists(), reason="MITSUBA_PLENOPTIC_DATA has no folder letters_ulf")
def test_real_letters_are_predicted_better_by_waves(tmp_path, run):
    size = {"detector_width": 8.256, "resolution": (1280, 960), "mla_rotation": 0, "mla_offset": (0, 0)}
    (tmp_path / "camera.json").write_text(THIN.replace(aperture_radius=3.3, **size).to_json())
    names = {"--real": "", "--white": "_white", "--dark": "_dark"}
    words = [word for option, name in names.items() for word in (option, LETTERS / f"letters_ULF_M1{name}.png")]
    words += ["--camera", tmp_path / "camera.json", "--wavelength", "550", "--plane", "391", "--plane", "406"]
    out = run("compare", *words, "-o", tmp_path / "out")
    assert "noise is cut off" in out
    ratios = json.loads((tmp_path / "out" / "results.json").read_text())["ratios"]
    assert "it says nothing" not in out
    assert ratios["pixels"]["low"] > 1.5
    assert ratios["lenses"]["low"] > 1.1


def test_wrong_options_get_one_line(empty, complaint):
    assert "scene = chart" in complaint(*command(empty, "chart"))
    assert "--distance, --against, -D" in complaint(*command(empty, "--distance", "200"))
    assert "part = 0.5,0.5,0.2,1" in complaint(*command(empty, "--part", "0.5,0.5,0.2,1"))
    assert not (empty / "out").exists()
    *words, _, _, option, folder = command(empty)
    assert "--white, --camera and --wavelength" in complaint(*words, option, folder)
    assert "--real" in complaint("compare", option, folder)
    assert "--real" in complaint("compare", "chart", "--distance", "200", "--part", "0,0,1,1", option, folder)


def test_messages_name_the_picture_that_is_wrong(recorded, complaint):
    folder = recorded[0]
    (folder / "camera.json").write_text(CAMERA.replace(mla_lattice="hexagonal").to_json())
    assert f"{folder / 'white.tif'}: mla_lattice = hexagonal" in complaint(*command(folder, "--part", "0,0,1,1"))
    Image.new("I;16", (4, 3)).save(folder / "other.tif")
    refuses(r"light field of shape \(3, 4\)", sensor_pictures, folder / "white.tif", light_field=folder / "other.tif")


def judged(part=210, planes=(), **changes):
    return study.Study(None, THIN.replace(**changes), 550.0, (0, 0, part, part), list(planes), None)


test_what_cannot_be_judged_is_refused_at_once = refused(
    (lambda: judged(mla_tilt=(1.0, 0.0)), "mla_tilt = "),
    (lambda: judged(pupil_apodisation=(-0.2, 0.0)), "pupil_apodisation = "),
    (lambda: judged(planes=[385.0, 385.0]), r"plane = \[385.0, 385.0\]"),
    (lambda: judged(150), "part: it shows 9[0-9] lenses"),
)
