"""The command: what it prints and writes, and what it says about mistakes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mitsuba_plenoptic import PlenopticCamera, read_capture, write_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io.captures import Capture

SMALL = ("-D", "resolution=256")


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    """Render a small capture of the letters once."""
    path = tmp_path_factory.mktemp("capture") / "raw.exr"
    assert main(["render", "letters", "-o", str(path), "--spp", "4", *SMALL]) == 0
    return path


@pytest.fixture
def scene(tmp_path):
    """Write a scene file with the given text in its sensor."""

    def write(sensor="", rfilter="box", pixel_format="luminance"):
        path = tmp_path / "scene.xml"
        path.write_text(
            '<scene version="3.0.0">\n<integrator type="path"/>\n'
            f'<sensor type="plenoptic">\n{sensor}\n'
            f'<film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="64"/>'
            f'<rfilter type="{rfilter}"/><string name="pixel_format" value="{pixel_format}"/>'
            '<string name="component_format" value="float32"/></film>\n</sensor>\n'
            '<emitter type="constant"/>\n</scene>\n'
        )
        return str(path)

    return write


def complaint(capfd, *arguments):
    """Run the command, see that it treats it as a user's mistake, and return what it says."""
    assert main([str(argument) for argument in arguments]) == 2
    output, error = capfd.readouterr()
    assert error.startswith("mitsuba-plenoptic: error: ")
    assert error.count("\n") == 1, error
    assert "Traceback" not in output + error
    return error.removeprefix("mitsuba-plenoptic: error: ").rstrip("\n")


class TestHelp:
    def test_without_a_command_help_is_printed(self, capfd):
        assert main([]) == 0
        assert "reconstruct" in capfd.readouterr().out

    @pytest.mark.parametrize("command", ["render", "reconstruct", "info", "doctor"])
    def test_every_command_has_help(self, command, capfd):
        assert main([command, "--help"]) == 0
        output, error = capfd.readouterr()
        assert f"mitsuba-plenoptic {command}" in output
        assert error == ""

    def test_version(self, capfd):
        assert main(["--version"]) == 0
        assert capfd.readouterr().out == f"mitsuba-plenoptic {version('mitsuba-plenoptic')}\n"

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (["nosuch"], "nosuch"),
            (["render"], "scene"),
            (["render", "letters"], "output"),
            (["render", "letters", "-o", "x.exr", "--nosuch"], "--nosuch"),
            (["render", "letters", "-o", "x.exr", "--spp", "many"], "--spp"),
            (["reconstruct", "raw.exr", "-o", "x.exr"], "--distance"),
            (["reconstruct", "raw.exr", "-o", "x.exr", "--distance", "far"], "--distance"),
        ],
    )
    def test_usage_errors_take_one_line(self, arguments, words, capfd):
        said = complaint(capfd, *arguments)
        assert words in said
        assert "--help)" in said


