"""What long computations print of their progress where there is no terminal."""

from __future__ import annotations

import re
import threading
import time

import pytest

from mitsuba_plenoptic import progress_bar
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.runtime import progress


@pytest.fixture
def often(monkeypatch):
    """Print lines as often as a test can wait for."""
    monkeypatch.setattr(progress, "FIRST_LINE", 0.001)
    monkeypatch.setattr(progress, "INTERVAL", 0.02)


def printed(capsys, pattern):
    """Wait until a line of this pattern is printed, and return all up to it."""
    said = ""
    for _ in range(500):
        said += capsys.readouterr().err
        if re.search(pattern, said, re.MULTILINE):
            return said
        time.sleep(0.02)
    raise AssertionError(f"{pattern} is not in {said}")


def test_lines_come_without_a_report_and_go_on_with_the_last_one(often, capsys):
    with progress_bar("Rendering") as bar:
        printed(capsys, r"^mitsuba-plenoptic: Rendering: \d+ s$")
        bar(1, 4)
        for _ in range(2):
            printed(capsys, r"^mitsuba-plenoptic: Rendering: 25 %, \d+ s$")
        with progress_bar("Loading"):
            printed(capsys, r"^mitsuba-plenoptic: Loading: \d+ s$")
        printed(capsys, r"^mitsuba-plenoptic: Rendering: 25 %, \d+ s$")
    assert bar.fraction == 0.25
    capsys.readouterr()
    time.sleep(0.1)
    assert capsys.readouterr().err == ""


def test_what_is_quick_prints_nothing(capsys):
    before = threading.active_count()
    with progress_bar("Rendering") as bar:
        bar(1, 1)
    assert capsys.readouterr().err == ""
    for _ in range(500):
        if threading.active_count() == before:
            return
        time.sleep(0.02)
    raise AssertionError("its thread is still there")


@pytest.mark.parametrize(
    ("line", "label"),
    [
        ("render letters -D resolution=64 --estimate", "Estimating"),
        ("render letters -D resolution=256 --spp 256 -o {out}.exr", "(Loading the scene|Rendering)"),
        ("sweep letters -D resolution=64 --spp 1 -o {out}.nc --vary aperture_radius=4,5", ".*(capture|starting).*"),
        ("info letters -D resolution=64", "info"),
    ],
)
def test_commands_print_lines_where_there_is_no_terminal(line, label, often, tmp_path, capsys):
    assert main(line.format(out=tmp_path / "out").split()) == 0
    assert re.search(rf"^mitsuba-plenoptic: {label}: ([\d.]+ %, )?\d+ s$", capsys.readouterr().err, re.MULTILINE)


def test_a_command_loads_no_other(python):
    code = """
    import sys
    from mitsuba_plenoptic.cli import main
    status = main(["render", "nosuch", "-o", "x.exr"])
    print(status, "xarray" in sys.modules, "mitsuba_plenoptic.cli.light_field" in sys.modules)
    """
    assert python(code).stdout == "2 False False\n"
