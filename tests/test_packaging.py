"""What a wheel would hold, and what make needs."""

import re
import runpy
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

import mitsuba_plenoptic

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGE = ROOT / "mitsuba_plenoptic"
FOLDERS = {"mitsuba_plenoptic": PACKAGE, "mitsuba_plenoptic.scenes": ROOT / "scenes"}


def test_every_folder_with_code_is_a_package_and_nothing_is_a_link():
    """The build finds packages by their ``__init__.py``, and takes a link for a file of data, or fails."""
    folders = {path.parent for path in PACKAGE.rglob("*.py")}
    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []
    assert [path for top in (PACKAGE, ROOT / "scenes") for path in top.rglob("*") if path.is_symlink()] == []


@pytest.mark.parametrize("package, folder", FOLDERS.items())
def test_data_files_are_packed(package, folder):
    patterns = PROJECT["tool"]["setuptools"]["package-data"][package]
    packed = {path for pattern in patterns for path in folder.glob(pattern)}
    present = {path for path in folder.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert packed == present


def test_versions_agree():
    """The newest release is cited and described by the CHANGELOG; the package has it, or is on the way to the next."""
    stated = PROJECT["project"]["version"]
    assert mitsuba_plenoptic.__version__ == version("mitsuba-plenoptic") == stated
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), flags=re.MULTILINE)[1]
    heads = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert next(head for head in heads if head != "Unreleased") == cited
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
