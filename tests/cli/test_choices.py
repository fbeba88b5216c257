"""The choices and defaults that commands state are those of the library; help imports none of it."""

import re

import numpy as np
import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.cli import COMMANDS
from mitsuba_plenoptic.refocus import Volume, methods, write_volume
from mitsuba_plenoptic.refocus_options import METHODS
from mitsuba_plenoptic.views.light_field_files import save_light_field

CAMERA = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.128)
IMAGE = np.ones((64, 64), np.float32)


def scene():
    return mp.load_scene("letters", parameters={"resolution": "64"})


# What the library refuses by naming the choices, and the command that does.
REFUSED = {
    "model": (lambda: mp.render_capture(scene(), model="?"), "render letters -o a.exr --model ?"),
    "unit": (lambda: mp.load_scene("letters", unit="?"), "render letters -o a.exr --unit ?"),
    "method of views": (
        lambda: mp.views.focal_stack(mp.decode(IMAGE, camera=CAMERA), [240], method="?"),
        "stack {raw} -o a.exr --distance 240 --method ?",
    ),
    "axis": (lambda: mp.views.epipolar_image(mp.decode(IMAGE, camera=CAMERA), "?"), "epi {raw} -o a.exr --axis ?"),
    "example": (lambda: mp.example("?"), "example ?"),
    "mosaic": (lambda: mp.Detector(mosaic="?"), "expose {raw} -o a.exr --photons 9 --mosaic ?"),
    "method": (
        lambda: mp.reconstruct(IMAGE, 240, camera=CAMERA, method="?"),
        "reconstruct {raw} -o a.exr --distance 240 --method ?",
    ),
}

# What the library refuses by the suffixes of files, and the command that does, which may know others, too.
SUFFIXES = {
    "raw pictures": (
        lambda: mp.write_raw("a.jpg", mp.expose(mp.Capture(IMAGE, CAMERA), mp.Detector(), photons=100)),
        "expose {raw} -o a.jpg --photons 9",
    ),
    "light fields": (
        lambda: save_light_field("a.jpg", mp.decode(IMAGE, camera=CAMERA)),
        "convert {raw} -o a.jpg",
    ),
    "volumes": (
        lambda: write_volume("a.jpg", Volume(IMAGE[None], (240.0,), 0.1)),
        "reconstruct {raw} -o a.jpg --distance 240",
    ),
}

LIGHT = {
    "mitsuba_plenoptic",
    "mitsuba_plenoptic.cli",
    "mitsuba_plenoptic.errors",
    "mitsuba_plenoptic.extension",
    "mitsuba_plenoptic.plugins",
    "mitsuba_plenoptic.presets",
    "mitsuba_plenoptic.public_modules",
    "mitsuba_plenoptic.refocus_options",
    "mitsuba_plenoptic.runtime",
    "mitsuba_plenoptic.runtime.llvm",
    "mitsuba_plenoptic.runtime.progress",
    "mitsuba_plenoptic.scene_files",
}
"""What the help of commands may import of this package, beside the modules of the command."""

SLOW = {"numpy", "scipy", "xarray", "pandas", "matplotlib", "h5py", "yaml", "OpenEXR", "PIL"}


@pytest.mark.parametrize("name", REFUSED)
def test_choices_are_those_of_the_library(name, raw, complaint):
    call, line = REFUSED[name]
    with pytest.raises(mp.InputError) as caught:
        call()
    rule = str(caught.value).partition(": it must be one of ")[2]
    assert rule.count(", ") >= 1 and complaint(*line.format(raw=raw).split()).endswith(f": it must be one of {rule}")


@pytest.mark.parametrize("name", SUFFIXES)
def test_suffixes_are_those_of_the_library(name, raw, complaint):
    call, line = SUFFIXES[name]
    with pytest.raises(mp.InputError) as caught:
        call()
    known, stated = (
        re.findall(r"\.\w+", text.partition("ends in ")[2])
        for text in (str(caught.value), complaint(*line.format(raw=raw).split()))
    )
    assert len(known) >= 2 and set(known) <= set(stated)


def test_quantities_are_those_of_ground_truth(complaint):
    stated = complaint("render", "letters", "-o", "a.exr", "--aov", "?").partition(": it must be one of ")[2]
    assert stated.split(", ") == list(mp.ground_truth(mp.with_camera(scene(), CAMERA)).pixels)


@pytest.mark.needs_extension("deconvolution")
def test_methods_are_those_that_are_registered():
    assert tuple(methods.METHODS) == METHODS


def test_defaults_of_the_detector_are_those_of_the_library(raw, tmp_path, run):
    run("expose", raw, "-o", tmp_path / "noisy.exr", "--photons", 500, "--seed", 1)
    capture = mp.read_capture(raw)
    np.testing.assert_array_equal(
        mp.read_capture(tmp_path / "noisy.exr").image, mp.expose(capture, mp.Detector(), photons=500, seed=1).image
    )


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