class TestRender:
    def test_writes_a_capture(self, raw, capfd):
        capture = read_capture(raw)
        assert capture.image.shape == (256, 256)
        assert capture.image.max() > 0
        assert capture.model == "ray"
        assert sorted(path.name for path in raw.parent.iterdir() if path.suffix == ".exr") == ["raw.exr"]

    def test_seed_and_samples_reach_the_renderer(self, tmp_path, capfd):
        images = []
        for name, *options in (("a", "--seed", "1"), ("b", "--seed", "1"), ("c", "--seed", "2")):
            path = tmp_path / f"{name}.exr"
            assert main(["render", "letters", "-o", str(path), "--spp", "1", "-D", "resolution=64", *options]) == 0
            images.append(read_capture(path).image)
        assert np.array_equal(images[0], images[1])
        assert not np.array_equal(images[0], images[2])
        assert "64 x 64 pixels" in capfd.readouterr().out

    def test_colour_variant(self, tmp_path, scene):
        path = tmp_path / "raw.exr"
        source = scene(pixel_format="rgb")
        assert main(["render", source, "-o", str(path), "--spp", "1", "--variant", "llvm_ad_rgb"]) == 0
        assert read_capture(path).image.shape == (64, 64, 3)

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (["nosuch"], "letters"),
            (["letters", "--spp", "0"], "spp = 0"),
            (["letters", "--seed", "-1"], "seed = -1"),
            (["letters", "--model", "magic"], "model = 'magic'"),
            (["letters", "-D", "resolution"], "-D NAME=VALUE"),
            (["letters", "-D", "resolutoin=64"], "resolutoin"),
            (["letters", "-D", "resolution=-5"], ""),
            (["letters", *SMALL, "-D", "focal_length=-80"], "focal_length = -80"),
            (["letters", *SMALL, "-D", "mla_pitch=nan"], "mla_pitch = nan"),
            (["letters", *SMALL, "-D", "mla_pitch=wide"], "wide"),
            (["letters", "--variant", "nosuch"], "variant = 'nosuch'"),
            (["letters", *SMALL, "--variant", "scalar_rgb"], "scalar_rgb"),
        ],
    )
    def test_mistakes(self, options, words, tmp_path, capfd):
        output = tmp_path / "raw.exr"
        assert words in complaint(capfd, "render", *options, "-o", output)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize(
        ("sensor", "words"),
        [
            ('<float name="focal_lenght" value="80"/>', ("focal_lenght",)),
            ('<string name="mla_pitch" value="wide"/>', ("mla_pitch = 'wide'", "must be a number", "line 3")),
            ('<boolean name="mla_pitch" value="true"/>', ("mla_pitch = True", "must be a number")),
            ('<float name="aperture_radius" value="-5"/>', ("aperture_radius = -5", "greater than 0")),
            ('<float name="focus_distance" value="80"/>', ("focus_distance = 80", "focal length")),
            ('<float name="near_clip" value="1"/>', ("near_clip",)),
            ('<transform name="to_world"><scale value="2"/></transform>', ("to_world", "scale")),
        ],
    )
    def test_wrong_scene_parameters(self, sensor, words, scene, tmp_path, capfd):
        path = scene(sensor)
        said = complaint(capfd, "render", path, "-o", tmp_path / "raw.exr")
        for word in (path, *words):
            assert word in said
        assert [item.name for item in tmp_path.iterdir()] == ["scene.xml"]

    def test_broken_scene_file(self, tmp_path, capfd):
        path = tmp_path / "broken.xml"
        path.write_text("<scene")
        assert str(path) in complaint(capfd, "render", path, "-o", tmp_path / "raw.exr")

    def test_another_sensor(self, tmp_path, capfd):
        path = tmp_path / "pinhole.xml"
        path.write_text('<scene version="3.0.0"><sensor type="perspective"/></scene>')
        assert "plenoptic" in complaint(capfd, "render", path, "-o", tmp_path / "raw.exr")

    @pytest.mark.parametrize("output", ["missing/raw.exr", ".", "raw.png", "raw"])
    def test_output_is_checked_before_rendering(self, output, tmp_path, capfd):
        complaint(capfd, "render", "nosuch", "-o", tmp_path / output)
        assert list(tmp_path.iterdir()) == []

    def test_a_warning_takes_one_line(self, scene, tmp_path, capfd):
        path = scene(rfilter="gaussian")
        assert main(["render", path, "-o", str(tmp_path / "raw.exr"), "--spp", "1"]) == 0
        error = capfd.readouterr().err
        assert error.startswith("mitsuba-plenoptic: warning: plenoptic: ")
        assert error.count("\n") == 1

    @pytest.mark.skipif(os.name == "nt", reason="signals differ")
    def test_interrupt_leaves_nothing(self, tmp_path):
        # The child says when it starts to render, so that the signal does not come while it still imports.
        code = """if True:
            import sys
            from mitsuba_plenoptic.cli import main, render
            original = render.render_capture
            def announce(*arguments, **options):
                print("rendering", flush=True)
                return original(*arguments, **options)
            render.render_capture = announce
            sys.exit(main())"""
        process = subprocess.Popen(
            [
                sys.executable,
                "-c",
                code,
                "render",
                "letters",
                "-o",
                tmp_path / "raw.exr",
                "--spp",
                "1000000",
                *SMALL,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdout.readline() == "rendering\n"
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=30)
        assert process.returncode == 130
        assert "Traceback" not in error
        assert list(tmp_path.iterdir()) == []


class TestReconstruct:
    def test_one_distance_goes_into_the_named_file(self, raw, tmp_path, capfd):
        assert main(["reconstruct", str(raw), "-o", str(tmp_path / "out.exr"), "--distance", "240"]) == 0
        assert [path.name for path in tmp_path.iterdir()] == ["out.exr"]
        header = OpenEXR.File(str(tmp_path / "out.exr"), header_only=True).header()
        assert json.loads(header["mitsuba_plenoptic"])["distance"] == 240
        assert "128 x 128 bins" in capfd.readouterr().out

    def test_several_distances_and_pictures(self, raw, tmp_path):
        distances = ["--distance", "210", "--distance", "240.5"]
        assert main(["reconstruct", str(raw), "-o", str(tmp_path / "out.png"), *distances]) == 0
        names = sorted(path.name for path in tmp_path.iterdir())
        assert names == ["out_210.png", "out_240.5.png"]
        pictures = [np.array(Image.open(tmp_path / name)) for name in names]
        assert {(picture.shape, picture.dtype.name) for picture in pictures} == {((128, 128), "uint8")}
        # One scale for all: only the brightest of them reaches white.
        assert max(picture.max() for picture in pictures) == 255

    def test_footprint(self, raw, tmp_path):
        files = []
        for footprint in ("lens", "point"):
            files.append(tmp_path / f"{footprint}.png")
            options = ["--distance", "210", "--footprint", footprint]
            assert main(["reconstruct", str(raw), "-o", str(files[-1]), *options]) == 0
        assert files[0].read_bytes() != files[1].read_bytes()

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (["--distance", "80"], "distance = 80: it must be greater than the focal length 80"),
            (["--distance", "-240"], "distance = -240"),
            (["--distance", "nan"], "distance = nan"),
            (["--distance", "inf"], "distance = inf"),
            (["--distance", "240", "--distance", "240"], "given twice"),
            (["--distance", "240", "--method", "magic"], "method = 'magic'"),
            (["--distance", "240", "--footprint", "magic"], "footprint = 'magic'"),
            (["--distance", "240", "--variant", "magic"], "variant = 'magic'"),
        ],
    )
    def test_mistakes(self, options, words, raw, tmp_path, capfd):
        assert words in complaint(capfd, "reconstruct", raw, "-o", tmp_path / "out.exr", *options)
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.parametrize("output", ["missing/out.exr", ".", "out.jpg", "out"])
    def test_unwritable_output(self, output, raw, tmp_path, capfd):
        complaint(capfd, "reconstruct", raw, "-o", tmp_path / output, "--distance", "240")
        assert list(tmp_path.iterdir()) == []

    @pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may write anywhere")
    def test_folder_without_permission(self, raw, tmp_path, capfd):
        tmp_path.chmod(0o500)
        said = complaint(capfd, "reconstruct", raw, "-o", tmp_path / "out.exr", "--distance", "240")
        assert "permission" in said


