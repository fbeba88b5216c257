"""What a wheel would hold, and what make needs."""

import os
import re
import runpy
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import mitsuba_plenoptic

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGE = ROOT / "mitsuba_plenoptic"


def test_every_folder_with_code_is_a_package():
    """The build finds packages by their ``__init__.py``."""
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_no_link_is_among_the_files_of_the_package():
    """Builds take a link that git tracks for a file of data, and fail where it leads to a folder."""
    assert [path for top in (PACKAGE, ROOT / "scenes") for path in top.rglob("*") if path.is_symlink()] == []


@pytest.mark.parametrize(
    "package, folder", [("mitsuba_plenoptic", PACKAGE), ("mitsuba_plenoptic.scenes", ROOT / "scenes")]
)
def test_data_files_are_packed(package, folder):
    packed = {
        path for pattern in PROJECT["tool"]["setuptools"]["package-data"][package] for path in folder.glob(pattern)
    }
    present = {path for path in folder.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert packed == present


def test_distributions_without_a_file_of_the_repository_are_refused(tmp_path):
    tool = runpy.run_path(str(ROOT / "tools" / "check_release.py"))
    tracked = ["mitsuba_plenoptic/__init__.py", "scenes/a.xml", "tests/test_a.py", "README.md", ".gitignore"]
    installed = ["mitsuba_plenoptic/__init__.py", "mitsuba_plenoptic/scenes/a.xml", "p-1.dist-info/METADATA"]

    def wheel(name, files):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            for file in files:
                archive.writestr(file, "")
        return tmp_path / name

    def sdist(name, files):
        with tarfile.open(tmp_path / name, "w:gz") as archive:
            for file in files:
                archive.addfile(tarfile.TarInfo(f"p-1/{file}"))
        return tmp_path / name

    whole, source = wheel("whole.whl", installed), sdist("whole.tar.gz", [*tracked[:-1], "PKG-INFO"])
    tool["check_files"](tracked, whole, source, whole)
    without_scene, without_test = wheel("less.whl", installed[::2]), sdist("less.tar.gz", [*tracked[:2], "README.md"])
    for given, message in [
        ((without_scene, source, whole), "less.whl: .*missing .*scenes/a.xml"),
        ((whole, without_test, whole), "less.tar.gz: .*missing .*test_a.py"),
        ((whole, source, without_scene), "whole.whl: built from the sdist it has other files"),
    ]:
        with pytest.raises(SystemExit, match=message):
            tool["check_files"](tracked, *given)


def test_versions_agree():
    """The newest release is cited and described by the CHANGELOG; the package has it, or is on the way to the next."""
    stated = PROJECT["project"]["version"]
    assert mitsuba_plenoptic.__version__ == version("mitsuba-plenoptic") == stated
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), flags=re.MULTILINE)[1]
    heads = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert heads[:2] == ["Unreleased", cited]
    release, _, development = stated.partition(".dev")
    numbers = [[int(number) for number in each.split(".")] for each in (release, cited)]
    assert numbers[0] > numbers[1] if development else stated == cited


def test_readme_links_work_in_the_repository_and_on_a_package_index():
    text = (ROOT / "README.md").read_text()
    relative = re.findall(r"\]\((?!https?://)([^)#]+)\)", text)
    assert relative and all((ROOT / link).is_file() for link in relative)
    absolute = runpy.run_path(str(ROOT / "setup.py"))["with_absolute_links"](text, "https://example.org/here")
    assert "](https://example.org/here/raw/main/docs/pictures/reconstructions.png)" in absolute
    assert re.findall(r"\]\((?!https?://)[^)]*\)", absolute) == []
    assert "(https://mitsuba-renderer.org)" in absolute


def test_pages_state_the_addresses_of_the_package_and_no_others():
    """Without an address in pyproject.toml, no page has one to clone from or to read at."""
    known = tuple(PROJECT["project"].get("urls", {}).values())
    pages = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CITATION.cff", "asv.conf.json", "docs/conf.py")]
    for page in [*pages, *(ROOT / "docs").rglob("*.md")]:
        text = page.read_text()
        stated = re.findall(r"git clone (\S+)", text) + re.findall(r"https?://[^\s\"')>]*mitsuba[-_]plenoptic\S*", text)
        assert [one for one in stated if not one.startswith(known)] == [], page


def test_the_start_page_can_be_run_from_the_page():
    tool = runpy.run_path(str(ROOT / "tools" / "check_release.py"))
    text = (ROOT / "docs" / "start" / "index.md").read_text()
    commands, files = tool["page_commands"](text), tool["page_files"](text)
    asked = " ".join(commands)
    assert f"pip install {tool['CLONE']}" in asked
    assert all(word in asked for word in ("doctor", "--model wave", "reconstruct", "depth", "python "))
    # What the commands name is on the page, or made by one before.
    made = {word for command in commands for word in re.findall(r"-o (\S+)", command)}
    named = {word for command in commands for word in re.findall(r"[\w.]+\.(?:xml|json|py|exr)", command)}
    assert named <= made | set(files) and set(files) <= named


def test_make_help_names_every_target():
    result = subprocess.run(["make", "help"], capture_output=True, text=True, check=True, cwd=ROOT)
    targets = re.search(r"^\.PHONY: help (.*)$", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)[1].split()
    # What others need first is made by itself.
    assert set(re.findall(r"^make ([\w-]+) ", result.stdout, flags=re.MULTILINE)) == set(targets) - {"llvm"}


def test_large_libraries_wait_until_they_are_used():
    """What takes most of a second to import, and what many programs never need."""
    later = "distributed", "matplotlib", "scipy.fft", "scipy.signal", "scipy.sparse", "skimage", "xarray"
    code = f"import mitsuba_plenoptic, sys; print(*sys.modules.keys() & {later})"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == []
    assert mitsuba_plenoptic.decode is mitsuba_plenoptic.views.decode
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
