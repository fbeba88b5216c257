"""The choices and defaults that help shows are those of the library; help imports none of it."""

import inspect

import pytest

from mitsuba_plenoptic.cli import COMMANDS, choices
from mitsuba_plenoptic.cli.render_command import expose
from mitsuba_plenoptic.io import captures, examples
from mitsuba_plenoptic.io import truth_files as ground_truth
from mitsuba_plenoptic.light import detector, scene
from mitsuba_plenoptic.onchip import LAYOUTS
from mitsuba_plenoptic.refocus import methods, results
from mitsuba_plenoptic.refocus_options import METHODS
from mitsuba_plenoptic.report import images, output_files
from mitsuba_plenoptic.views import light_field_files
from mitsuba_plenoptic.views.refocusing import METHODS as VIEW_METHODS
from mitsuba_plenoptic.views.viewpoints import AXES

LIBRARY = {
    "MODELS": captures.MODELS,
    "UNITS": scene.UNITS,
    "VIEW_METHODS": VIEW_METHODS,
    "AXES": AXES,
    "LAYOUTS": ["x".join(map(str, layout)) for layout in LAYOUTS],
    "EXAMPLES": examples.NAMES,
    "MOSAICS": captures.MOSAICS,
    "ALL_MOSAICS": captures.ALL_MOSAICS,
    "RAW_SUFFIXES": captures.RAW_SUFFIXES,
    "PICTURES": output_files.SUFFIXES,
    "ANIMATED": images.ANIMATED,
    "LIGHT_FIELDS": light_field_files.SUFFIXES,
    "VOLUMES": results.SUFFIXES,
    "QUANTITIES": ground_truth.QUANTITIES,
}

LIGHT = {
    "mitsuba_plenoptic",
    "mitsuba_plenoptic.cli",
    "mitsuba_plenoptic.errors",
    "mitsuba_plenoptic.extension",
    "mitsuba_plenoptic.plugins",
    "mitsuba_plenoptic.presets",
    "mitsuba_plenoptic.refocus_options",
    "mitsuba_plenoptic.runtime",
    "mitsuba_plenoptic.runtime.llvm",
    "mitsuba_plenoptic.runtime.progress",
    "mitsuba_plenoptic.scene_files",
    "mitsuba_plenoptic.served",
    "mitsuba_plenoptic.shipped",
}
"""What the help of commands may import of this package, beside the modules of the command."""

SLOW = {"numpy", "scipy", "xarray", "pandas", "matplotlib", "h5py", "yaml", "OpenEXR", "PIL"}


@pytest.mark.parametrize("name", LIBRARY)
def test_choices_are_those_of_the_library(name):
    assert getattr(choices, name) == tuple(LIBRARY[name])


def test_methods_are_those_that_are_registered():
    assert tuple(methods.METHODS) == METHODS


def test_every_choice_is_compared():
    assert {name for name in vars(choices) if name.isupper()} == set(LIBRARY)


def test_defaults_of_the_detector_are_those_of_the_library():
    shown = inspect.signature(expose).parameters
    for name in ("quantum_efficiency", "full_well", "dark_electrons", "read_noise", "bits"):
        assert shown[name].default == getattr(detector.Detector, name)


def test_help_and_refused_options_import_no_library(python):
    code = f"""
    import contextlib, io, sys
    from mitsuba_plenoptic.cli import main
    for name in {list(COMMANDS)}:
        for words in ([name, "--help"], [name, "--nosuch-option"]):
            with contextlib.suppress(SystemExit), contextlib.redirect_stderr(io.StringIO()) as told:
                with contextlib.redirect_stdout(told):
                    main(words)
            assert "--help" in told.getvalue() or "such option" in told.getvalue(), (words, told.getvalue())
    print(*sorted(sys.modules))
    """
    loaded = set(python(code).stdout.split())
    assert not loaded & {*SLOW, "rich.progress"}
    ours = {name for name in loaded if name.startswith("mitsuba_plenoptic")}
    records = "mitsuba_plenoptic.extensions"
    own = {name for name in ours if not name.startswith(("mitsuba_plenoptic.cli.", records))}
    assert own == LIGHT
    beside = {name.rpartition(".")[2] for name in ours if name.startswith(records) and name.count(".") == 3}
    # The data of cameras with on-chip lenses belong to the presets.
    assert {name for name in beside if not name.endswith("_command")} <= {"cameras"}


def test_help_does_not_judge_options_that_are_not_given(python):
    loaded = python("import sys; from mitsuba_plenoptic.cli import main; main(['view', '--help']); print(*sys.modules)")
    assert "pydantic" not in loaded.stdout.split()
