"""Figures for papers: what is labelled, on which scale, and how long the bars are."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import decode
from mitsuba_plenoptic.report import plots
from mitsuba_plenoptic.views import depth_map, pick_views

CAMERA = mp.PlenopticCamera(detector_width=0.512, resolution=(128, 128))


def result(method="ray", distance=240.0, image=None):
    image = np.linspace(0, 1, 64, dtype=np.float32).reshape(8, 8) if image is None else image
    return mp.Reconstruction(image, distance, CAMERA.bin_size(distance), method, CAMERA)


@pytest.fixture(scope="module")
def lf():
    image = np.random.default_rng(0).random(CAMERA.shape, dtype=np.float32)
    return decode(mp.Capture(image, CAMERA))


def titles(figure):
    return [axes.get_title(loc="left") for axes in figure.axes]


def hatched(axes):
    return any(patch.get_hatch() for patch in axes.patches)


def test_methods_by_distances_on_one_scale(coarse_figures):
    results = [result("ray", 280.0), result("ray", 210.0), result("partial", 210.0)]
    figure = plots.contact_sheet(results, 0.5)
    *panels, bar = figure.axes
    assert panels[0].images[0].colorbar.extend == "max"
    assert titles(figure) == ["210 mm", "280 mm", "210 mm", "280 mm", ""]
    assert [axes.get_ylabel() for axes in panels] == ["ray", "", "partial", ""]
    assert [len(axes.images) for axes in panels] == [1, 1, 1, 0]
    assert [len(axes.patches) for axes in panels] == [1, 1, 1, 0]
    assert figure.get_supxlabel() == "bars: lengths at the distance of each image"
    assert (bar.get_ylabel(), bar.get_ylim()) == ("radiance", (0, 0.5))
    assert {axes.images[0].norm.vmax for axes in panels[:3]} == {0.5}
    # 1.055 x 0.5^(1/2.4) - 0.055 of white at half of it, as bright as in pictures.
    norm = panels[0].images[0].norm
    assert float(norm(0.25)) == pytest.approx(1.055 * 0.5 ** (1 / 2.4) - 0.055)
    assert float(norm.inverse(norm(0.2))) == pytest.approx(0.2)
    assert figure.get_size_inches()[0] == pytest.approx(3.4)
    assert Image.open(io.BytesIO(figure._repr_png_())).size[0] == 3.4 * 75
    refuses("results: give at least one", plots.contact_sheet, [])
    other = replace(results[0], camera=mp.PlenopticCamera())
    refuses("results: they must be by one camera", plots.contact_sheet, [results[0], other])


def test_captures_have_rows_of_their_own():
    by_model = [replace(result(distance=at), facts={"model": model}) for model in ("ray", "wave") for at in (210, 280)]
    panels = plots.contact_sheet([*by_model, by_model[0]]).axes[:-1]
    labels = [f"ray of {name}" for name in ("ray capture", "wave capture", "ray capture 2")]
    assert [axes.get_ylabel() for axes in panels[::2]] == labels
    assert [len(axes.images) for axes in panels] == [1, 1, 1, 1, 1, 0]
    panels = plots.contact_sheet([*by_model[:2], *by_model[:2]]).axes
    assert [panels[0].get_ylabel(), panels[2].get_ylabel()] == ["ray", "ray 2"]


@pytest.mark.parametrize("distance", [210.0, 280.0, np.inf])
def test_scale_bars_are_as_long_as_they_say(distance):
    (panel, _) = plots.contact_sheet([result(distance=distance)]).axes
    if distance == np.inf:
        assert not panel.patches and not panel.texts and panel.get_title(loc="left") == "infinity"
        return
    (bar,), (text,) = panel.patches, panel.texts
    assert bar.get_width() * 8 * CAMERA.bin_size(distance) == pytest.approx(float(text.get_text().split()[0]))
    assert text.get_text().endswith(" mm") and 0.1 < bar.get_width() <= 0.3


def test_depth_has_a_scale_in_millimetres_and_bars_that_are_lengths_in_focus(lf):
    found = depth_map(lf, 200, 300, planes=8)
    depth = np.full(found.depth.shape, 250.0)
    depth[0], depth[1] = np.nan, 230
    found["depth"] = found.depth.copy(data=depth)
    figure = plots.depth_figure(found)
    shown = {axes.get_title(loc="left"): axes for axes in figure.axes if axes.get_title(loc="left")}
    assert shown["Depth"].images[0].norm.vmin == 230 and shown["Depth"].images[0].norm.vmax == 250
    assert hatched(shown["Depth"]) and not hatched(shown["Confidence"])
    assert "mm from the main lens; hatched: unknown" in [axes.get_xlabel() for axes in figure.axes]
    assert len(shown) == 3
    for axes in shown.values():
        (text,) = axes.texts
        bar = next(patch for patch in axes.patches if not patch.get_hatch())
        length, words = text.get_text().split(maxsplit=1)
        assert words == "mm in the plane in focus"
        width = CAMERA.bin_count[0] * CAMERA.bin_size(CAMERA.focus_distance)
        assert bar.get_width() * width == pytest.approx(float(length), rel=1e-3)
    found["depth"] = found.depth.copy(data=np.full_like(depth, np.nan))
    assert hatched(plots.depth_figure(found).axes[1])


def test_what_is_not_known_is_hatched():
    image = np.ones((8, 8), np.float32)
    assert not hatched(plots.contact_sheet([result(image=image)]).axes[0])
    image[0, 0] = np.nan
    panel = plots.contact_sheet([result(image=image)]).axes[0]
    assert hatched(panel) and panel.images[0].get_array().mask.sum() == 1
    colours = np.repeat(image[..., None], 3, axis=2)
    figure = plots.contact_sheet([result(image=colours)], 0.75)
    assert figure.get_supxlabel() == "white: radiance 0.75\nbars: lengths at the distance of each image"
    panel = figure.axes[0]
    alpha = panel.images[0].get_array()[..., 3]
    assert hatched(panel) and alpha[0, 0] == 0 and alpha.sum() == 255 * 63


def test_views_lie_as_on_the_pupil_and_their_bar_below(lf):
    chosen = pick_views(lf, 3)
    *panels, _ = plots.views_figure(chosen).axes
    np.testing.assert_array_equal(panels[5].images[0].get_array(), chosen.values[1, 2])
    assert [axes.get_title(loc="left") for axes in panels[:2]] == [f"u = {float(chosen.u[0]):.2f} mm", "0.00"]
    assert panels[3].get_ylabel() == "0.00" and panels[0].get_ylabel().startswith("v = ")
    assert [len(axes.patches) for axes in panels] == [0] * 6 + [1, 0, 0]
    assert panels[6].texts[0].get_text().endswith("mm in the plane in focus, in all views")
    assert panels[6].patches[0].get_y() < 0


def test_files(tmp_path, coarse_figures):
    """A PDF is as wide as a column, 3.4 inches of 72 points, has its text as text, and is the same each time."""
    figure = plots.contact_sheet([result()])
    for name in ("a.pdf", "b.pdf"):
        plots.contact_sheet([result()]).save(tmp_path / name)
    data = (tmp_path / "a.pdf").read_bytes()
    assert data == (tmp_path / "b.pdf").read_bytes()
    assert b"/MediaBox [ 0 0 244.8 " in data and b"/FontFile2" in data
    figure.save(tmp_path / "a.png", dpi=100)
    assert Image.open(tmp_path / "a.png").size[0] == 3.4 * 100
    refuses(r"give a name that ends in \.png or \.pdf", figure.save, tmp_path / "a.svg")


def test_panels_are_of_one_size_and_no_text_is_cut():
    plot = plots.Plot(6.0, dpi=80)
    panels = plot.panels(2, 3, (0.5, 1.0))
    for axes in panels.flat:
        plots.show(axes, np.ones((4, 8)), "title")
        plots.annotate(axes, title="title", side="side" if axes is panels[0, 0] else "", foot="foot")
        plots.scale_bar(axes, 4.0, below=True)
    plot.colour_bar(panels[0, 0].images[0], panels, "label")
    image = Image.open(io.BytesIO(plot.png()))
    boxes = [[axes.get_window_extent() for axes in row] for row in panels]
    for row, aspect in zip(boxes, (0.5, 1.0), strict=True):
        assert [box.width for box in row] == pytest.approx([boxes[0][0].width] * 3, rel=0.01)
        assert [box.height / box.width for box in row] == pytest.approx([aspect] * 3)
    seen = plot.get_tightbbox()
    assert seen.x0 >= 0 and seen.y0 >= 0 and seen.x1 <= 6 and 80 * seen.y1 <= image.height
    # What is not needed is taken off.
    assert image.width == 480 and image.height < 1.1 * 80 * seen.height
