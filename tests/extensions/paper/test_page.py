"""The report in a browser: it works by keyboard, loads nothing, fits narrow screens, and escapes what users name."""

import dataclasses
import json
import re

import pytest
from PIL import Image

from mitsuba_plenoptic import scene_path
from mitsuba_plenoptic.extensions.paper.reproduction import reproduce
from mitsuba_plenoptic.report import plots
from mitsuba_plenoptic.report.comparison import compare


def test_names_of_users_are_escaped(quick_waves, monkeypatch, tiny, tmp_path):
    monkeypatch.setattr(plots.Plot, "save", lambda self, path: Image.new("RGB", (4, 4)).save(path))
    scene = tmp_path / "a<b>&c.xml"
    folder = scene_path("letters").parent
    scene.write_text(scene_path("letters").read_text().replace("meshes/", f"{folder}/meshes/"))
    compare(dataclasses.replace(tiny, scene=str(scene), distances=(240.0,), slider=(), pdf=True), tmp_path / "out")
    assert len(list((tmp_path / "out").glob("*.pdf"))) == len(list((tmp_path / "out").glob("*.png"))) >= 3
    text = (tmp_path / "out" / "report.html").read_text()
    assert "<h1>Rays and waves: a&lt;b&gt;&amp;c</h1>" in text and "a<b>" not in text
    data = text.split('<script type="application/json" id="data">')[1].split("</script>")[0]
    assert json.loads(data)["refocus"]["distances"] == ["240 mm"]
    # What scripts look up by its name is there once.
    names = re.findall(r'\bid="([^"]+)"', text)
    assert len(names) == len(set(names)) and {"viewer", "swipe", "refocused", "distance"} <= set(names)


@pytest.mark.slow
def test_the_report_in_a_browser(quick_waves, tmp_path, browser):
    reproduce(tmp_path / "out")
    page = browser(tmp_path / "out" / "report.html")

    def find(selector):
        return page.find_element("css selector", selector)

    def refocused():
        return find("#refocused").get_attribute("src")

    # The slider, by keyboard.
    slider, first = find("#distance"), refocused()
    assert find("#distance-text").text == "210 mm"
    slider.send_keys("\ue014")  # arrow right
    assert find("#distance-text").text == slider.get_attribute("aria-valuetext") == "225 mm"
    assert refocused() != first
    # The choice of method.
    second = refocused()
    find("input[value=coherent]").send_keys(" ")
    assert refocused() != second
    assert "Coherent" in find("#refocused").get_attribute("alt")

    # The swipe and the zoom, by keyboard.
    swipe, upper = find("#swipe"), find(".upper")
    clip = upper.value_of_css_property("clip-path")
    swipe.send_keys("\ue014")
    assert upper.value_of_css_property("clip-path") != clip
    viewer, width = find("#viewer"), find("#viewer img").size["width"]
    viewer.send_keys("+")
    assert find("#viewer img").size["width"] > 1.3 * width
    viewer.send_keys("0")
    assert find("#viewer img").size["width"] == width
    find("[data-region='0']").click()
    assert "zoomed" in viewer.get_attribute("class")

    assert page.execute_script("return [...document.images].every((image) => image.complete && image.naturalWidth)")
    loaded = page.execute_script("return performance.getEntriesByType('resource').map((one) => one.name)")
    assert all(name.startswith("data:") for name in loaded)
    assert page.get_log("browser") == []

    for narrow in (320, 390, 768):
        page = browser(tmp_path / "out" / "report.html", width=narrow, height=800)
        assert page.execute_script("return document.documentElement.scrollWidth") <= narrow
        assert page.get_log("browser") == []
