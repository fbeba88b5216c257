"""The command: what it prints and writes."""

import re
from importlib.metadata import entry_points, version

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from cameras import SMALL_SENSOR, definitions, letters, write_scene
from PIL import Image

from mitsuba_plenoptic import Capture, PlenopticCamera, read_capture, read_ground_truth, write_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.views import white_image


def test_without_a_command_help_is_printed_and_the_version(run):
    (script,) = entry_points(group="console_scripts", name="mitsuba-plenoptic")
    assert script.load() is main
    assert "reconstruct" in run()
    assert run("--version") == f"mitsuba-plenoptic {version('mitsuba-plenoptic')}\n"


def test_seed_and_samples_reach_the_renderer(tmp_path, run):
    told = run("render", "letters", "-o", tmp_path / "a.exr", "--spp", 1, "-D", "resolution=64", "--seed", 2)
    assert read_capture(tmp_path / "a.exr").metadata.items() >= {"spp": 1, "seed": 2}.items()
    assert "64 x 64 pixels" in told


@pytest.fixture
def remarks(tmp_path, capfd):
    """Render a scene to ``raw.exr`` and return the lines on standard error."""

    def remarks(scene, *options):
        assert main(["render", str(scene), "-o", str(tmp_path / "raw.exr"), "--spp", "1", *options]) == 0
        lines = capfd.readouterr().err.splitlines()
        assert all(line.startswith("mitsuba-plenoptic: ") for line in lines)
        return [line.removeprefix("mitsuba-plenoptic: ") for line in lines]

    return remarks


def test_the_variant_follows_the_film_unless_told(tmp_path, remarks):
    def variant():
        return read_capture(tmp_path / "raw.exr").metadata["variant"]

    parameter = '<default name="colours" value="rgb"/><!-- <string name="pixel_format" value="rgb"/> -->'
    scene = write_scene(tmp_path, pixel_format="$colours", sensor=SMALL_SENSOR)
    scene.write_text(scene.read_text().replace("<integrator", f"{parameter}<integrator"))
    assert remarks(scene) == ["variant llvm_ad_rgb, as the film records rgb; --variant chooses another"]
    assert read_capture(tmp_path / "raw.exr").image.shape == (64, 64, 3)
    assert remarks(scene, "-D", "colours=luminance") == [] and variant() == "llvm_ad_mono"
    scene.write_text(scene.read_text().replace('<string name="pixel_format" value="$colours"/>', ""))
    assert len(remarks(scene)) == 1 and variant() == "llvm_ad_rgb"
    remarks(scene, "--variant", "llvm_ad_mono")
    assert variant() == "llvm_ad_mono"


def test_rendering_shows_the_warnings_of_info(tmp_path, remarks):
    (warning,) = remarks("letters", *definitions(letters(2, aperture_radius=10)))
    assert warning.startswith("warning: micro-images overlap: ")
    ball = '<shape type="sphere"><float name="radius" value="0.01"/><point name="center" z="0.24" x="0" y="0"/></shape>'
    (warning,) = remarks(write_scene(tmp_path, ball, sensor=SMALL_SENSOR))
    assert "the whole scene is nearer than 0.25 mm" in warning
    scene = write_scene(tmp_path, sensor='<float name="detector_width" value="1.28e-4"/>')
    assert any("a pixel is 2e-06 mm wide" in line for line in remarks(scene))


def test_any_camera_renders_any_scene_with_its_white_image(tmp_path, run, complaint):
    camera = PlenopticCamera(detector_width=0.256, resolution=(128, 96), focus_distance=245.0)
    (tmp_path / "camera.json").write_text(camera.to_json())
    raw, white = tmp_path / "raw.exr", tmp_path / "white.exr"
    told = run("render", "white", "-o", raw, "--camera", tmp_path / "camera.json", "--white", white, "--spp", "16")
    assert f"{white}: white image" in told
    capture, even = read_capture(raw), read_capture(white)
    assert capture.camera == even.camera == camera
    assert capture.image[even.image > 0.9].mean() == pytest.approx(capture.image.max(), rel=0.02)
    assert not capture.image[even.image == 0].any()
    (tmp_path / "bad.json").write_text('{"zoom": 2}')
    assert "bad.json: zoom: it is not" in complaint("render", "white", "-o", raw, "--camera", tmp_path / "bad.json")


