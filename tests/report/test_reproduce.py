"""The experiment behind the reports: kept stages, a run that is killed, verdicts, files."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic import Capture, InputError, load_scene, read_capture, render_capture, scene_path, write_capture
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.io import checkpoints as checkpoints
from mitsuba_plenoptic.report import experiment as experiments
from mitsuba_plenoptic.report import reproduce as reproductions
from mitsuba_plenoptic.report.compare import compare
from mitsuba_plenoptic.report.experiment import Settings, run_experiment
from mitsuba_plenoptic.report.reference import pinhole_image, thin_lens_image
from mitsuba_plenoptic.report.reproduce import reproduce
from mitsuba_plenoptic.report.stage_store import StageStore, scene_fingerprint
from mitsuba_plenoptic.report.timing import seconds_on_one_core

TINY = {"resolution": "512", "detector_width": "1.024", "letter_scale": "0.125"}
SETTINGS = Settings("letters", (210.0, 240.0, 280.0), slider=(225.0,), parameters=TINY, spp=4, paths=1, truth_spp=64)


@pytest.fixture
def quick_waves(monkeypatch):
    """Stand in for the wave steps, which take long, by blurred rays; tells which stages were computed."""
    render, refocus = experiments.render_capture, experiments.reconstruct
    calls = []

    def render_capture(scene, *, model, spp, progress=None, **wave):
        calls.append(f"capture_{model}")
        capture = render(scene, model="ray", spp=spp, progress=progress)
        if model == "ray":
            return capture
        blurred = gaussian_filter(capture.image, 1.0)
        return Capture(blurred, capture.camera, wave["wavelength"], "wave", capture.metadata)

    def reconstruct(capture, distance, *, method, footprint="lens", interleave=None, progress=None):
        calls.append(f"{method}_{distance:g}")
        smooth = refocus(capture, distance, method="ray", footprint=footprint)
        if method == "ray" or interleave == "auto":
            return smooth
        point = refocus(capture, distance, method="ray", footprint="point")
        share = 1.0 if method == "coherent" else 0.25
        return dataclasses.replace(smooth, image=smooth.image + share * (point.image - smooth.image))

    monkeypatch.setattr(experiments, "render_capture", render_capture)
    monkeypatch.setattr(experiments, "reconstruct", reconstruct)
    monkeypatch.setattr(
        reproductions,
        "seconds_on_one_core",
        lambda capture, distance: {"ray": 0.5, "coherent": 5.0, "partial": 15.0},
    )
    monkeypatch.setitem(reproductions.PRESETS, "quick", SETTINGS)
    return calls


def files(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.exr")}


def test_reproduce_writes_everything_and_then_keeps_it(quick_waves, tmp_path):
    told = []
    results = reproduce(tmp_path, finished=lambda name, seconds, was_there: told.append((name, was_there)))
    names = {path.name for path in tmp_path.iterdir()}
    figures = {"fig2.png", "fig4.png", "methods.png", "interference.png", "captures.png"}
    assert names == figures | {"data", "results.json", "report.html"}
    assert not any(was_there for _, was_there in told)
    assert json.loads((tmp_path / "results.json").read_text()) == json.loads(json.dumps(results))
    assert read_capture(tmp_path / "data" / "capture_ray.exr").camera.lens_model == "parabolic"
    assert read_capture(tmp_path / "data" / "capture_wave.exr").wavelength == 633

    before, report = files(tmp_path / "data"), (tmp_path / "report.html").read_bytes()
    quick_waves.clear()
    told.clear()
    again = reproduce(tmp_path, finished=lambda name, seconds, was_there: told.append((name, was_there)))
    assert quick_waves == []
    assert all(was_there for _, was_there in told)
    assert files(tmp_path / "data") == before
    assert again == results
    assert (tmp_path / "report.html").read_bytes() == report


def test_a_killed_run_goes_on_and_gives_the_same_bits(quick_waves, tmp_path, monkeypatch):
    (tmp_path / "whole").mkdir()
    reproduce(tmp_path / "whole")

    working = experiments.reconstruct

    def killed(capture, distance, *, method, **options):
        if method == "coherent" and distance == 240:
            raise KeyboardInterrupt
        return working(capture, distance, method=method, **options)

    monkeypatch.setattr(experiments, "reconstruct", killed)
    with pytest.raises(KeyboardInterrupt):
        reproduce(tmp_path / "killed")
    monkeypatch.setattr(experiments, "reconstruct", working)
    done = len(files(tmp_path / "killed" / "data"))
    assert done > 10
    quick_waves.clear()
    reproduce(tmp_path / "killed")
    assert "capture_wave" not in quick_waves and "coherent_210" not in quick_waves
    assert quick_waves[0] == "coherent_240"
    assert files(tmp_path / "killed" / "data") == files(tmp_path / "whole" / "data")


def test_damaged_or_outdated_stages_are_made_again(quick_waves, tmp_path, monkeypatch):
    reproduce(tmp_path)
    whole = files(tmp_path / "data")
    damaged = tmp_path / "data" / "capture_wave.exr"
    damaged.write_bytes(damaged.read_bytes()[:1000])
    quick_waves.clear()
    reproduce(tmp_path)
    assert quick_waves == ["capture_wave"]
    assert files(tmp_path / "data") == whole

    monkeypatch.setitem(reproductions.PRESETS, "quick", dataclasses.replace(SETTINGS, radiators_per_lens=3))
    quick_waves.clear()
    reproduce(tmp_path)
    assert "capture_wave" in quick_waves and "capture_ray" not in quick_waves
    assert "coherent_280" in quick_waves


def test_claims_are_computed(quick_waves, tmp_path):
    results = reproduce(tmp_path)
    claims = {claim["statement"].split(":")[0]: claim for claim in results["claims"]}
    assert len(claims) == 7
    assert claims["Reconstructions by rays and by waves have the same number of pixels."]["verdict"] == "confirmed"
    assert claims["Partially coherent propagation removes the interference."]["verdict"] == "confirmed"
    assert claims["Reconstruction by waves is faster than by rays"]["verdict"] == "differs"
    assert claims["Partially coherent propagation takes four propagations"]["verdict"] == "confirmed"
    # The paper's condition at 280 mm: a blur of 0.714 mm over a pitch of 0.064 mm.
    four = claims["Four propagations, every second lens along each axis, suffice."]
    assert "every 12th lens, 144 propagations" in four["remark"]
    # Not of the paper's size, so no ratio of seconds.
    assert [row["paper_over_ours"] for row in results["timing"]] == [None, None, None]
    assert [row["paper_seconds"] for row in results["timing"]] == [330, 65, 195]


def test_compare_measures_the_charts_edges(quick_waves, tmp_path):
    settings = Settings("chart", (240.0,), parameters={"resolution": "2048"}, spp=4, paths=1, truth_spp=64)
    results = compare(settings, tmp_path)
    assert {row["method"] for row in results["edges"]} >= {"truth", "ray", "coherent", "partial", "limit"}
    for row in results["edges"]:
        # In focus a bin of 0.128 mm is all the blur there is: 10 to 90 per cent in about 0.8 of it.
        assert row["width_mm"] == pytest.approx(0.8 * 0.128, rel=0.25)
    text = (tmp_path / "report.html").read_text()
    assert "Slanted edges" in text and "conclusions" not in text


def test_compare_refuses_what_it_cannot_compare(tmp_path):
    with pytest.raises(InputError, match="one colour"):
        compare(Settings("letters", (240.0,), variant="llvm_ad_rgb"), tmp_path)
    with pytest.raises(InputError, match="at least one"):
        compare(Settings("letters", ()), tmp_path)
    with pytest.raises(InputError, match="no such file"):
        compare(Settings("nowhere.xml", (240.0,)), tmp_path)
    # The wall faces away from a camera behind it.
    behind = {"resolution": "256", "detector_width": "0.512", "wall_distance": "-10"}
    with pytest.raises(InputError, match="black"):
        compare(Settings("white", (240.0,), parameters=behind, spp=1), tmp_path)


def test_mistakes_on_the_command_line(tmp_path, capsys):
    assert main(["reproduce", "--preset", "huge", "-o", str(tmp_path)]) == 2
    assert capsys.readouterr().err == "mitsuba-plenoptic: error: preset = 'huge': it must be one of quick, paper\n"
    (tmp_path / "file").touch()
    assert main(["reproduce", "-o", str(tmp_path / "file")]) == 2
    assert "the folder cannot be made" in capsys.readouterr().err
    assert main(["compare", "letters", "-o", str(tmp_path), "--distance", "-1"]) == 2
    assert "distance = -1: it must be greater than 0" in capsys.readouterr().err


def test_the_command_tells_of_each_stage(quick_waves, tmp_path, capsys):
    assert main(["reproduce", "-o", str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert "capture wave " in told.err and "partial 280 " in told.err
    assert "confirmed  Reconstructions by rays and by waves have the same number of pixels." in told.out
    assert told.out.rstrip().endswith("report.html: open it in a browser")


def test_a_wave_capture_that_was_stopped_goes_on_in_its_midst(tmp_path, monkeypatch):
    """The stage's checkpoint, with waves that are real; what comes after the capture is left out."""

    class StoppedError(Exception):
        pass

    def stop(*_):
        raise StoppedError

    small = {"resolution": "256", "detector_width": "0.512", "letter_scale": "0.06"}
    settings = dataclasses.replace(SETTINGS, parameters=small, radiators_per_lens=3, spp=1)
    monkeypatch.setattr(checkpoints, "_SECONDS", 0.0)
    monkeypatch.setattr(checkpoints, "_SHARE", 1e9)
    monkeypatch.setattr(experiments, "pinhole_image", stop)
    write, progress = checkpoints._write, []

    def run(folder, **options):
        progress.clear()
        store = StageStore(folder, lambda *told: progress.append(told), **options)
        with pytest.raises(StoppedError):
            run_experiment(settings, store)
        # The radiators that were done when the capture began.
        return next((done for name, done, total in progress if name == "capture_wave" and total), None)

    assert run(tmp_path / "clean") == 0
    # The second checkpoint never takes the place of the first.
    monkeypatch.setattr(checkpoints, "_write", lambda *state: (write(*state), checkpoint.exists() and stop()))
    checkpoint = tmp_path / "stopped" / "capture_wave.checkpoint"
    assert run(tmp_path / "stopped") == 0
    assert checkpoint.exists() and not (tmp_path / "stopped" / "capture_wave.exr").exists()
    monkeypatch.setattr(checkpoints, "_write", write)
    other, settings = settings, dataclasses.replace(settings, wavelength=500.0)
    with pytest.raises(InputError, match="wavelength = 633 there, 500 here"):
        run(tmp_path / "stopped", resume=True)
    settings = other
    assert run(tmp_path / "stopped", resume=True) > 0
    assert not checkpoint.exists()
    wave = "capture_wave.exr"
    assert (tmp_path / "stopped" / wave).read_bytes() == (tmp_path / "clean" / wave).read_bytes()


