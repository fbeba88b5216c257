"""The comparison of two versions, given stand-ins for them that copy files made beforehand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import compare_versions
import numpy as np
import OpenEXR
import pytest

# Writes the same pixels whatever it renders or refocuses, but only from a capture that is there.
STAND_IN = """#!/bin/sh
case "$1" in render) ;; reconstruct) [ -f "$2" ] || exit 4 ;; *) echo "stand-in 1.0"; exit 0 ;; esac
while [ "$1" != "-o" ]; do shift; done
cp "$(dirname "$0")/pixels.exr" "$2"
"""
FAILING = """#!/bin/sh
[ "$1" = reconstruct ] || exec "{stand_in}" "$@"
echo "a remark" >&2
echo "mitsuba-plenoptic: error: no light" >&2
exit 3
"""


def environment(folder: Path, pixels: np.ndarray, script: str = STAND_IN) -> Path:
    """Make an environment whose command writes these pixels."""
    (folder / "bin").mkdir(parents=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": pixels}).write(str(folder / "bin" / "pixels.exr"))
    command = folder / "bin" / "mitsuba-plenoptic"
    command.write_text(script)
    command.chmod(0o755)
    return folder


@pytest.fixture
def compare(monkeypatch, capfd):
    """Run the tool within the tests' process."""

    def compare(*arguments: object) -> subprocess.CompletedProcess[str]:
        monkeypatch.setattr(sys, "argv", ["compare_versions", *map(str, arguments)])
        capfd.readouterr()
        status = compare_versions.main()
        return subprocess.CompletedProcess(sys.argv, status, *capfd.readouterr())

    return compare


@pytest.fixture
def pixels() -> np.ndarray:
    return np.linspace(0.5, 1, 64, dtype=np.float32).reshape(8, 8)


@pytest.fixture
def old(tmp_path, pixels) -> Path:
    return environment(tmp_path / "old", pixels)


def test_equal_versions_have_the_same_bits(tmp_path, compare, old, pixels):
    new = environment(tmp_path / "new", pixels)
    table = tmp_path / "tables" / "out.md"
    done = compare(old, new / "bin" / "mitsuba-plenoptic", "--only", "letters", "help", "--pairs", "2", "-o", table)
    assert done.returncode == 0, done.stderr
    assert done.stdout == table.read_text()
    assert done.stdout.count("| 0 | 0 | same bits |") == 8
    assert "| letters | wave-auto.exr | 0 | 0 | same bits |" in done.stdout
    assert "| help |" in done.stdout
    assert "stand-in 1.0" in done.stdout


@pytest.mark.parametrize(("change", "verdict", "status"), [(1e-6, "<= 1e-5", 0), (1e-3, "differs", 1)])
def test_what_differs_is_judged_by_the_tolerance(tmp_path, compare, old, pixels, change, verdict, status):
    changed = pixels.copy()
    changed[-1, -1] += change
    done = compare(old, environment(tmp_path / "new", changed), "--only", "raytrix")
    assert done.returncode == status, done.stderr
    rows = [line.split(" | ") for line in done.stdout.splitlines() if line.startswith("| raytrix")]
    assert len(rows) == 8
    assert all(row[-1] == f"{verdict} |" for row in rows)
    # relative to the largest value, which is 1
    assert float(rows[0][3]) == pytest.approx(change, rel=0.1)


def test_another_size_and_nan_differ(tmp_path, compare, old, pixels):
    damaged = pixels.copy()
    damaged[0, 0] = np.nan
    for name, other in (("size", pixels[:4]), ("nan", damaged)):
        done = compare(old, environment(tmp_path / name, other), "--only", "letters", "--tolerance", "1e9")
        assert done.returncode == 1, done.stderr
        assert done.stdout.count("| differs |") == 8


def test_a_command_that_fails_is_told_in_one_line(tmp_path, compare, old, pixels):
    script = FAILING.format(stand_in=old / "bin" / "mitsuba-plenoptic")
    done = compare(old, environment(tmp_path / "new", pixels, script), "--only", "letters")
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith("compare_versions: error: new: mitsuba-plenoptic reconstruct ")
    assert last.endswith(": mitsuba-plenoptic: error: no light")
    assert "Traceback" not in done.stderr


def test_an_environment_without_the_command_is_told_in_one_line(tmp_path, compare, old):
    done = compare(old, tmp_path / "nowhere", "--only", "letters")
    assert done.returncode == 2
    assert done.stderr == f"compare_versions: error: new: {tmp_path / 'nowhere'}: there is no mitsuba-plenoptic\n"
