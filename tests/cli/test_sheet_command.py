"""The command ``sheet``: reconstructions of several methods and distances in one figure."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest

from mitsuba_plenoptic import InputError, read_capture, reconstruct
from mitsuba_plenoptic.refocus import read_reconstruction, write_reconstruction


@pytest.fixture(scope="module")
def results(raw, tmp_path_factory):
    """Write reconstructions by one method at two distances, and by another at one of them."""
    folder = tmp_path_factory.mktemp("results")
    capture = read_capture(raw)
    found = [
        *reconstruct(capture, [240, math.inf], method="ray"),
        *reconstruct(capture, [240], method="ray", footprint="point"),
    ]
    paths = [folder / f"{index}.exr" for index in range(len(found))]
    for path, one in zip(paths, found, strict=True):
        write_reconstruction(path, one)
    return paths, found


def test_what_was_written_is_read(results):
    for path, one in zip(*results, strict=True):
        back = read_reconstruction(path)
        np.testing.assert_array_equal(back.image, one.image)
        assert (back.distance, back.bin_size, back.method) == (one.distance, one.bin_size, one.method)
        assert back.camera == one.camera and back.options == one.options


@pytest.mark.parametrize(("suffix", "begins"), [("pdf", b"%PDF-"), ("png", b"\x89PNG")])
def test_a_figure_of_all(suffix, begins, results, tmp_path, run):
    path = tmp_path / f"sheet.{suffix}"
    assert run("sheet", *results[0], "-o", path) == f"{path}: 3 images (methods: 1, distances: 2)\n"
    assert path.read_bytes().startswith(begins)


@pytest.mark.parametrize("option", ["-q", pytest.param("-OO", marks=pytest.mark.slow)])
def test_figures_follow_no_settings_of_matplotlib_python_or_a_display(option, results, tmp_path, run):
    """With an inline backend, a matplotlibrc of somebody else, and with docstrings left out."""
    path, settings = tmp_path / "sheet.png", tmp_path / "matplotlibrc"
    settings.write_text("image.origin: lower\ntext.usetex: True\naxes.titleweight: bold\n")
    run("sheet", *results[0], "-o", tmp_path / "plain.png")
    environment = {**os.environ, "MPLBACKEND": "module://nowhere.inline", "MATPLOTLIBRC": str(settings)}
    words = [sys.executable, option, "-m", "mitsuba_plenoptic", "sheet", *map(str, results[0]), "-o", str(path)]
    subprocess.run(words, check=True, env=environment, capture_output=True)
    assert path.read_bytes() == (tmp_path / "plain.png").read_bytes()


def test_a_name_that_is_no_text_is_refused_first(raw, complaint):
    name = os.fsdecode(b"sheet\xff.png")
    assert "must be text in UTF-8" in complaint("reconstruct", raw, "--distance", "240", "-o", name)


def test_refused(results, raw, tmp_path, complaint):
    path = tmp_path / "sheet.pdf"
    assert complaint("sheet", raw, "-o", path) == f"{raw}: it holds a 'capture', not a reconstruction"
    assert complaint("sheet", results[0][0], "-o", tmp_path / "a.gif").endswith("give a name that ends in .pdf or .png")
    assert "Missing argument" in complaint("sheet", "-o", path)
    with pytest.raises(InputError, match="there is no such file"):
        read_reconstruction(tmp_path / "none.exr")


def test_distances_are_chosen(results, tmp_path, run, complaint):
    path = tmp_path / "sheet.png"
    words = f"{path}: 2 images (methods: 1, distances: 1)\n"
    assert run("sheet", *results[0], "-o", path, "--distance", "240") == words
    assert run("sheet", *results[0], "-o", path, "--distance", "inf").startswith(f"{path}: 1 images")
    rule = "--distance = 210: no result is refocused there, but to 240, inf"
    assert complaint("sheet", *results[0], "-o", path, "--distance", "210") == rule
