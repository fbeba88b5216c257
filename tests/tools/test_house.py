"""The gauges of the package's structure see faults that are planted in a small package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import house
import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def gauged(tmp_path):
    """Return a function that measures a package of files, given as texts by their paths in it, and of tests."""

    def gauge(files):
        for name, text in ({"__init__.py": ""} | files).items():
            path = tmp_path / ("" if name.startswith(("tests/", "docs/")) else "mitsuba_plenoptic") / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return house.measure(tmp_path)

    return gauge


IMPORTS = {
    "at the top": "from ..lenses.b import y\n",
    "for types": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..lenses.b import y\n",
    "in a function": "def f():\n    from ..lenses import b\n",
    "in a branch": "try:\n    from ..lenses.b import y\nexcept ImportError:\n    pass\n",
    "by its whole name": "import mitsuba_plenoptic.lenses.b\n",
    "by import_module": "def f():\n    return importlib.import_module('..lenses.b', __package__)\n",
    "by a name put together": "def f(n):\n    return importlib.import_module(f'{__package__[:17]}.lenses.{n}')\n",
}


@pytest.mark.parametrize("how", IMPORTS)
def test_circles_of_folders_are_seen(gauged, how):
    found = gauged({"camera/a.py": IMPORTS[how], "lenses/__init__.py": "from ..camera.a import x\n", "lenses/b.py": ""})
    circles = found["folders on circles of imports"]
    assert [line.split(" -> ")[0] for line in circles] == ["circle 1: camera", "circle 1: lenses"]
    assert ("function" in circles[0]) == ("def f" in IMPORTS[how])
    assert len(found["imports inside functions"]) == ("def f" in IMPORTS[how])


@pytest.mark.parametrize("how", [how for how in IMPORTS if how != "by a name put together"])
def test_circles_of_modules_are_seen(gauged, how):
    found = gauged({"camera/a.py": IMPORTS[how], "lenses/b.py": "from ..camera.a import x\n", "lenses/__init__.py": ""})
    assert len(found["modules on circles of imports"]) == 2


def test_imports_that_form_no_circle(gauged):
    found = gauged(
        {
            "camera/a.py": "from .. import __version__\n",
            "lenses/b.py": "from ..camera.a import x\nfrom . import c\n",
            "lenses/c.py": "import numpy\n",
            "__init__.py": "from .lenses.b import y\n",
        }
    )
    assert not found["modules on circles of imports"]
    assert not found["folders on circles of imports"]


def test_two_circles_are_told_apart(gauged):
    found = gauged(
        {"a.py": "from . import b", "b.py": "from . import a", "c.py": "from . import d, a", "d.py": "from . import c"}
    )
    circles = found["modules on circles of imports"]
    assert [line.split(":")[0] for line in circles] == ["circle 1"] * 2 + ["circle 2"] * 2


def test_libraries_commands_and_lazy_packages_may_import_in_functions(gauged):
    own = "def f():\n    from .. import a\n"
    found = gauged({
        "a.py": "", "cli/render.py": own, "laser/__init__.py": own,
        "extensions/raw/raw_commands.py": "def f():\n    from ... import a\n",
        "system/gpu.py": "def f():\n    import scipy.sparse\n",
        "system/own.py": own,
        "system/own_too.py": "class A:\n    def f(self):\n        def g():\n            import json\n",
    })  # fmt: skip
    assert found["imports inside functions"] == ["system/own.py:2 mitsuba_plenoptic.a", "system/own_too.py:4 json"]


def test_the_core_imports_no_extension(gauged):
    found = gauged(
        {
            "camera/a.py": "from ..extensions.raw import lytro\n",
            "extensions/raw/lytro.py": "from ...camera import b\nfrom ..data import c\n",
            "extensions/data/c.py": "",
            "camera/b.py": "",
        }
    )
    assert len(found["imports of extensions by the core"]) == 1
    assert (found["lines of the core"], found["lines of the package"]) == (1, 3)
    # Each extension is a folder of its own.
    assert [line.split()[2] for line in found["folders on circles of imports"]] == ["camera", "extensions.raw"]


ASKING = [
    "if camera.lens_data.is_thin: pass",
    "white = plain if lens.images_stop else traced",
    "refuse_if(not lens.is_fourier, '')",
    "if isinstance(lens, ThinLens): pass",
    "if isinstance(lens, (TelecentricLens, lenses.CollimatedLens)): pass",
    "if isinstance(lens, ThinLens | RealLens): pass",
    "if type(lens) is LensSystem: pass",
    "if camera.main_lens is None: pass",
    "if None is not objective: pass",
    "ideal = camera.lens_model == 'ideal'",
    "if camera.lens_model in ('ideal', 'parabolic'): pass",
    "rays = [1 for c in cameras if c.prescription is not None]",
    "if not camera.objective: pass",
    "near = [c for c in cameras if c.objective]",
    "far = camera.objective and 1",
    "while lens.traced_surfaces: pass",
    "assert camera.prescription",
    "match lens:\n    case ThinLens(): pass",
    "match camera.lens_model:\n    case 'ideal': pass",
]
NOT_ASKING = [
    "from .lenses import ThinLens",
    "lens: ThinLens = ThinLens(camera)",
    "model = given or camera.lens_model",
    "surfaces = camera.prescription.surfaces",
    "if lens.focal_length > 3: pass",
    "def is_thin(self): return True",
    "'if camera.main_lens is None'",
    "camera.is_thin = True",
]


@pytest.mark.parametrize("code", ASKING)
def test_questions_for_the_kind_of_the_lens_are_seen(gauged, code):
    assert len(gauged({"a.py": f"\n{code}\n"})["lines that ask for the lens's kind"]) == 1


@pytest.mark.parametrize("code", NOT_ASKING)
def test_what_does_not_ask_for_the_kind_of_the_lens(gauged, code):
    assert not gauged({"a.py": f"{code}\n"})["lines that ask for the lens's kind"]


def test_names_that_stand_twice(gauged):
    twice = "class Plan:\n    pass\n"
    found = gauged({
        "camera/white.py": twice, "light/white.py": twice, "camera/__init__.py": "", "light/__init__.py": "",
        "tests/camera/test_white.py": "", "tests/light/test_white.py": "", "tests/conftest.py": "",
        "tests/light/conftest.py": "", "tests/white.py": "",
    })  # fmt: skip
    assert found["file names that stand twice"] == ["mitsuba_plenoptic: white.py", "tests: test_white.py"]
    assert found["class names used twice"] == ["Plan"]


def test_functions(gauged):
    found = gauged(
        {
            "a.py": '''
def white(a, b: Any, *, c: Any | None = None, **d: Any):
    """Text."""
    x = 1
    return _add(x, b.c)


def _add(a, b):
    return sum(a, b)


class A:
    def _white_of(self, x):
        return 1 + self._white_of(x)
''',
            "extensions/raw/b.py": "def _hidden_white():\n    return 1\n",
        }
    )
    assert found["functions"] == 4
    assert found["private helpers of the core, % of its functions"] == pytest.approx(100 * 2 / 3, abs=0.05)
    assert found["lines of the median function of the core"] == 2
    assert found["private functions used once, of at most 3 statements"] == ["a.py:8 _add", "a.py:13 _white_of"]
    assert found["functions that only forward"] == ["a.py:8 _add"]
    assert found["definitions of white in the core"] == ["a.py:2 white", "a.py:13 _white_of"]
    assert (found["parameters"], found["parameters typed Any"]) == (7, 2)


def test_clones_and_long_files(gauged):
    def block(name):
        return f"def f():\n    {name} = 0\n" + f"    {name} += 1\n" * 8

    found = gauged({"a.py": block("x"), "b.py": block("y"), "c.py": "x = 1\n" * 601})
    assert found["clones of eight statements"] == ["a.py:2  b.py:2"]
    assert found["files above 600 lines"] == ["c.py 601"]


def test_internal_names_in_tests(gauged):
    found = gauged(
        {
            "docs/reference/python/a.rst": ".. automodule:: mitsuba_plenoptic.shown\n\n"
            ".. automodule:: mitsuba_plenoptic.c\n   :no-members:\n",
            "docs/reference/python/b.rst": ".. autoclass:: mitsuba_plenoptic.a.Class\n",
            "docs/a.md": "```py\nfrom mitsuba_plenoptic.c import page, code\n```\n",
            "tests/test_a.py": "from mitsuba_plenoptic import any\nfrom mitsuba_plenoptic.a import _x, Class, other\n",
            "tests/test_b.py": "from mitsuba_plenoptic.a import other\nfrom mitsuba_plenoptic.shown import any\n",
            "tests/test_c.py": "import mitsuba_plenoptic.b, mitsuba_plenoptic.shown\n",
            "tests/test_d.py": "from mitsuba_plenoptic.c import code, hidden\n",
        }
    )
    assert found["internal names that tests import"] == [
        "mitsuba_plenoptic.a._x",
        "mitsuba_plenoptic.a.other",
        "mitsuba_plenoptic.b",
        "mitsuba_plenoptic.c.hidden",
    ]


def test_words_of_pages(tmp_path):
    pages = {"a.md": "one two", "deep/b.md": "three", "changelog.md": "no", "c.rst": "no"}
    pages["d.md"] = "four <!-- gauges -->\nno no\n<!-- end of gauges -->"
    for name, text in pages.items():
        (tmp_path / "docs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "docs" / name).write_text(text)
    # The closing mark of the table is five words.
    assert house.docs_words(tmp_path) == 4 + 5


def test_limits_are_held_from_both_sides():
    values = {row.name: row.beginning if row.limit is None else row.limit for row in house.LIMITS}
    assert house.exceeded(values) == []
    least, most = values["lines of the median function of the core"], values["modules on circles of imports"]
    values["modules on circles of imports"] = ["a"] * (most + 1)
    values["lines of the median function of the core"] = least - 1
    assert house.exceeded(values) == [
        f"lines of the median function of the core: {least - 1}, at least {least}",
        f"modules on circles of imports: {most + 1}, at most {most}",
    ]


def test_every_gauge_has_a_row_and_every_page_a_place_for_the_table(gauged):
    visited = {name for name in (row.name for row in house.LIMITS) if name.startswith(("files visited", "most lenses"))}
    assert set(gauged({})) | visited == {row.name for row in house.LIMITS}
    assert len(house.TABLE.findall((ROOT / "docs/reference/develop/house.md").read_text())) == 1


def test_visits_are_of_the_checkout_that_is_given(tmp_path):
    package = tmp_path / "mitsuba_plenoptic"
    package.mkdir()
    (package / "__init__.py").write_text("print('here')\nraise SystemExit(3)\n")
    with pytest.raises(subprocess.CalledProcessError) as caught:
        house.visits(tmp_path)
    assert caught.value.returncode == 3
    assert sys.executable in caught.value.cmd
