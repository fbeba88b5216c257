"""Pages of sections: what stands where, which cells stay empty, and what is escaped."""

from __future__ import annotations

import html
import io
import re

import pytest
from markupsafe import Markup
from PIL import Image

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.io.cache import StageOptions
from mitsuba_plenoptic.report import experiment
from mitsuba_plenoptic.report.comparison import compare
from mitsuba_plenoptic.report.experiment import Settings, methods_of_both
from mitsuba_plenoptic.report.pages import Page, Picture, Section, Table


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
    page = (tmp_path / "page.html").read_text()
    texts = [(tag, html.unescape(text)) for tag, text in re.findall(r"<(\w+)[^>]*>\s*([^<\s][^<]*?)\s*(?=<)", page)]
    links = re.findall(r' (?:href|src|id)="?([^" >]*)', page)
    assert {("h1", "A & B"), ("h2", "In numbers"), ("li", "one"), ("figcaption", "A field.")} < set(texts)
    assert ("p", "The “lens” isn\N{RIGHT SINGLE QUOTATION MARK}t <thin>.") in texts
    assert [text for tag, text in texts if tag == "td"] == ["1 mm", "a", "50%", "<b>", "2 mm", "c", "25%"]
    assert {"#section-in-numbers", "section-in-numbers"} < set(links)
    # Nothing is loaded from elsewhere.
    assert all(link.startswith(("#", "data:", "section-in-numbers")) for link in links)


@pytest.mark.parametrize(
    ("pitch", "spp", "rule"),
    [
        # Spots of 6 um on pixels of 62 um, and on pixels of 2.5 um behind lenses of 20 um.
        pytest.param(0.5, 64, r"rays suffice .* raw pixels \(\d.\d% at most\) is below", marks=pytest.mark.slow),
        pytest.param(0.02, 64, r"by -2\d%. Waves change raw pixels by 7\d.\d%", marks=pytest.mark.slow),
        (0.5, 2, r"noise hides .* below the noise of 2 samples \(5\d.\d%\); \d\d samples would"),
    ],
    ids=["spots below a pixel", "diffraction", "noise"],
)
def test_a_comparison_says_whether_rays_suffice(pitch, spp, rule, tmp_path, monkeypatch, caplog, coarse_figures):
    monkeypatch.setattr(experiment, "OBJECT_COLUMNS", 32)
    lenses = {"mla_pitch": pitch, "mla_focal_length": 8 * pitch}
    camera = mp.PlenopticCamera(**lenses, detector_width=32 * pitch, resolution=(256, 256))
    size = {"camera": camera.to_dict(), "parameters": {"letter_scale": str(4 * pitch)}, "distances": (240.0,)}
    spent = {"methods": methods_of_both(["ray"]), "spp": spp, "truth_spp": 4 * spp, "noise": True, "pdf": False}
    settings = Settings("letters", **size, **spent)
    stages = []
    with caplog.at_level("INFO", "mitsuba_plenoptic"):
        results = compare(settings, tmp_path, stages=StageOptions(finished=lambda name, *_: stages.append(name)))
    assert re.search(rule, results["answer"])
    assert caplog.messages[0].startswith("roughly, on two cores: captures ")
    assert stages[0] == "capture_ray, 1 of 6" and stages[-1] == "thin_lens_240, 6 of 6"
    # The picture that shows it stands below, and one distance has no slider.
    page = (tmp_path / "report.html").read_text()
    parts = results["answer"][:20], "What waves change at 240 mm", 'id="section-on-the-detector'
    answer, change, detector = map(page.index, parts)
    assert answer < change < detector
    assert re.search(r'id="distance" [^>]* hidden>', page) and 'class="ends"' not in page