def test_a_scenes_fingerprint_knows_its_files(tmp_path):
    shutil.copytree(scene_path("letters").parent, tmp_path / "scenes")
    scene, mesh = tmp_path / "scenes" / "letters.xml", tmp_path / "scenes" / "meshes" / "f.ply"
    first = scene_fingerprint(scene, {})
    assert first == scene_fingerprint(scene_path("letters"), {})
    assert first != scene_fingerprint(scene, {"letter_scale": "0.5"})
    mesh.write_bytes(mesh.read_bytes() + b"\n")
    assert first != scene_fingerprint(scene, {})


def test_a_store_tells_facts_from_one_run_to_the_next(tmp_path):
    made = []

    def make(_):
        made.append(1)
        return {"answer": 42}

    for _ in range(2):
        assert StageStore(tmp_path).facts("facts", {"a": 1}, make) == {"answer": 42}
    assert made == [1]
    StageStore(tmp_path).facts("facts", {"a": 2}, make)
    assert made == [1, 1]


def test_photographs_are_aligned_with_each_other():
    scene = load_scene("letters", parameters=TINY)
    camera = scene.sensors()[0].camera
    sharp = pinhole_image(scene, camera, 16, 256)
    lens = thin_lens_image(scene, camera, 240.0, 256)
    assert sharp.shape == lens.shape == (16, 16)
    # The F, in focus at 240 mm, is the same in both.
    middle = np.s_[5:11, 7:9]
    assert lens[middle] == pytest.approx(sharp[middle], abs=0.15)


