"""The command ``mtf``: edges of a refocused image."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.refocus import write_reconstruction


@pytest.fixture
def refocused(raw, tmp_path):
    """Write a reconstruction whose image is a blurred edge, turned by 5 degrees."""
    rows, columns = np.mgrid[:480, :480] / 8 - 30
    image = gaussian_filter((columns > 0.0875 * rows + 2).astype(float), 8).reshape(60, 8, 60, 8).mean(axis=(1, 3))
    made = replace(mp.reconstruct(mp.read_capture(raw), 240), image=image.astype(np.float32))
    write_reconstruction(tmp_path / "out.exr", made)
    return tmp_path / "out.exr", made


def test_what_is_printed(refocused, run):
    path, made = refocused
    text = run("mtf", path)
    edge = r"^edge at row 29\.5, column 31\.\d+, 60 bins long, turned by 4.98 degrees from the columns$"
    assert re.search(edge, text, re.M)
    half = float(re.search(r"half the contrast at (\S+) cycles per bin", text)[1])
    assert f"{half / made.bin_size:.2g}" in text
    # A Gaussian of one bin, and the bin itself.
    known = np.exp(-2 * (np.pi * 0.25) ** 2) * np.sinc(0.25)
    assert float(re.search(r"^0\.25 cycles .* (\S+)$", text, re.M)[1]) == pytest.approx(known, abs=0.005)
    assert "edge at row 29.5" in run("mtf", path, "--region", "10,5,45,50")


def test_captures_are_refocused(raw, complaint):
    words = complaint("mtf", raw, "--distance", "240")
    assert words.startswith(f"{raw}: image") and "edge" in words
    assert "'capture'" in complaint("mtf", raw)


def test_regions_and_options_of_captures_are_refused(refocused, complaint):
    for text in ("1,2,3", "0,0,0,5", "0,0,61,5", "a,b,c,d", "-1,0,5,5"):
        assert f"--region {text}: " in complaint("mtf", refocused[0], f"--region={text}")
    assert "--method: " in complaint("mtf", refocused[0], "--method", "ray")


def test_captures_without_microlenses_are_measured_themselves(refocused, tmp_path, run, complaint):
    lens, path = {"focal_length": 50, "focus_distance": 300}, tmp_path / "photograph.exr"
    camera = mp.PlenopticCamera(mla_lattice="none", resolution=(60, 60), detector_width=6, **lens)
    mp.write_capture(path, mp.Capture(refocused[1].image, camera))
    text, pixel = run("mtf", path), 0.1 * 300 / camera.mla_distance
    half, per_mm = re.search(r"half the contrast at (\S+) cycles per bin, (\S+) per mm", text).groups()
    assert float(per_mm) == pytest.approx(float(half) / pixel, rel=0.01)
    assert float(half) == pytest.approx(float(re.search(r"at (\S+) cycles", run("mtf", refocused[0]))[1]), rel=1e-3)
    assert "mla_lattice = none" in complaint("mtf", path, "--distance", "300")
