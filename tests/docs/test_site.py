"""What checks the site finds its faults, and the notebooks' panels show what their sliders choose."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.io.captures import Capture

ROOT = Path(__file__).parents[2]


@pytest.fixture
def check():
    return runpy.run_path(str(ROOT / "tools" / "check_site.py"))


def test_broken_links_are_found(check, tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.html").write_text('<h1 id="top">A</h1><a href="sub/b.html#here">b</a><a href="https://x.org">x</a>')
    (tmp_path / "sub" / "b.html").write_text(
        '<p id="here"><a href="../a.html#top">a</a><img src="data:image/png;base64,">'
    )
    assert check["broken_links"](tmp_path) == []
    (tmp_path / "c.html").write_text(
        '<a href="a.html#no">1</a><a href="no.html">2</a><script src="https://x.org/y.js">'
    )
    found = check["broken_links"](tmp_path)
    assert [text.split(": ", 1)[1] for text in found] == [
        "a.html#no: there is no such place",
        "no.html: there is no such file",
        "it loads https://x.org/y.js",
    ]


def test_words_that_search_does_not_find(check, tmp_path):
    index = '{"docnames":["reference/conventions","models"],"terms":{"wavelength":0,"mirror":[0,1]},"titleterms":{}}'
    (tmp_path / "searchindex.js").write_text(f"Search.setIndex({index})")
    found = {text.split(": ")[1] for text in check["missing_words"](tmp_path)}
    assert found == set(check["ASKED"]) - {"wavelength", "mirror"}


@pytest.fixture
def panels(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "gallery"))
    return __import__("panels")


def test_inspector_shows_the_micro_image_of_each_lens(panels):
    camera = PlenopticCamera(detector_width=0.256, resolution=(128, 128))
    rows, columns = camera.lens_count[1], camera.lens_count[0]
    # Each pixel has the number of its lens, that of the cell that its chief ray meets.
    scale = camera.mla_distance / (camera.mla_distance + camera.detector_distance)
    x, y = (camera.pixel_coordinates(axis) * scale for axis in (0, 1))
    i, j = camera.lattice.cell(x[None, :], y[:, None])
    image = (i + columns // 2) + columns * (j + rows // 2) + 0 * (x[None, :] + y[:, None])
    panel = panels.micro_image_inspector(Capture(image, camera), range(rows), range(columns))
    middles = [np.median(np.asarray(panels.Image.open(panels.io.BytesIO(picture)))) for picture in panel.pictures]
    assert len(middles) == rows * columns and np.all(np.diff(middles) > 0)
    html = panel.html()
    assert html.count("<img") == len(middles) and html.count(" hidden") == len(middles) - 1 and "http" not in html


def test_widget_shows_what_the_html_does(panels):
    pytest.importorskip("ipywidgets")
    panel = panels.Panel(["a", "b"], [["1", "2"], ["x", "y", "z"]], [bytes([number]) for number in range(6)])
    first, second, shown = panel.widget().children
    first.value, second.value = 1, 2
    assert shown.value == bytes([5])
