"""Pages of sections: what stands where, which cells stay empty, and what is escaped."""

from __future__ import annotations

import io
from html.parser import HTMLParser

from markupsafe import Markup
from PIL import Image

from mitsuba_plenoptic.report.pages import Page, Picture, Section, Table


class Reader(HTMLParser):
    """Texts of a page by the element that they stand in, and all addresses."""

    def __init__(self, page):
        super().__init__()
        self.texts, self.links, self.inside = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.inside.append(tag)
        self.links += [value for name, value in attributes if name in ("href", "src", "id")]

    def handle_endtag(self, tag):
        while self.inside and self.inside.pop() != tag:
            pass

    def handle_data(self, data):
        if data.strip():
            self.texts.append((self.inside[-1] if self.inside else "", data.strip()))


def test_a_page_has_its_sections_with_their_parts(tmp_path):
    picture = io.BytesIO()
    Image.new("L", (3, 2)).save(picture, format="PNG")
    table = Table(
        {"At": "{at:g} mm", "Name": "{name}", "Share": "{share:.0%}"},
        [{"at": 1, "name": "a", "share": 0.5}, {"at": 1, "name": "<b>"}, {"at": 2, "name": "c", "share": 0.25}],
        "What is seen.",
        words=2,
        grouped=True,
    )
    blocks = ['The "lens" isn\'t <thin>.', table, Picture(picture.getvalue(), "A field."), ["one"], Markup("<hr>")]
    Page("A & B", "In short.", [Section("In numbers", blocks)], foot="The end.").write(tmp_path / "page.html")
    page = Reader((tmp_path / "page.html").read_text())
    assert ("h1", "A & B") in page.texts and ("h2", "In numbers") in page.texts and ("li", "one") in page.texts
    assert ("p", "The “lens” isn\N{RIGHT SINGLE QUOTATION MARK}t <thin>.") in page.texts
    assert ("figcaption", "A field.") in page.texts
    assert [text for tag, text in page.texts if tag == "td"] == ["1 mm", "a", "50%", "<b>", "2 mm", "c", "25%"]
    assert "#section-in-numbers" in page.links and "section-in-numbers" in page.links
    # Nothing is loaded from elsewhere.
    assert all(link.startswith(("#", "data:", "section-in-numbers")) for link in page.links)
