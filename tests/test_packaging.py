"""What a wheel would hold, and what make needs."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

import mitsuba_plenoptic

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
FOLDERS = PROJECT["tool"]["setuptools"]["package-dir"]


def folder_of(package):
    """Folder of a package as setuptools' package-dir maps it."""
    parts = package.split(".")
    for length in range(len(parts), 0, -1):
        if (start := FOLDERS.get(".".join(parts[:length]))) is not None:
            return ROOT.joinpath(start, *parts[length:])
    return ROOT.joinpath(*parts)


def test_every_package_is_listed():
    listed = {folder_of(package) for package in PROJECT["tool"]["setuptools"]["packages"]}
    found = {path.parent for top in ("mitsuba_plenoptic", "scenes") for path in (ROOT / top).rglob("__init__.py")}
    assert listed == found


@pytest.mark.parametrize("package", PROJECT["tool"]["setuptools"]["package-data"])
def test_data_files_are_packed(package):
    patterns = PROJECT["tool"]["setuptools"]["package-data"][package]
    folder = folder_of(package)
    packed = {path for pattern in patterns for path in folder.glob(pattern)}
    present = {path for path in folder.iterdir() if path.is_file() and path.suffix != ".py"}
    assert packed == present


def test_versions_agree():
    assert mitsuba_plenoptic.__version__ == version("mitsuba-plenoptic")
    coming = PROJECT["tool"]["setuptools_scm"]["fallback_version"].removesuffix(".dev0")
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), flags=re.MULTILINE)[1]
    heads = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert cited == coming and coming in heads


def test_readme_links_work_in_the_repository_and_on_a_package_index():
    text = (ROOT / "README.md").read_text()
    relative = re.findall(r"\]\((?!https?://)([^)#]+)\)", text)
    assert relative and all((ROOT / link).is_file() for link in relative)
    absolute = runpy.run_path(str(ROOT / "setup.py"))["with_absolute_links"](text, "https://example.org/here")
    assert "](https://example.org/here/raw/main/docs/reconstructions.png)" in absolute
    assert re.findall(r"\]\((?!https?://)[^)]*\)", absolute) == []
    assert "(https://mitsuba-renderer.org)" in absolute


def test_the_start_page_can_be_run_from_the_page():
    tool = runpy.run_path(str(ROOT / "tools" / "check_release.py"))
    text = (ROOT / "docs" / "start.md").read_text()
    commands, files = tool["page_commands"](text), tool["page_files"](text)
    asked = " ".join(commands)
    assert all(word in asked for word in ("pip install", "doctor", "--model wave", "reconstruct", "depth", "python "))
    # What the commands name is on the page, or made by one before.
    made = {word for command in commands for word in re.findall(r"-o (\S+)", command)}
    named = {word for command in commands for word in re.findall(r"[\w.]+\.(?:xml|json|py|exr)", command)}
    assert named <= made | set(files) and set(files) <= named


def test_make_help_names_every_target():
    result = subprocess.run(["make", "help"], capture_output=True, text=True, check=True, cwd=ROOT)
    targets = re.search(r"^\.PHONY: help (.*)$", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1].split()
    # What others need first is made by itself.
    assert set(re.findall(r"^make (\w+) ", result.stdout, flags=re.MULTILINE)) == set(targets) - {"llvm"}


def test_the_readme_gets_the_measured_coverage():
    tool = runpy.run_path(str(ROOT / "tools" / "show_coverage.py"))
    text = "before <!-- coverage -->old<!-- /coverage --> after"
    assert tool["with_figure"](text, 93.6) == "before <!-- coverage -->94 %<!-- /coverage --> after"
    assert tool["with_figure"]("no mark", 93.6) == "no mark"


def test_large_libraries_wait_until_they_are_used():
    """What takes most of a second to import, and what many programs never need."""
    later = "distributed", "matplotlib", "scipy.fft", "scipy.signal", "scipy.sparse", "skimage", "xarray"
    code = f"import mitsuba_plenoptic, sys; print(*sys.modules.keys() & {later})"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == []
    assert mitsuba_plenoptic.decode is mitsuba_plenoptic.lightfield.decode
    assert all(hasattr(mitsuba_plenoptic, name) for name in mitsuba_plenoptic.__all__)


class TestFindPython:
    """`tools/find_python.sh` with a PATH of scripts that stand for Pythons."""

    def find(self, tmp_path, *programs):
        for index, (name, text) in enumerate(programs):
            # Each in a folder of its own, in this order on PATH.
            program = tmp_path / str(index) / name
            program.parent.mkdir()
            program.write_text(f"#!/bin/sh\n{text}\n")
            program.chmod(0o755)
        path = os.pathsep.join(str(tmp_path / str(index)) for index in range(len(programs)))
        script = ROOT / "tools" / "find_python.sh"
        return subprocess.run(["/bin/sh", str(script)], capture_output=True, text=True, check=False, env={"PATH": path})

    def test_newest_that_runs(self, tmp_path):
        programs = (("python3", 0), ("python3.11", 0), ("python3.12", 0), ("python3.13", 1))
        result = self.find(tmp_path, *((name, f"exit {status}") for name, status in programs))
        assert result.stdout == f"{tmp_path}/2/python3.12\n"

    def test_a_shim_that_fails_does_not_hide_the_real_one(self, tmp_path):
        result = self.find(tmp_path, ("python3", "exit 127"), ("python3", "exit 0"))
        assert result.stdout == f"{tmp_path}/1/python3\n"

    def test_none(self, tmp_path):
        result = self.find(tmp_path, ("python3", "exit 1"))
        assert (result.returncode, result.stdout) == (1, "")
        assert "Python 3.11" in result.stderr
