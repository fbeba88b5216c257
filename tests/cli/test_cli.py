"""The command: what it prints and writes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from PIL import Image
from scene_cases import write_scene

from mitsuba_plenoptic import PlenopticCamera, read_capture, write_capture
from mitsuba_plenoptic.cli import app, main
from mitsuba_plenoptic.io.captures import Capture
from mitsuba_plenoptic.presets import PRESETS
from mitsuba_plenoptic.report import installation


def test_without_a_command_help_is_printed(run):
    assert "reconstruct" in run()


@pytest.mark.parametrize("command", [entry.name for entry in app.registered_commands])
def test_every_command_has_help(command, run):
    assert f"mitsuba-plenoptic {command}" in run(command, "--help")


def test_version(run):
    assert run("--version") == f"mitsuba-plenoptic {version('mitsuba-plenoptic')}\n"


def test_render_writes_a_capture(raw):
    capture = read_capture(raw)
    assert capture.image.shape == (256, 256)
    assert capture.image.max() > 0
    assert capture.model == "ray"
    assert [path.name for path in raw.parent.iterdir()] == ["raw.exr"]


def test_seed_and_samples_reach_the_renderer(tmp_path, run):
    images = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        path = tmp_path / f"{name}.exr"
        told = run("render", "letters", "-o", path, "--spp", "1", "-D", "resolution=64", "--seed", seed)
        images.append(read_capture(path).image)
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])
    assert "64 x 64 pixels" in told


def test_colour_variant(tmp_path, run):
    path = tmp_path / "raw.exr"
    run("render", write_scene(tmp_path, pixel_format="rgb"), "-o", path, "--spp", "1", "--variant", "llvm_ad_rgb")
    assert read_capture(path).image.shape == (64, 64, 3)


def test_a_warning_takes_one_line(tmp_path, capfd):
    path = write_scene(tmp_path, rfilter="gaussian")
    assert main(["render", str(path), "-o", str(tmp_path / "raw.exr"), "--spp", "1"]) == 0
    error = capfd.readouterr().err
    assert error.startswith("mitsuba-plenoptic: warning: plenoptic: ")
    assert error.count("\n") == 1


@pytest.mark.skipif(os.name == "nt", reason="signals differ")
def test_interrupt_leaves_nothing(tmp_path):
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
    line = f"render letters -o {tmp_path}/raw.exr --spp 1000000 -D resolution=256"
    process = subprocess.Popen(
        [sys.executable, "-c", code, *line.split()], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "rendering\n"
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


def test_one_distance_goes_into_the_named_file(raw, tmp_path, run):
    assert "128 x 128 bins" in run("reconstruct", raw, "-o", tmp_path / "out.exr", "--distance", "240")
    assert [path.name for path in tmp_path.iterdir()] == ["out.exr"]
    header = OpenEXR.File(str(tmp_path / "out.exr"), header_only=True).header()
    assert json.loads(header["mitsuba_plenoptic"])["distance"] == 240


def test_several_distances_and_pictures(raw, tmp_path, run):
    run("reconstruct", raw, "-o", tmp_path / "out.png", "--distance", "210", "--distance", "240.5")
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["out_210.png", "out_240.5.png"]
    pictures = [np.array(Image.open(tmp_path / name)) for name in names]
    assert {(picture.shape, picture.dtype.name) for picture in pictures} == {((128, 128), "uint8")}
    # One scale for all: only the brightest of them reaches white.
    assert max(picture.max() for picture in pictures) == 255


def test_footprint(raw, tmp_path, run):
    for footprint in ("lens", "point"):
        run("reconstruct", raw, "-o", tmp_path / f"{footprint}.png", "--distance", "210", "--footprint", footprint)
    assert (tmp_path / "lens.png").read_bytes() != (tmp_path / "point.png").read_bytes()


def test_info_of_a_scene(run):
    output = run("info", "letters", "--wavelength", "633")
    assert "128 x 128" in output
    assert "Diffraction at 633 nm" in output
    assert "Warning" not in output
    assert "Warning: micro-images overlap" in run("info", "letters", "-D", "aperture_radius=10")


@pytest.mark.parametrize("name", PRESETS)
def test_info_of_a_preset(name, run):
    assert "kind of camera" in run("info", name)


def test_info_of_a_capture_tells_how_it_was_made(raw, tmp_path, run):
    output = run("info", raw)
    assert all(words in output for words in ("model: ray", "spp: 4", "seed: 0", "variant: llvm_ad_mono"))
    camera = PlenopticCamera(resolution=(64, 64), detector_width=0.128)
    write_capture(tmp_path / "w.exr", Capture(np.ones((64, 64)), camera, wavelength=532.0, model="wave"))
    assert "Diffraction at 532 nm" in run("info", tmp_path / "w.exr")


def test_doctor(run):
    output = run("doctor")
    for words in ("drjit", "LLVM", "threads", "CUDA", "llvm_ad_mono", "Ready to render"):
        assert words in output


def test_doctor_lists_what_works(tmp_path, run, monkeypatch):
    monkeypatch.setattr(mi, "variants", lambda: ["scalar_rgb", "llvm_ad_mono_polarized", "cuda_ad_rgb"])
    monkeypatch.setattr(installation.drjit, "has_backend", lambda _: False)
    monkeypatch.setattr(installation.llvm, "problem", lambda: None)
    expected = [
        ("llvm_ad_mono_polarized", "works here; wave captures are unpolarized"),
        ("cuda_ad_rgb", "not usable here"),
    ]
    assert installation.inspect_installation().sections["Variants"] == expected
    monkeypatch.undo()
    run(
        "render", write_scene(tmp_path), "-o", tmp_path / "raw.exr", "--spp", "1", "--variant", "llvm_ad_mono_polarized"
    )
    assert read_capture(tmp_path / "raw.exr").image.any()


def test_console_script():
    script = Path(sys.executable).parent / "mitsuba-plenoptic"
    result = subprocess.run([script, "info", "nosuch"], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1


def test_noise_is_kept_and_told_and_an_estimate_writes_nothing(run, tmp_path):
    path = tmp_path / "raw.exr"
    small = ("letters", "-D", "resolution=64", "--spp", "2")
    assert "% of the mean" in run("render", *small, "-o", path, "--noise")
    assert "noise:" in run("info", path)
    assert re.search(r"letters: about [\d.e-]+ s and [\d.e-]+ GiB", run("render", *small, "--estimate"))
    assert list(tmp_path.iterdir()) == [path]