class TestDamagedCaptures:
    @pytest.fixture(params=["missing", "empty", "text", "foreign", "truncated", "header", "reconstruction"])
    def damaged(self, request, raw, tmp_path):
        path = tmp_path / "damaged.exr"
        content = raw.read_bytes()
        if request.param == "empty":
            path.write_bytes(b"")
        elif request.param == "text":
            path.write_text("not an image")
        elif request.param == "foreign":
            pixels = {"Y": np.zeros((4, 4), dtype=np.float32)}
            OpenEXR.File({"type": OpenEXR.scanlineimage}, pixels).write(str(path))
        elif request.param == "truncated":
            path.write_bytes(content[: len(content) // 2])
        elif request.param == "header":
            path.write_bytes(content[:200])
        elif request.param == "reconstruction":
            assert main(["reconstruct", str(raw), "-o", str(path), "--distance", "240"]) == 0
        return path

    def test_reconstruct_and_info(self, damaged, tmp_path, capfd):
        capfd.readouterr()
        before = list(tmp_path.iterdir())
        output = tmp_path / "out.exr"
        assert str(damaged) in complaint(capfd, "reconstruct", damaged, "-o", output, "--distance", "240")
        assert str(damaged) in complaint(capfd, "info", damaged)
        assert list(tmp_path.iterdir()) == before


class TestInfo:
    def test_builtin_scene(self, capfd):
        assert main(["info", "letters", "--wavelength", "633"]) == 0
        output = capfd.readouterr().out
        assert "128 x 128" in output
        assert "Diffraction at 633 nm" in output
        assert "Warning" not in output

    def test_parameters_and_warnings(self, capfd):
        assert main(["info", "letters", "-D", "aperture_radius=10"]) == 0
        assert "Warning: micro-images overlap" in capfd.readouterr().out

    def test_capture_tells_how_it_was_made(self, raw, capfd):
        assert main(["info", str(raw)]) == 0
        output = capfd.readouterr().out
        for words in ("model: ray", "spp: 4", "seed: 0", "variant: llvm_ad_mono"):
            assert words in output

    def test_wavelength_of_the_capture(self, tmp_path, capfd):
        camera = PlenopticCamera(resolution=(64, 64), detector_width=0.128)
        write_capture(tmp_path / "w.exr", Capture(np.ones((64, 64)), camera, wavelength=532.0, model="wave"))
        assert main(["info", str(tmp_path / "w.exr")]) == 0
        assert "Diffraction at 532 nm" in capfd.readouterr().out

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            (["nosuch"], "letters"),
            (["nosuch.exr"], "there is no such file"),
            (["letters", "--wavelength", "-633"], "wavelength = -633"),
            (["letters", "--wavelength", "nan"], "wavelength = nan"),
        ],
    )
    def test_mistakes(self, options, words, capfd):
        assert words in complaint(capfd, "info", *options)


def test_doctor(capfd):
    assert main(["doctor"]) == 0
    output = capfd.readouterr().out
    for words in ("drjit", "LLVM", "threads", "CUDA", "llvm_ad_mono", "Ready to render"):
        assert words in output


def test_our_own_mistakes_keep_their_traceback(monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("a bug")

    monkeypatch.setattr("mitsuba_plenoptic.cli.inputs.load_scene", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["info", "letters"])


def test_console_script():
    script = Path(sys.executable).parent / "mitsuba-plenoptic"
    result = subprocess.run([script, "info", "nosuch"], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