@pytest.mark.slow
def test_seconds_on_one_core(tmp_path):
    capture = render_capture(load_scene("letters", parameters=TINY), spp=1)
    write_capture(tmp_path / "raw.exr", dataclasses.replace(capture, wavelength=633.0))
    seconds = seconds_on_one_core(tmp_path / "raw.exr", 280.0)
    assert set(seconds) == {"ray", "coherent", "partial"}
    assert all(0 < value < 60 for value in seconds.values())
    with pytest.raises(InputError, match=r"nowhere\.exr: there is no such file"):
        seconds_on_one_core(tmp_path / "nowhere.exr", 280.0)


@pytest.fixture
def browser(tmp_path):
    """Give a function that opens a page in a headless Chromium of some width, or skip where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    driver = shutil.which("chromedriver")
    if not program or not driver:
        pytest.skip("no Chromium with its chromedriver was found")
    opened = []

    def open_page(path, width=1280, height=900):
        options = webdriver.ChromeOptions()
        options.binary_location = program
        for argument in (
            "headless",
            "no-sandbox",
            "disable-gpu",
            "disable-quic",
            "no-first-run",
            "disable-background-networking",
            "disable-component-update",
            "disable-sync",
            f"user-data-dir={tmp_path / f'browser{len(opened)}'}",
        ):
            options.add_argument(f"--{argument}")
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        page = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
        opened.append(page)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 500}
        page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        page.get(path.as_uri())
        return page

    yield open_page
    for page in opened:
        page.quit()


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


@pytest.mark.slow
@pytest.mark.parametrize("width", [320, 390, 768])
def test_the_report_fits_narrow_screens(quick_waves, tmp_path, browser, width):
    reproduce(tmp_path / "out")
    page = browser(tmp_path / "out" / "report.html", width=width, height=800)
    assert page.execute_script("return document.documentElement.scrollWidth") <= width
    assert page.get_log("browser") == []


def test_a_refused_scene_leaves_no_folder(tmp_path):
    with pytest.raises(InputError, match="there is no such file"):
        compare(Settings(scene="nothere", distances=(240.0,)), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