def test_a_raw_picture_is_refocused_with_its_camera(tmp_path, raw, run, complaint):
    capture = read_capture(raw)
    (tmp_path / "camera.json").write_text(capture.camera.to_json())
    scale = 60000 / capture.image.max()
    Image.fromarray(np.round(scale * capture.image).astype(np.uint16)).save(tmp_path / "raw.tiff")
    arguments = "-o", tmp_path / "out.exr", "--distance", 240
    run("reconstruct", raw, *arguments)
    wanted = np.array(mi.Bitmap(str(tmp_path / "out.exr")))
    run("reconstruct", tmp_path / "raw.tiff", *arguments, "--camera", tmp_path / "camera.json", "--linear")
    found = np.array(mi.Bitmap(str(tmp_path / "out.exr"))) * (65535 / scale)
    np.testing.assert_allclose(found, wanted, atol=1e-4 * np.nanmax(wanted))
    assert complaint("reconstruct", tmp_path / "raw.tiff", *arguments).endswith("raw picture needs its --camera")


def test_one_distance_goes_into_the_named_file_and_several_beside_it(raw, tmp_path, run):
    assert "128 x 128 bins" in run("reconstruct", raw, "-o", tmp_path / "out.EXR", "--distance", "240")
    run("reconstruct", raw, "-o", tmp_path / "a.b.png", "--distance", "210", "--distance", "240.5")
    names = ["a.b_210.png", "a.b_240.5.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [*names, "out.EXR"]
    pictures = [np.array(Image.open(tmp_path / name)) for name in names]
    assert {(picture.shape, picture.dtype.name) for picture in pictures} == {((896, 896), "uint8")}
    # One scale for all: only the brightest of them reaches white.
    assert max(picture.max() for picture in pictures) == 255
    # 128 bins are 7 pixels wide, as many as fit in 960; asked for, one.
    run("reconstruct", raw, "-o", tmp_path / "bins.png", "--distance", "210", "--scale", 1)
    assert np.array(Image.open(tmp_path / "bins.png")).shape == (128, 128) and (pictures[0][3::7, 3::7] > 0).any()
    assert (pictures[0] == pictures[0][3::7, 3::7].repeat(7, 0).repeat(7, 1)).all()


def test_a_lamp_does_not_make_pictures_dark(tmp_path, run, complaint):
    camera = PlenopticCamera(detector_width=1.28, resolution=(160, 160))
    image = 0.25 * white_image(camera)
    image[80:85, 80:88] = 100
    write_capture(tmp_path / "raw.exr", Capture(image, camera))

    def median(*options):
        run("reconstruct", tmp_path / "raw.exr", "-o", tmp_path / "out.png", "--distance", 240, *options)
        return float(np.median(np.array(Image.open(tmp_path / "out.png"))))

    assert median() > 200
    assert median("--percentile", 100) < 50
    # Linear 0.5 of what is white, in sRGB.
    assert median("--exposure", 1) == pytest.approx(188, abs=2)
    views = ("views", tmp_path / "raw.exr", "-o", tmp_path / "v.png", "--percentile")
    assert "--exposure = 1, --percentile = 90" in complaint(*views, 90, "--exposure", 1)
    assert "percentile = 101" in complaint(*views, 101)


def test_info_of_scenes_captures_and_cameras(raw, tmp_path, run):
    output = run("info", "letters", "--wavelength", "633")
    assert "128 x 128" in output and "Diffraction at 633 nm" in output and "Warning" not in output
    assert "infinity" in run("info", "focus_distance=inf") and "kind of camera" in run("info", "raytrix")
    output = run("info", raw)
    assert all(words in output for words in ("model: ray", "spp: 4", "seed: 0", "variant: llvm_ad_mono"))
    camera = PlenopticCamera(resolution=(64, 64), detector_width=0.128)
    write_capture(tmp_path / "w.exr", Capture(np.ones((64, 64)), camera, wavelength=532.0, model="wave"))
    assert "Diffraction at 532 nm" in run("info", tmp_path / "w.exr")


def test_ground_truth_lies_beside_the_capture_and_reaches_views_and_depth(tmp_path, run, complaint):
    path, beside = tmp_path / "raw.exr", tmp_path / "raw.truth.exr"
    small = ("-D", "detector_width=0.768", "-D", "resolution=192", "--spp", "2")
    told = run("render", "still_life", *small, "-o", path, "--aov", "depth, normal")
    assert f"{beside}: ground truth, depth, normal" in told
    truth = read_ground_truth(beside)
    assert list(truth.pixels) == ["depth", "normal"] and truth.pixels["depth"].shape == (192, 192)
    depth = ("-o", tmp_path / "depth.exr", "--planes", 16)
    told = run("depth", path, *depth)
    assert float(re.search(r"against ground truth: median ([\d.]+)%", told)[1]) < 1
    run("views", path, "-o", tmp_path / "views.exr", "--count", 1)
    (part,) = OpenEXR.File(str(tmp_path / "views.exr"), separate_channels=True).parts
    middle = truth.views["depth"].shape[0] // 2
    np.testing.assert_array_equal(part.channels["depth.Z"].pixels, truth.views["depth"][middle, middle])
    assert "normal.X" in part.channels

    # Exposed it is the same scene; rendered anew it has no ground truth, unless told.
    run("expose", path, "-o", tmp_path / "exposed.exr", "--photons", 5000)
    assert "ground truth" in run("depth", tmp_path / "exposed.exr", *depth)
    run("render", "still_life", *small, "-o", path)
    assert "ground truth" not in run("depth", path, *depth)
    assert "ground truth" in run("depth", path, *depth, "--truth", beside)
    assert "raw.exr: it holds a 'capture'" in complaint("depth", path, "-o", tmp_path / "a.exr", "--truth", path)


def test_ground_truth_is_of_the_sensor_that_is_rendered(tmp_path, run, complaint):
    other = PlenopticCamera(resolution=(96, 96), detector_width=0.192).to_xml() + '<emitter type="constant"/>'
    scene, path = write_scene(tmp_path, other, sensor=SMALL_SENSOR), tmp_path / "raw.exr"
    run("render", scene, "-o", path, "--spp", 1, "--aov", "depth", "--sensor", 1)
    assert read_capture(path).camera.shape == (96, 96)
    assert read_ground_truth(tmp_path / "raw.truth.exr").camera == read_capture(path).camera
    assert "--sensor = 2" in complaint("render", scene, "-o", path, "--sensor", 2)


def test_noise_is_kept_and_told_and_an_estimate_writes_nothing(run, tmp_path):
    path = tmp_path / "raw.exr"
    small = ("letters", "-D", "resolution=64", "--spp", "2")
    assert "% of the mean" in run("render", *small, "-o", path, "--noise")
    assert "noise:" in run("info", path)
    estimated = r"letters: about [\d.e-]+ s and [\d.e-]+ GiB\n--spp 4 instead of 16 takes about a quarter"
    assert re.search(estimated, run("render", *small[:3], "--model", "wave", "--estimate"))
    assert list(tmp_path.iterdir()) == [path]


SHEET = "f_number=2.8,lenses=8,6,pixels_per_lens=10,pixel_size=0.005,focal_length=50,focus_distance=320"


def test_a_scene_is_rendered_by_a_camera_of_a_data_sheet(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run("render", "letters", "-o", "raw.exr", "--spp", "1", "--camera", SHEET)
    capture = read_capture("raw.exr")
    numbers = {"f_number": 2.8, "lenses": (8, 6), "pixels_per_lens": 10, "pixel_size": 0.005}
    assert capture.camera == PlenopticCamera.matched(**numbers, focal_length=50, focus_distance=320)
    assert capture.image.shape == (60, 80)
    said = run("info", f"{SHEET},mla_lattice=hexagonal", "--wavelength", "550")
    assert "f/2.8" in said and "Warning" not in said


def test_info_writes_the_mended_camera(run, tmp_path):
    said = run("info", "aperture_radius=10", "--fix", tmp_path / "better.json")
    assert "Warning: micro-images overlap" in said and "stop the main lens down to a diameter of 15.064 mm" in said
    assert "better.json, with " in said.partition("Written:")[2] and "Still:" not in said
    assert PlenopticCamera.from_json((tmp_path / "better.json").read_text()).aperture_radius == 10
    assert "Warning" not in run("info", tmp_path / "better.json")
    assert "unchanged" in run("info", "paper", "--fix", tmp_path / "same.json")
    assert PlenopticCamera.from_json((tmp_path / "same.json").read_text()) == PlenopticCamera()
