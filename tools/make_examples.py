"""Render the captures of ``mp.example`` from the built-in scenes, with fixed seeds.

Usage: ``python tools/make_examples.py [-o FOLDER]``; without a folder, the files in ``mitsuba_plenoptic/examples/`` are
replaced. It takes about 20 s.

The camera's `lens_model` is that of the scenes, ``ideal``, so that rays and waves differ by no aberrations.

Radiances are rounded to 2^-14, as by a detector of 14 bits whose white is radiance 1, and depths to 2^-10 mm: far below
the noise of the samples, and the files become half as large.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.io.examples import FOLDER
from mitsuba_plenoptic.io.truth_files import TRUTH_NAME, truth_path

CAMERA = {"detector_width": "3.072", "resolution": "768"}
LETTERS = {**CAMERA, "letter_scale": "0.6"}
CAPTURES = {
    "letters-ray": ("letters", LETTERS, "ray"),
    "letters-wave": ("letters", LETTERS, "wave"),
    "white": ("white", CAMERA, "ray"),
}
"""Scene, its parameters and the model of light, by the name of the example."""

SAMPLES, SEED = 64, 1
RADIANCE_BITS, DEPTH_BITS = 14, 10


def rounded(values: np.ndarray, bits: int) -> np.ndarray:
    """Round to multiples of 2^-bits; NaN and infinity remain."""
    return (np.rint(values.astype(np.float64) * 2.0**bits) / 2.0**bits).astype(np.float32)


def write_example(path: Path, scene: str, parameters: dict[str, str], model: str) -> None:
    """Write a capture, and its ground truth next to it."""
    loaded = mp.load_scene(scene, variant="llvm_ad_mono", parameters=parameters)
    capture = mp.render_capture(loaded, model=model, spp=SAMPLES, seed=SEED)
    truth = mp.ground_truth(loaded, ["depth"])
    pixels, views = (
        {name: rounded(values, DEPTH_BITS) for name, values in part.items()} for part in (truth.pixels, truth.views)
    )
    mp.write_ground_truth(truth_path(path), replace(truth, pixels=pixels, views=views))
    about = {**capture.metadata, "parameters": parameters, TRUTH_NAME: truth_path(path).name}
    mp.write_capture(path, replace(capture, image=rounded(capture.image, RADIANCE_BITS), metadata=about))
    print(f"{path}: {path.stat().st_size / 2**10:.0f} KiB; ground truth {truth_path(path).stat().st_size / 2**10:.0f}")


def main() -> None:
    """Make all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=FOLDER, metavar="FOLDER")
    folder = parser.parse_args().output
    for name, recipe in CAPTURES.items():
        write_example(folder / f"{name}.exr", *recipe)


if __name__ == "__main__":
    main()
