"""The examples in the docstrings of the main functions give what they state."""

import doctest
import pkgutil
import re
from pathlib import Path

import pytest

INDEX = Path(__file__).parents[2] / "docs" / "reference" / "python" / "index.rst"
MAIN = re.findall(r"^   ~mitsuba_plenoptic\.(\S+)$", INDEX.read_text(), flags=re.MULTILINE)
"""The functions that the reference names as those that most scripts need."""


def test_twenty_functions_are_named():
    assert len(MAIN) >= 20


@pytest.mark.parametrize("name", MAIN)
def test_example_gives_what_it_states(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module, _, last = f"mitsuba_plenoptic.{name}".rpartition(".")
    docstring = pkgutil.resolve_name(f"{module}:{last}").__doc__
    example = doctest.DocTestParser().get_doctest(docstring, {}, name, None, 0)
    assert example.examples, "no example"
    report = []
    doctest.DocTestRunner().run(example, out=report.append)
    assert not report, "".join(report)
