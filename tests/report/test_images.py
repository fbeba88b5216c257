"""Pictures: tone, scale, and nothing half-written."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.report.images import shrink, write_png
from mitsuba_plenoptic.report.output_files import reconstruction_paths


@pytest.mark.parametrize(
    ("pixels", "peak", "expected"),
    [
        # 12.92 x 0.001 and 1.055 x 0.5^(1/2.4) - 0.055, times 255
        ([[0.0, 0.001, 0.5, 1.0, 2.0, -1.0]], 1, [[0, 3, 188, 255, 255, 0]]),
        ([[0.0, 7.0]], None, [[0, 255]]),
        ([[[1.0, 0.0, 0.0]]], None, [[[255, 0, 0]]]),
        ([[0.0, 0.0]], None, [[0, 0]]),
        ([[np.nan, np.inf, 1.0]], None, [[0, 0, 255]]),
    ],
    ids=["encoding", "peak", "colour", "black", "not finite"],
)
def test_pictures(tmp_path, pixels, peak, expected):
    write_png(tmp_path / "a.png", np.array(pixels), peak=peak)
    assert np.array(Image.open(tmp_path / "a.png")).tolist() == expected


def test_failure_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.png"
    write_png(path, np.ones((2, 2)))
    before = path.read_bytes()
    with pytest.raises(TypeError):
        write_png(path, np.ones((2, 2, 7)))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_shrink_averages_whole_blocks():
    image = np.arange(36, dtype=np.float32).reshape(6, 6)
    assert shrink(image, 6) is image
    assert shrink(image, 3).tolist() == [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5], [27.5, 29.5, 31.5]]
    assert shrink(np.ones((10, 7, 3)), 4).shape == (3, 2, 3)
    assert shrink(np.ones((1, 100)), 10).shape == (1, 10)


def test_names_for_several_distances(tmp_path):
    names = [path.name for path in reconstruction_paths(tmp_path / "a.b.png", [210, 240.25])]
    assert names == ["a.b_210.png", "a.b_240.25.png"]
    assert reconstruction_paths(tmp_path / "a.EXR", [240]) == [tmp_path / "a.EXR"]


@pytest.mark.parametrize(
    ("name", "distances"), [("a.tif", [240]), ("a.png", [240, 240.0]), ("missing/a.png", [240, 210])]
)
def test_refused_names(name, distances, tmp_path):
    with pytest.raises(InputError):
        reconstruction_paths(tmp_path / name, distances)
