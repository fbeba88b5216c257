"""Own scenes at the command: with another sensor, in metres, compared and swept by a camera that is named."""

import json

import mitsuba as mi
import numpy as np
import pytest
from cameras import write_scene
from PIL import Image

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.report import experiment

# The wall behind the box, in millimetres.
WALL = 4900


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    """Save Mitsuba's Cornell box, of two metres, as XML."""
    mi.set_variant("llvm_ad_rgb")
    path = tmp_path_factory.mktemp("box") / "my_scene.xml"
    mi.parser.write_file(mi.parser.parse_dict(mi.parser.ParserConfig("llvm_ad_rgb"), mi.cornell_box()), str(path))
    return path


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    """Save the preset lytro with a small detector."""
    path = tmp_path_factory.mktemp("camera") / "small.json"
    small = mp.PlenopticCamera.preset("lytro").replace(resolution=(40, 40), detector_width=0.056)
    path.write_text(small.to_json())
    return path


def test_scenes_without_a_plenoptic_sensor_are_answered_with_an_option(box, tmp_path, complaint):
    words = f"{box}: sensor of type PerspectiveCamera: "
    said = complaint("compare", box, "-o", tmp_path / "out", "--distance", WALL)
    assert said.startswith(words) and "--camera NAME gives it" in said
    assert complaint("render", box, "-o", tmp_path / "a.exr").endswith("; --camera NAME gives it one")
    said = complaint("info", box)
    assert said.startswith(words) and said.endswith("with --camera")
    empty = tmp_path / "empty.xml"
    empty.write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    said = complaint("compare", empty, "-o", tmp_path / "out", "--distance", WALL)
    assert said.startswith(f"{empty}: scene: it has no sensor; --camera NAME")
    assert complaint("info", empty).startswith(f"{empty}: it has no sensor; give")


def test_another_camera_is_rendered_in_the_place_of_a_sensor_and_in_its_colours(tmp_path, run, complaint):
    """At the second of two cameras; options of waves reach the capture, which refuses them by rays."""
    path, raw = tmp_path / "two.xml", tmp_path / "raw.exr"
    path.write_text(
        """<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"/><sensor type="perspective">
        <transform name="to_world"><translate x="100"/></transform></sensor>
        <shape type="sphere"><point name="center" x="100" y="0" z="400"/><float name="radius" value="30"/>
        <emitter type="area"><rgb name="radiance" value="0.7, 0.4, 0.2"/></emitter></shape></scene>"""
    )
    size = {"focal_length": 50, "focus_distance": 400, "resolution": (12, 9), "detector_width": 9}
    small, camera = mp.PlenopticCamera(mla_lattice="none", **size), tmp_path / "small.json"
    camera.write_text(small.to_json())
    words = ["render", path, "-o", raw, "--camera", camera, "--sensor", "1", "--spp", "16"]
    run(*words, "--variant", "llvm_ad_spectral")
    found = mp.read_capture(raw).image
    # The sphere is before the second camera alone.
    assert found[3:6, 4:8].min() > 0 == found[0, 0].max()
    assert found.mean((0, 1)) / found.mean() == pytest.approx([21 / 13, 12 / 13, 6 / 13], rel=0.03)
    for option in ("--bandwidth=40", "--responses=srgb"):
        words_of_rays = complaint(*words, option, "--model", "ray", "--variant", "llvm_ad_mono")
        assert words_of_rays.startswith(f"{option.partition('=')[0]}: a ray capture does not take it")


