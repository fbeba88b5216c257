"""The experiment behind the reports: kept stages, a run that is killed, verdicts, files."""

import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from PIL import Image
from refusals import refuses

from mitsuba_plenoptic import load_scene, read_capture, render_capture, scene_path, with_camera
from mitsuba_plenoptic.capture_spec import scene_fingerprint
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.extensions.paper import reproduction as reproductions
from mitsuba_plenoptic.extensions.paper.reproduction import processor_seconds, reproduce
from mitsuba_plenoptic.report import plots
from mitsuba_plenoptic.report.comparison import compare
from mitsuba_plenoptic.report.experiment import Settings
from mitsuba_plenoptic.report.photographs import pinhole_image, thin_lens_image


def files(folder):
    return {path.name: path.read_bytes() for path in (folder / "data").glob("*.exr")}


@pytest.mark.slow
def test_reproduce_writes_everything_and_then_keeps_it(
    quick_waves, coarse_figures, tiny, tmp_path, capsys, monkeypatch
):
    early, readings = [], reproductions.measure_readings

    def read_early(*given):
        early.append((tmp_path / "report.html").read_text())
        return readings(*given)

    monkeypatch.setattr(reproductions, "measure_readings", read_early)
    assert main(["reproduce", "-o", str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert {settings.parameters["lens_model"] for settings in reproductions.PRESETS.values()} == {"parabolic"}
    # Before the study there are the letters, refocused, and the paper's figures.
    assert early[0].count("<figure") == 5 and early[0].index("The letters refocused") < early[0].index("figure 1")
    assert "capture wave, 5 of 29 " in told.err and "partial 280, " in told.err and "reused" not in told.err
    assert "by construction Reconstructions by rays and by waves have the same number of pixels." in told.out
    names = "first fig1 fig2 fig3 fig4 methods interference captures answer"
    figures = {f"{name}.png" for name in names.split()}
    assert {path.name for path in tmp_path.iterdir()} == figures | {"data", "results.json", "report.html"}
    ray = read_capture(tmp_path / "data" / "capture_ray.exr")
    # All captures have the paper's lenses.
    assert ray.camera.lens_model == "parabolic"
    for name in ("wave", "points"):
        assert read_capture(tmp_path / "data" / f"capture_{name}.exr").camera == ray.camera
    # Both of its lenses are, not the microlenses alone.
    twin = with_camera(load_scene("letters", parameters=tiny.parameters), ray.camera)
    np.testing.assert_array_equal(ray.image, render_capture(twin, model="ray", spp=tiny.spp).image)
    assert read_capture(tmp_path / "data" / "capture_wave.exr").wavelength == 633

    before, report = files(tmp_path), (tmp_path / "report.html").read_bytes()
    results = json.loads((tmp_path / "results.json").read_text())
    quick_waves.clear()
    # Figures come from what is kept: they are the page's of before.
    monkeypatch.setattr(plots.Plot, "save", lambda self, path, dpi=None: None)
    again = reproduce(tmp_path)
    assert quick_waves == [] and files(tmp_path) == before
    assert json.loads(json.dumps(again)) == json.loads((tmp_path / "results.json").read_text()) == results
    assert (tmp_path / "report.html").read_bytes() == report

    # Both stand-ins of wave captures are the same.
    assert results["captures"]["points"] == {"relative_error": 0, "energy": 1}
    assert b"are confirmed with the preset quick." in report

    claims = {claim["statement"].split(":")[0]: claim for claim in results["claims"]}
    assert len(claims) == 15
    assert [(row["shape"], row["distance"]) for row in results["readings"]] == [("eight", 280), ("hash", 210)]
    assert claims["Partially coherent propagation strongly reduces the interference."]["verdict"] == "confirmed"
    assert claims["Without special optimization, reconstruction by rays takes 330 s."]["verdict"] == "differs"
    # The paper's condition at 280 mm: a blur of 0.714 mm over a pitch of 0.064 mm.
    four = claims["With four propagations the images of no two lit lenses of a subset overlap."]
    assert "every 12th lens at 280 mm, 144 propagations" in four["remark"]
    # Not of the paper's size, so no ratio of seconds.
    assert [row["paper_over_ours"] for row in results["timing"]] == [None, None, None]
    assert [row["paper_seconds"] for row in results["timing"]] == [330, 65, 195]

    # What another wavelength changes is made again.
    monkeypatch.setitem(reproductions.PRESETS, "quick", dataclasses.replace(tiny, wavelength=600.0))
    reproduce(tmp_path)
    assert {"capture_wave", "coherent_280"} <= set(quick_waves) and "capture_ray" not in quick_waves


@pytest.mark.slow
def test_compare_measures_the_charts_edges(quick_waves, tmp_path):
    results = compare(Settings("chart", {"resolution": "2048"}, spp=4, distances=(240.0,), truth_spp=64), tmp_path)
    assert {row["method"] for row in results["edges"]} >= {"truth", "ray", "coherent", "partial", "limit"}
    for row in results["edges"]:
        # In focus a bin of 0.128 mm is all the blur there is: 10 to 90 per cent in about 0.8 of it.
        assert row["width_mm"] == pytest.approx(0.8 * 0.128, rel=0.25)
    text = (tmp_path / "report.html").read_text()
    assert "Slanted edges" in text and "conclusions" not in text


def test_compare_refuses_what_it_cannot_compare(tmp_path):
    refuses("one colour", compare, Settings("letters", distances=(240.0,), variant="llvm_ad_rgb"), tmp_path / "out")
    refuses("at least one", compare, Settings("letters"), tmp_path / "out")
    refuses("distance = 50", compare, Settings("letters", distances=(240.0, 50.0)), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
    # The wall faces away from a camera behind it.
    behind = {"resolution": "64", "wall_distance": "-10"}
    refuses("black", compare, Settings("white", behind, spp=1, distances=(240.0,)), tmp_path / "out")


def test_a_scenes_fingerprint_knows_its_files(tmp_path):
    shutil.copytree(scene_path("letters").parent, tmp_path / "scenes")
    scene, mesh = tmp_path / "scenes" / "letters.xml", tmp_path / "scenes" / "meshes" / "f.ply"
    first = scene_fingerprint(scene, {})
    assert first == scene_fingerprint(scene_path("letters"), {})
    assert first != scene_fingerprint(scene, {"letter_scale": "0.5"})
    mesh.write_bytes(mesh.read_bytes() + b"\n")
    assert first != scene_fingerprint(scene, {})


def test_photographs_are_aligned_with_each_other(tiny):
    scene = load_scene("letters", parameters=tiny.parameters)
    camera = scene.sensors()[0].camera
    sharp = pinhole_image(scene, camera, 16, 256)
    lens = thin_lens_image(scene, camera, 240.0, 256)
    assert sharp.shape == lens.shape == (16, 16)
    # The F, in focus at 240 mm, is the same in both.
    middle = np.s_[5:11, 7:9]
    assert lens[middle] == pytest.approx(sharp[middle], abs=0.15)


@pytest.mark.slow
def test_processor_seconds_and_a_comparison_of_few_lenses(tmp_path, run):
    words = ["--distance", "240", "--spp", "2", "-D", "resolution=64", "-D", "detector_width=0.256"]
    assert "SSIM" in run("compare", "letters", "-o", tmp_path / "few", *words)
    numbers = json.loads((tmp_path / "few" / "results.json").read_text())
    assert all(row["ssim"] is None for row in numbers["reconstructions"])
    assert "not defined" in (tmp_path / "few" / "report.html").read_text()
    seconds = processor_seconds(read_capture(tmp_path / "few" / "data" / "capture_wave.exr"), 240.0)
    assert set(seconds) == {"ray", "coherent", "partial"}
    assert all(0 < value < 60 for value in seconds.values())


def test_mistakes_on_the_command_line(mistake):
    mistake("reproduce --preset quik -o {out}", "preset = 'quik'.*quick, paper")
    mistake("reproduce -o {raw}", "the folder cannot be made")


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
