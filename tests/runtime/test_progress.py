"""What long computations print of their progress where there is no terminal."""

import functools
import re
import threading
import time
from unittest import mock

import drjit as dr
import pytest

from mitsuba_plenoptic import load_scene, progress_bar, render_capture
from mitsuba_plenoptic.cli.stopping import stage_lines
from mitsuba_plenoptic.runtime import batches, progress


@pytest.fixture
def often(monkeypatch):
    """Print lines as often as a test can wait for."""
    monkeypatch.setattr(progress, "FIRST_LINE", 0.001)
    monkeypatch.setattr(progress, "INTERVAL", 0.02)


def printed(capsys, pattern):
    """Wait until a line of this pattern is printed, and return all up to it."""
    said = ""
    for _ in range(5000):
        said += capsys.readouterr().err
        if re.search(pattern, said, re.MULTILINE):
            return said
        time.sleep(0.02)
    raise AssertionError(f"{pattern} is not in {said}")


def wait_for_threads(count):
    """Wait until only so many threads are left: the one that prints has ended."""
    end = time.monotonic() + 100
    while threading.active_count() > count:
        assert time.monotonic() < end, "its thread is still there"
        time.sleep(0.02)


def test_lines_come_without_a_report_and_go_on_with_the_last_one(often, capsys):
    before = threading.active_count()
    with progress_bar("Rendering") as bar:
        printed(capsys, r"^mitsuba-plenoptic: Rendering: \d+ s$")
        bar(1, 4)
        for _ in range(2):
            printed(capsys, r"^mitsuba-plenoptic: Rendering: 25 %, \d+ s$")
        with progress_bar("Loading"):
            printed(capsys, r"^mitsuba-plenoptic: Loading: \d+ s$")
        printed(capsys, r"^mitsuba-plenoptic: Rendering: 25 %, \d+ s$")
    assert bar.fraction == 0.25
    with progress_bar("Rendering") as bar:
        bar(0, 4)
        bar(1, 4)
        said = re.search(r"25 %, (\d+) s, about ([\d.]+) s left", printed(capsys, "left$"))
        elapsed, left = map(float, said.groups())
        assert 3 * (elapsed - 0.5) <= left <= 3 * (elapsed + 0.5)
    wait_for_threads(before)


def test_the_time_left_counts_from_the_start_of_a_stage(often, capsys, monkeypatch):
    now = time.monotonic
    with stage_lines(resume=False) as stages:
        stages.notify("first", 0, 0)
        monkeypatch.setattr(progress.time, "monotonic", lambda: now() + 3600)
        for done in (0, 1):
            stages.notify("second", done, 20)
        printed(capsys, r"second: 5 %, \d+ s, about [\d.]+ s left$")


def test_the_first_percentage_of_a_minute_of_work_says_what_makes_it_shorter(often, capsys, monkeypatch):
    monkeypatch.setattr(progress, "MINUTE", 0.0)
    with progress_bar("Rendering", "--spp 4 takes a quarter") as bar:
        printed(capsys, r"^mitsuba-plenoptic: Rendering: \d+ s$")
        bar(1, 100)
        printed(capsys, r"^mitsuba-plenoptic: Rendering: 1 %, \d+ s; --spp 4 takes a quarter$")
        assert "quarter" not in printed(capsys, r"^mitsuba-plenoptic: Rendering: 1 %, \d+ s$")
    monkeypatch.setattr(progress, "MINUTE", 1e9)
    with progress_bar("Rendering", "--spp 4 takes a quarter") as bar:
        bar(0, 100)
        bar(50, 100)
        assert "quarter" not in printed(capsys, r"^mitsuba-plenoptic: Rendering: 50 %, .*$")


@pytest.mark.parametrize(
    ("seconds", "told"),
    [
        ({part: 0.04 * part for part in range(101)}, []),
        ({part: 4.0 * part for part in range(101)}, [pytest.approx(400)]),
        # 100 s of plans and kernels, then a quarter in six seconds.
        ({0: 100.0, 50: 110.0, 75: 116.0, 80: 117.2}, [pytest.approx(122, rel=0.01)]),
        # Kernels are compiled in steps that say nothing of the speed.
        ({0: 0.0, 1: 1.0, 5: 9.0, 10: 10.0, 15: 11.0, 80: 24.0}, [pytest.approx(28)]),
        # An earlier run's half counts for nothing.
        ({50 + part: 1.0 + 4 * part for part in range(51)}, [pytest.approx(201)]),
    ],
)
def test_work_is_forecast_once_when_its_speed_is_known(monkeypatch, seconds, told):
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    found, shown = [], progress.ProgressBar("work")
    forecast = progress.Forecast(found.append, shown)
    for part, clock[0] in seconds.items():
        forecast(part, 100)
    assert found == told
    assert shown.fraction == max(seconds) / 100


def test_the_estimate_at_a_tenth_of_the_work_is_right_after_slow_plans(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    bar = progress.ProgressBar("Rendering")
    # Plans of 4 s count as a twentieth, then 100 s pass evenly, reported so often that reports are thinned.
    for part in range(1000):
        clock[0] = part / 50 * 4 if part < 50 else 4 + (part - 50) / 950 * 100
        bar(part, 1000)
        if part in (110, 500, 900):
            assert clock[0] + bar.left() == pytest.approx(104, rel=0.05)
    assert len(bar._reports) <= progress._REPORTS
    # A stage that is repeated goes back to any report.
    for _, fraction in list(bar._reports):
        bar(round(1000 * fraction), 1000)
        assert bar.left() == pytest.approx(0, abs=1)


def small_scene():
    return load_scene("letters", variant="llvm_ad_mono", parameters={"resolution": 128, "detector_width": 0.256})


def captured(scene, model, reports=None):
    """Return the image of a capture, whose fractions reported meanwhile are appended to a list."""
    shown = None if reports is None else lambda done, total: reports.append(done / total)
    return render_capture(scene, model=model, spp=64, progress=shown).image


@pytest.mark.parametrize(("model", "cores"), [("ray", 2), pytest.param("wave", 2, marks=pytest.mark.slow), ("ray", 1)])
def test_kernels_report_while_they_run_and_give_the_same_bits(monkeypatch, request, model, cores):
    monkeypatch.setattr(batches, "_LOOK", 0.001)
    if cores == 1:
        monkeypatch.setattr(batches, "worker_count", lambda: 1)
        request.addfinalizer(functools.partial(dr.set_thread_count, dr.thread_count()))
        dr.set_thread_count(1)
    scene, reports = small_scene(), []
    image = captured(scene, model, reports)
    assert (image == captured(scene, model)).all()
    assert reports == sorted(reports) and reports[-1] == 1
    assert len({round(fraction, 2) for fraction in reports if fraction < 1}) > 5


def test_what_a_report_raises_ends_the_work(monkeypatch):
    monkeypatch.setattr(batches, "_LOOK", 0.001)
    with pytest.raises(KeyboardInterrupt):
        captured(small_scene(), "ray", mock.Mock(append=mock.Mock(side_effect=KeyboardInterrupt)))


def test_plans_are_named_steps(often, capsys):
    with progress_bar("Rendering") as bar, progress.steps_counted(lambda done: bar(round(100 * done), 200), 4):
        for name in ("tables", "kernels"):
            progress.begin_step(name)
        printed(capsys, r"^mitsuba-plenoptic: Rendering: kernels, 12 %, \d+ s")