@pytest.mark.needs_extension("studio")
def test_own_scenes_in_metres_are_swept(box, camera, tmp_path, run, complaint):
    said = complaint("sweep", box, "-o", tmp_path / "a.nc", "--vary", "distance=4e3")
    assert said.startswith(f"{box}: sensor of type PerspectiveCamera: ") and "--camera NAME" in said
    assert complaint("preview", box, "-o", tmp_path / "a.png").endswith("; --camera NAME gives it one")
    words = ["sweep", box, "-o", tmp_path / "out.nc", "--camera", camera, "--unit", "m", "--spp", "4", "--vary"]
    words.append(f"distance={WALL},4000")
    assert complaint(*words, "-D", "resx=4").startswith("-D resx: it is of the scene's own camera")
    assert complaint(*words, "--vary", "resx=3,4").startswith("grid: resx: it is of the scene's own camera")
    assert run(*words).endswith("over 2 distance\n")
    scene = mp.with_camera(mp.load_scene(box, unit="m"), mp.PlenopticCamera.from_json(camera.read_text()))
    capture = mp.render_capture(scene, spp=4)
    found = mp.read_capture(tmp_path / "out.points" / "capture.exr")
    assert found.camera == capture.camera
    assert (found.image == capture.image).all() and capture.image.any()


@pytest.mark.slow
def test_own_scenes_in_metres_are_compared(box, camera, coarse_figures, tmp_path, monkeypatch, run):
    monkeypatch.setattr(experiment, "OBJECT_COLUMNS", 32)
    out, words = tmp_path / "out", ("--camera", camera, "--unit", "m", "--distance", WALL, "--spp", "4")
    assert "Rays against waves" in run("compare", box, "-o", out, *words)
    settings = json.loads((out / "results.json").read_text())["settings"]
    assert settings["camera"]["mla_pitch"] == 0.014 and settings["unit"] == "m"
    assert f"--camera {camera} --unit m" in (out / "report.html").read_text()
    scene = mp.with_camera(mp.load_scene(box, unit="m"), mp.PlenopticCamera.from_json(camera.read_text()))
    known = mp.render_capture(scene, spp=4, noise=True)
    assert (mp.read_capture(out / "data" / "capture_ray.exr").image == known.image).all()


@pytest.mark.slow
def test_scenes_of_colours_are_compared_in_colour(tmp_path, monkeypatch, run, complaint):
    monkeypatch.setattr(experiment, "OBJECT_COLUMNS", 32)
    card = """<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><scale value="20"/>
    <translate z="240"/></transform><emitter type="area"><rgb name="radiance" value="1, 0.4, 0.1"/></emitter></shape>"""
    scene = write_scene(tmp_path, card, sensor='<float name="detector_width" value="0.256"/>', pixel_format="rgb")
    out, words = tmp_path / "out", ("--distance", 240, "--spp", 4)
    run("compare", scene, "-o", out, *words, "--against", "ordinary")
    for model, wavelength in (("ray", None), ("wave", (611.4, 549.1, 464.3))):
        capture = mp.read_capture(out / "data" / f"capture_{model}.exr")
        assert capture.wavelength == wavelength
        red, green, blue = capture.image.mean((0, 1)).tolist()
        assert (green / red, blue / red) == pytest.approx((0.4, 0.1), rel=0.02)
    # The figures have the colour of the card, which differences and texts do not have.
    for name, least in (("methods", 0.4), ("captures", 0.1)):
        drawn = np.asarray(Image.open(out / f"{name}.png").convert("RGB"), dtype=int)
        assert np.mean((drawn[..., 0] - drawn[..., 1] > 60) & (drawn[..., 1] - drawn[..., 2] > 40)) > least
    results = json.loads((out / "results.json").read_text())
    assert results["reconstructions"][0]["bins"] == [4, 4] and results["command"].endswith("--variant llvm_ad_rgb")
    assert "611.4, 549.1, 464.3 nm" in (out / "report.html").read_text()
    pictures = results["ordinary"]["pictures"]
    assert [row["picture"] for row in pictures] == ["ordinary", "ray", "coherent", "partial"]
    # Green light, which luminance mostly is, alone.
    frequency = np.array(results["ordinary"]["frequency_per_mm"])
    transfer = results["ordinary"]["diffraction"] * np.sinc(frequency * 0.5 / pictures[0]["nyquist_per_mm"])
    assert pictures[0]["mtf50_per_mm"] == pytest.approx(np.interp(-0.5, -transfer, frequency), rel=0.05)
    assert complaint("compare", scene, "-o", out, *words, "--wavelength", 500).startswith("--wavelength = 500")
