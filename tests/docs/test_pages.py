"""What pages ask the reader to type: commands, options and Python names exist, and the recipes' code cells run."""

import functools
import os
import re
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pytest
from check_release import page_code

import mitsuba_plenoptic
from mitsuba_plenoptic import cli

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SOURCES = "".join(path.read_text() for path in (ROOT / "mitsuba_plenoptic").rglob("*.py"))
COMMANDS = {name: cli.load(name) for name in cli.COMMANDS}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_names_exist(page):
    text = page.read_text()
    for line in re.findall(r"^(?:\$ )?mitsuba-plenoptic ([a-z].*)$", text, flags=re.MULTILINE):
        words = shlex.split(line.split("#")[0])
        name = next(name for name in (" ".join(words[:2]), words[0], f"{words[0]} camera") if name in COMMANDS)
        known = {option for parameter in COMMANDS[name].params for option in parameter.opts + parameter.secondary_opts}
        assert {word for word in words if re.match(r"--?[A-Za-z]", word)} <= known | {"--help"}, line
    for path in set(re.findall(r"\bmp\.([A-Za-z]\w*(?:\.[A-Za-z]\w*)*)", text)):
        functools.reduce(getattr, path.split("."), mitsuba_plenoptic)
    for line in re.findall(r"(?<=```diff\n)-(.*\n)", text):
        assert SOURCES.count(line) == 1, line
    # What is written in prose, with its folder.
    for path in set(re.findall(r"`(?:python )?((?:tools|tests|docs|asv|mitsuba_plenoptic)/[\w./]+)", text)):
        assert (ROOT / path).exists(), path


# Pages about a reader's own pictures, and those that go on from the start page.
BLOCK = re.compile(
    r"^```(?:\{code-block\} \w+\n:caption: (\S+)\n\n|(?:\{code-cell\} )?(python|console)\n)(.*?)^```",
    re.MULTILINE | re.DOTALL,
)
OWN_PICTURES = ("calibration", "exchange", "real_light")


@pytest.mark.parametrize("page", [page for page in PAGES if page.stem not in OWN_PICTURES], ids=lambda page: page.stem)
def test_pages_can_be_pasted_from_their_top(page):
    """In an empty folder: commands read files that the page wrote, and code uses names that it defined."""
    written = set()
    code = ""
    for name, kind, text in BLOCK.findall(page.read_text()):
        written.add(name)
        if kind == "python":
            code += text
            written |= set(re.findall(r"""["'](\S+\.\w+)["']""", text))
        lines = re.findall(r"^\$ mitsuba-plenoptic (.*)$", text, flags=re.MULTILINE)
        for line in lines if kind == "console" else ():
            words = shlex.split(line, comments=True)
            options = {"-o", "--output", "--microlens"} | ({"--white"} if words[0] == "render" else set())
            outputs = {following for word, following in pairwise(words) if word in options}
            read = {word for word in words if re.fullmatch(r"[\w./]+\.(exr|tiff?|png|json|yaml|xml|nc|zarr|pdf)", word)}
            # Several distances make out_210.exr of out.exr.
            stems = {re.sub(r"_[\d.]+(?=\.)", "", word): word for word in read - outputs - written}
            assert not set(stems) - written, f"{line}: {stems}"
            written |= outputs
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F821", "-"]
    done = subprocess.run(command, input=code, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [
        page
        for page in [ROOT / "docs" / "index.md", *sorted((ROOT / "docs" / "reference" / "develop").glob("*.md"))]
        if page_code(page.read_text())
    ],
    ids=lambda page: page.stem,
)
def test_code_cells_run(page, tmp_path):
    """In a process of their own, since recipes register what they define; the start page and README: `make package`."""
    command = [sys.executable, "-c", page_code(page.read_text())]
    environment = os.environ | {"MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
