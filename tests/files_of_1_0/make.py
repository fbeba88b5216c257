"""Write the files next to this one, with version 1.0: ``PYTHONPATH=CLONE_OF_1.0 python make.py FOLDER``."""

import os
import sys
from pathlib import Path
from typing import Any

import yaml

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io import checkpoints
from mitsuba_plenoptic.runtime import batches

SIZE = ["-D", "detector_width=0.256", "-D", "resolution=32", "-D", "letter_scale=0.05"]
WAVE = ["--model", "wave", "--spp", "4"]

RECIPE = {
    "count": 1,
    "seed": 3,
    "models": ["ray", "wave"],
    "camera": {"detector_width": 0.256, "resolution": [32, 32]},
    "scenes": [{"scene": "white"}],
    "ray": {"spp": 1},
    "wave": {"spp": 2},
    "truth": [],
}


def run(*words: str) -> None:
    """Run a command."""
    assert main(list(words)) == 0, words


def render(name: str, preset: str) -> None:
    """Render a white wall by waves with eight times as many pixels as a row of lenses of a preset has, cropped."""
    camera = mp.PlenopticCamera.preset(preset)
    middle = tuple(size // 2 for size in camera.resolution)
    camera = camera.replace(crop_offset=tuple(size - 8 for size in middle), crop_size=(16, 16))
    scene = mp.with_camera(mp.load_scene("white", variant="llvm_ad_mono"), camera)
    mp.write_capture(name, mp.render_capture(scene, model="wave", spp=4))


def spread(name: str) -> None:
    """Write the full field of a point in focus, on the axis, before a camera of f/2.8."""
    camera = mp.PlenopticCamera(
        focal_length=8.0, aperture_radius=1.43, focus_distance=72.0, mla_pitch=0.02, mla_focal_length=0.056,
        detector_width=0.16, resolution=(32, 32),
    )  # fmt: skip
    operator = mp.CaptureOperator(camera, [(0.0, 0.0, 72.0)], wavelength=633.0, method="full_field")
    mp.write_capture(name, mp.Capture(operator.forward([1.0]), camera, 633.0, "wave"))


def stop(name: str) -> None:
    """Write the checkpoint of a wave capture that is stopped after its first batch."""
    checkpoints.INTERVAL, checkpoints.FRACTION, batches._GROUP_SAMPLES = 0.0, 1e9, 1
    write = checkpoints._write

    def once(path: Path, *arguments: Any) -> None:
        write(path, *arguments)
        path.rename(name)
        raise KeyboardInterrupt

    checkpoints._write = once
    scene = mp.load_scene("letters", parameters=dict(word.split("=") for word in SIZE[1::2]))
    try:
        with checkpoints.Checkpoint(name) as checkpoint:
            mp.render_capture(scene, model="wave", spp=64, checkpoint=checkpoint)
    except KeyboardInterrupt:
        pass


def make(folder: Path) -> None:
    """Write all."""
    os.chdir(folder)
    assert mp.__version__ == "1.0.0"
    run("render", "letters", "-o", "ray.exr", "--spp", "4", *SIZE)
    run("render", "letters", "-o", "wave.exr", *WAVE, "--aov", "depth", *SIZE)
    run("expose", "wave.exr", "-o", "wave.png", "--photons", "1000")
    render("small_lenses.exr", "phone_quad")
    render("real_lens.exr", "paper_double_gauss")
    spread("spread.exr")
    Path("camera.json").write_text(mp.PlenopticCamera(detector_width=0.256, resolution=(32, 32)).to_json())
    Path("recipe.yaml").write_text(yaml.safe_dump(RECIPE))
    run("dataset", "recipe.yaml", "-o", "data")
    stop("wave.exr.checkpoint")


if __name__ == "__main__":
    make(Path(sys.argv[1]))
