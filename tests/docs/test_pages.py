"""What pages ask the reader to type: commands, options and Python names exist, and the recipes' code cells run."""

import functools
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from check_release import page_code

import mitsuba_plenoptic
from mitsuba_plenoptic import cli

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
COMMANDS = {name: cli.load(name) for name in cli.COMMANDS}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_and_names_exist(page):
    text = page.read_text()
    for line in re.findall(r"^(?:\$ )?mitsuba-plenoptic ([a-z].*)$", text, flags=re.MULTILINE):
        name, *words = shlex.split(line.split("#")[0])
        known = {option for parameter in COMMANDS[name].params for option in parameter.opts + parameter.secondary_opts}
        assert {word for word in words if re.match(r"--?[A-Za-z]", word)} <= known | {"--help"}, line
    for path in set(re.findall(r"\bmp\.([A-Za-z]\w*(?:\.[A-Za-z]\w*)*)", text)):
        functools.reduce(getattr, path.split("."), mitsuba_plenoptic)
    # What is written in prose, with its folder.
    for path in set(re.findall(r"`(?:python )?((?:tools|tests|docs|asv|mitsuba_plenoptic)/[\w./]+)", text)):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize(
    "page",
    [
        ROOT / "docs" / "index.md",
        *(
            pytest.param(page, marks=[pytest.mark.slow] * (page.stem in ("main_lens", "method", "microlens")))
            for page in sorted((ROOT / "docs" / "reference" / "develop").glob("*.md"))
        ),
    ],
    ids=lambda page: page.stem,
)
def test_code_cells_run(page, tmp_path):
    """In a process of their own, since recipes register what they define; the start page and README: `make package`."""
    code = page_code(page.read_text())
    if code:
        environment = os.environ | {"MPLBACKEND": "Agg"}
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
        assert done.returncode == 0, done.stderr
