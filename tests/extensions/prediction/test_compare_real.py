"""The command that compares a real light field with simulated ones."""

import json

import mitsuba as mi
import numpy as np
import pytest
import scipy.ndimage
from PIL import Image

from mitsuba_plenoptic import CaptureOperator, InputError, PlenopticCamera, extension, load_scene, render_capture
from mitsuba_plenoptic.extensions.prediction import point_patterns, study
from mitsuba_plenoptic.views import white_image

CAMERA = PlenopticCamera(
    main_lens={"magnification": 20, "numerical_aperture": 0.4, "immersion": 1.33},
    mla_pitch=0.125, mla_focal_length=2.5, detector_distance=2.5, mla_rotation=0.2, mla_offset=(0.02, -0.03),
    detector_width=2.0, resolution=(192, 192),
)  # fmt: skip


def write(path, light, photons, generator):
    """A picture of 16 bits, of two numbers an electron, with a dark level of 100."""
    values = generator.poisson(photons * light.clip(0)) * 2.0 + generator.normal(100, 2, light.shape)
    Image.fromarray(values.round().clip(0, 65535).astype(np.uint16)).save(path)


@pytest.fixture
def pictures(tmp_path):
    generator = np.random.default_rng(0)
    white = scipy.ndimage.gaussian_filter(white_image(CAMERA), 0.6)
    points = np.column_stack([generator.uniform(-0.04, 0.04, (60, 2)), generator.uniform(-0.01, 0.01, 60)])
    light = CaptureOperator(CAMERA, points, wavelength=550.0).forward(generator.exponential(size=60))
    light = light / light.max() + 0.02 * white
    dark = np.zeros_like(light)
    for name, image, photons in (("white", white, 8000), ("light", light, 8000), ("dark", dark, 0)):
        write(tmp_path / f"{name}.tif", image, photons, generator)
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA.replace(mla_offset=(0, 0)).to_dict()))
    return tmp_path


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
def test_a_picture_by_waves_is_predicted_better_by_waves(pictures, monkeypatch, run):
    # The fit of a white picture knows diffraction, and would take its lack for stray light below 0.
    sky = {"type": "scene", "integrator": {"type": "direct"}, "sky": {"type": "constant", "radiance": 1.0}}
    mi.set_variant("llvm_ad_mono")
    scene = load_scene(sky | {"camera": CAMERA.replace(detector_blur=0.6 * CAMERA.pixel_size).to_sensor()})
    white = render_capture(scene, model="wave", wavelength=550.0, spp=256).image
    write(pictures / "white.tif", white / white.max(), 8000, np.random.default_rng(1))
    monkeypatch.setattr(point_patterns, "_WIDEST", 2.5)
    monkeypatch.setattr(study, "SEEDS", 2)
    monkeypatch.setattr(study, "ITERATIONS", 15)
    out = run(*command(pictures, "--part", "0.1,0.1,0.9,0.9"))
    assert "of withheld pixels, waves are better" in out
    results = json.loads((pictures / "out" / "results.json").read_text())
    assert results["ratios"]["fitted"]["pixels"]["low"] > 1
    assert results["verdict"] in out
    assert "<img" in (pictures / "out" / "report.html").read_text()
    # Finished runs are not repeated.
    monkeypatch.setattr(study, "fit_volume", None)
    run(*command(pictures, "--part", "0.1,0.1,0.9,0.9", "--resume"))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["chart"], "scene = chart: --real takes its place"),
        (["--distance", "200"], "--distance, --against, -D: they are not for --real"),
        (["--part", "0.5,0.5,0.2,1"], "part = 0.5,0.5,0.2,1: it must be LEFT,TOP,RIGHT,BOTTOM"),
        (["--part", "half"], "part = half: it must be"),
    ],
)
def test_wrong_options_get_one_line(empty, words, line, complaint):
    assert line in complaint(*command(empty, *words))
    assert not (empty / "out").exists()


def test_the_wavelength_is_not_guessed(empty, pictures, complaint):
    words = command(empty)
    words[words.index("--wavelength") : words.index("--wavelength") + 2] = []
    assert "give --white, --dark, --camera and --wavelength, too" in complaint(*words)
    # The last one given counts.
    said = "wavelength = 210, which is also tried -15 nm off = 195: it must be from 200"
    assert said in complaint(*command(pictures, "--wavelength", "210"))


def test_a_scene_or_a_light_field_is_needed(tmp_path, complaint):
    assert "give a scene and a distance, or --real" in complaint("compare", "-o", tmp_path / "out")
    words = ["compare", "chart", "--distance", "200", "--part", "0,0,1,1", "-o", tmp_path / "out"]
    assert "they are for --real" in complaint(*words)


def test_pictures_of_other_sizes_are_refused(pictures, complaint):
    image = np.asarray(Image.open(pictures / "light.tif"))
    Image.fromarray(image[:-1]).save(pictures / "light.tif")
    words = "light field of shape (191, 192): it must have the pixels of the white picture"
    assert words in complaint(*command(pictures))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mla_tilt": (1.0, 0.0)}, "mla_tilt = .*: waves of points by method patch refuse it"),
        ({"pupil_apodisation": (-0.2, 0.0)}, "pupil_apodisation = .*predictions.* refuse it: .*round pupil"),
    ],
)
def test_cameras_that_waves_or_rays_do_not_follow_are_refused(changes, words):
    with pytest.raises(InputError, match=words):
        study.Study(None, CAMERA.replace(**changes), 550.0, (0, 0, 192, 192), None)


def test_without_the_extension_one_line_says_so(empty, monkeypatch, complaint):
    records = {name: record for name, record in extension.installed().items() if not name.endswith("prediction")}
    monkeypatch.setattr(extension, "installed", lambda: records)
    assert "extension prediction is not installed" in complaint(*command(empty))
