"""The check of the site finds its faults; the gallery is complete."""

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def check():
    return runpy.run_path(str(ROOT / "tools" / "check_site.py"))


def test_broken_links_are_found(check, tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "a.html").write_text('<h1 id="top">A</h1><a href="sub/b.html#here">b</a><a href="https://x.org">x</a>')
    picture = '<img alt="b" src="data:image/png;base64,">'
    (tmp_path / "sub" / "b.html").write_text(f'<p id="here"><a href="../a.html#top">a</a>{picture}')
    assert check["broken_links"](tmp_path) == []
    (tmp_path / "c.html").write_text(
        '<a href="a.html#no">1</a><a href="no.html">2</a><img src="a.html"><script src="https://x.org/y.js">'
    )
    found = check["broken_links"](tmp_path)
    assert [text.split(": ", 1)[1] for text in found] == [
        "a.html: a picture without a text",
        "a.html#no: there is no such place",
        "no.html: there is no such file",
        "it loads https://x.org/y.js",
    ]


def test_every_notebook_has_a_card_with_a_picture_and_a_download():
    gallery = ROOT / "docs" / "guides" / "gallery"
    index = (gallery / "index.md").read_text()
    for page in sorted(set(gallery.glob("*.md")) - {gallery / "index.md"}):
        assert f":link: {page.stem}\n" in index and f"thumbnails/{page.stem}.png" in index
        assert (ROOT / "docs" / "pictures" / "thumbnails" / f"{page.stem}.png").is_file()
        assert f"{{nb-download}}`Download this notebook <{page.stem}.ipynb>`" in page.read_text()
