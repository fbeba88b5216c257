"""The check of the site finds its faults; the gallery is complete; pictures are small."""

import json
import re
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


def test_words_that_search_does_not_find(check, tmp_path):
    terms = {"wavelength": 0, "mirror": [0, 1]}
    index = {"docnames": ["reference/conventions", "reference/models"], "terms": terms, "titleterms": {}}
    (tmp_path / "searchindex.js").write_text(f"Search.setIndex({json.dumps(index)})")
    found = {text.split(": ")[1] for text in check["missing_words"](tmp_path)}
    assert found == set(check["ASKED"]) - {"wavelength", "mirror"}


def test_every_notebook_has_a_card_with_a_picture_and_a_download():
    gallery = ROOT / "docs" / "guides" / "gallery"
    index = (gallery / "index.md").read_text()
    for page in sorted(set(gallery.glob("*.md")) - {gallery / "index.md"}):
        assert f":link: {page.stem}\n" in index and f"thumbnails/{page.stem}.png" in index
        assert (ROOT / "docs" / "pictures" / "thumbnails" / f"{page.stem}.png").is_file()
        assert f"{{nb-download}}`Download this notebook <{page.stem}.ipynb>`" in page.read_text()


def links(page):
    """Return the pages to which a page leads, by its links and cards; a place in a page counts as the page."""
    text = page.read_text()
    found = re.findall(r"\]\(([^)#\s]+)[^)]*\)", text)
    found += [f"{name}.md" for name in re.findall(r"^:link: (\S+)$", text, flags=re.MULTILINE)]
    return {(page.parent / name).resolve() for name in found}


QUESTIONS = [
    ("How do I install it and take a first picture?", "start/index.md", None),
    ("Does it simulate the camera that I have: focused, with several focal lengths?", "guides/focused.md", None),
    ("How do I capture a scene of my own with good values?", "start/own_scene.md", "guides/index.md"),
    ("How long does a capture take, and how do I divide a long one?", "guides/long_runs.md", "guides/index.md"),
    ("How do I read pictures of a real camera?", "guides/exchange.md#raw-pictures-of-real-cameras", "guides/index.md"),
    ("How do I cite it, and on which work is it based?", "theory/sources.md#citing", None),
]
"""Questions of readers, the page or section that answers each, and the page between it and the start page, if any."""


@pytest.mark.parametrize("question, answer, between", QUESTIONS)
def test_questions_of_readers_are_answered_within_two_clicks(question, answer, between):
    docs = ROOT / "docs"
    page, _, place = answer.partition("#")
    target, start = (docs / page).resolve(), docs / "index.md"
    first = (docs / between).resolve() if between else start
    assert target in links(first)
    assert not between or first in links(start)
    titles = {re.sub(r"\W+", "-", title.lower()) for title in re.findall(r"^#+ (.*)$", target.read_text(), re.M)}
    assert not place or place in titles


def test_pictures_of_pages_are_small():
    assert [path for path in (ROOT / "docs" / "pictures").rglob("*.png") if path.stat().st_size > 150_000] == []
