"""Importing the package is quick, and its public names are found."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import mitsuba_plenoptic
from mitsuba_plenoptic.extension import entries

PACKAGE = Path(mitsuba_plenoptic.__file__).parent


def loaded(code):
    """Return the package's modules, and the names of libraries, that a new process has imported after some code."""
    code += "; import json, sys; print(json.dumps(sorted(sys.modules)), file=sys.stderr)"
    made = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    modules = json.loads(made.stderr.splitlines()[-1])
    own = {name.partition(".")[2] for name in modules if name.partition(".")[0] == "mitsuba_plenoptic"}
    # Records alone: the `__init__` of each extension.
    records = {f"extensions.{path.parent.name}" for path in (PACKAGE / "extensions").glob("*/__init__.py")}
    own -= {"extensions", *records}
    return own, {name.partition(".")[0] for name in modules}


HEAVY = {"distributed", "numpy", "scipy", "pandas", "xarray", "matplotlib", "skimage", "OpenEXR", "PIL", "yaml", "h5py"}
"""Libraries that take long to import."""


def test_the_package_imports_only_what_registers_its_plugins():
    own, libraries = loaded("import mitsuba_plenoptic")
    assert own == {"", "public_modules", "runtime", "runtime.garbage", "runtime.llvm", "plugins"}
    assert not libraries & HEAVY


def test_the_help_lists_every_command_with_its_first_sentence(capsys):
    for name in mitsuba_plenoptic.cli.COMMANDS:
        *group, word = name.split()
        assert mitsuba_plenoptic.cli.main([*group, "--help"]) == 0
        page = " ".join(capsys.readouterr().out.replace("│", " ").split())
        assert " ".join([word, *mitsuba_plenoptic.cli.load(name).help.partition("\n\n")[0].split()]) in page


def test_public_names_are_found_when_they_are_asked_for():
    assert all(getattr(mitsuba_plenoptic, name) is not None for name in mitsuba_plenoptic.__all__)
    assert mitsuba_plenoptic.decode is mitsuba_plenoptic.views.decode


@pytest.mark.slow
@pytest.mark.needs_extension("inverse", "laser", "raw")
def test_modules_are_imported_without_a_warning_and_without_their_library_are_no_attributes(python):
    made = python("""
    import pydoc, sys
    import mitsuba_plenoptic as mp
    for n in ("laser", "exchange"):
        exec(f"from mitsuba_plenoptic import {n}; import mitsuba_plenoptic.{n} as m; assert m is {n}")
    sys.modules["torch"] = None
    print(hasattr(mp, "torch"), getattr(mp, "torch", None))
    for statement in ("mp.torch", "import mitsuba_plenoptic.torch", "from mitsuba_plenoptic import torch"):
        try:
            exec(statement)
        except (AttributeError, ImportError) as error:
            print(type(error).__name__, error)
    print("render_capture" in pydoc.render_doc(mp))
    """)
    words = "Error mitsuba_plenoptic.torch needs the package torch: pip install 'mitsuba-plenoptic[torch]'"
    expected = ["False None", f"Attribute{words}", f"Import{words}", f"Import{words}", "True"]
    assert made.stdout.splitlines() == expected
    assert not made.stderr and made.returncode == 0


def test_a_package_in_an_archive_is_refused_in_one_line(tmp_path, python):
    archive = tmp_path / "package.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for path in PACKAGE.rglob("*.py*"):
            file.write(path, path.relative_to(PACKAGE.parent))
    said = python(f"""
    import sys, zipimport
    sys.meta_path = [each for each in sys.meta_path if "editable" not in repr(each).lower()]
    sys.path.insert(0, {str(archive)!r})
    try:
        import mitsuba_plenoptic
    except ImportError as error:
        print(error)
    """).stdout
    assert "package.zip" in said and "cannot be imported from an archive: unpack it" in said and said.count("\n") == 1


def test_names_of_the_package_are_public_ones_and_modules():
    shown = set(dir(mitsuba_plenoptic))
    modules = {"design", "errors", "refocus", "views", *(name for _, name, _ in entries("modules"))}
    assert {name for name in shown if not name.startswith("__")} == {*mitsuba_plenoptic.__all__, *modules}
    assert not modules & {*mitsuba_plenoptic.__all__}
    assert {"__version__", "__doc__", "__all__"} <= shown
