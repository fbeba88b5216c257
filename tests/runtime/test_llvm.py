"""Which LLVM is chosen, and what a user is told where none is usable."""

import os
import sys
from pathlib import Path

import pytest

from mitsuba_plenoptic.runtime import llvm

ROOT = Path(__file__).parents[2]
OLD = [item for item in llvm.candidates() if item.version and not item.usable]


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/x/lib/libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("/usr/lib64/llvm19/lib64/libLLVM.so", (19,)),
        ("/opt/homebrew/Cellar/llvm@18/18.1.8_1/lib/libLLVM.dylib", (18, 1, 8)),
        ("/some/where/libLLVM.so", ()),
    ],
)
def test_version_from_the_name(path, version):
    assert llvm.library(path).version == version


def test_candidates_come_newest_first_and_each_once(tmp_path, monkeypatch):
    for name in ("libLLVM-14.so.1", "libLLVM.so.22.1", "libLLVM-17.so.1", "libLLVM-C.so", "libLLVMCore.a"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-17.so").symlink_to("libLLVM-17.so.1")
    (tmp_path / "libLLVM-30.so").symlink_to("gone")
    monkeypatch.setattr(llvm, "_folders", lambda: iter([tmp_path, tmp_path / "missing"]))
    found = llvm.candidates()
    assert [item.version for item in found] == [(22, 1), (17,), (14,)]
    assert [item.usable for item in found] == [True, True, False]


def test_conda_environment_is_searched(tmp_path, monkeypatch):
    library = tmp_path / "lib" / "libLLVM-99.so"
    library.parent.mkdir()
    library.touch()
    monkeypatch.setenv("CONDA_PREFIX", str(tmp_path))
    assert llvm.candidates()[0].path == library


def test_choose_takes_the_newest_and_leaves_a_users_choice(tmp_path, monkeypatch):
    (tmp_path / "libLLVM-17.so").touch()
    (tmp_path / "libLLVM-16.so").touch()
    monkeypatch.setattr(llvm, "_folders", lambda: iter([tmp_path]))
    monkeypatch.setenv(llvm.VARIABLE, "")
    llvm.choose()
    assert os.environ[llvm.VARIABLE] == "", "Dr.Jit is loaded already"
    monkeypatch.delitem(sys.modules, "drjit")
    llvm.choose()
    assert os.environ[llvm.VARIABLE] == str(tmp_path / "libLLVM-17.so")
    monkeypatch.setenv(llvm.VARIABLE, "/mine.so")
    llvm.choose()
    assert os.environ[llvm.VARIABLE] == "/mine.so"


def test_fresh_process_loads_a_usable_llvm(python):
    code = """
    import mitsuba_plenoptic, drjit as dr, mitsuba as mi
    mi.set_variant("llvm_ad_mono")
    print(dr.detail.llvm_version()[0] >= 17, dr.maximum(mi.Float([1, 2]), 1.5))
    """
    result = python(code, DRJIT_LIBLLVM_PATH="")
    assert (result.stdout, result.stderr) == ("True [1.5, 2]\n", "")


@pytest.mark.slow
@pytest.mark.parametrize("old", [item.path for item in OLD[:1]] + [None])
def test_unusable_llvm_raises_when_used_and_not_on_import(old, python, tmp_path):
    library = old or tmp_path / "libLLVM.so"
    if not old:
        library.write_text("no library")
    code = """
    import mitsuba_plenoptic as mp, mitsuba as mi, numpy as np
    camera = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.128)
    for use in (
        lambda: mp.load_scene("letters"),
        lambda: mp.reconstruct(np.zeros((64, 64)), 240, camera=camera),
        lambda: mi.set_variant("llvm_ad_mono") or mi.load_dict({"type": "plenoptic"}),
    ):
        try:
            use()
        except Exception as error:
            print(str(error).splitlines()[-1])
    """
    result = python(code, DRJIT_LIBLLVM_PATH=str(library))
    # Not a negative status: the process is never aborted.
    assert result.returncode == 0, result.stderr
    scene, reconstruction, sensor = result.stdout.splitlines()
    assert all("17 or newer" in line and str(library) in line for line in (scene, reconstruction))
    assert "17 or newer" in sensor or "inactive" in sensor


GOOD, BAD = (llvm.Library(Path("/x.so"), (version,)) for version in (19, 16))


@pytest.mark.parametrize(("loaded", "named", "found", "words"), [
    (None, None, [], ["no LLVM 17 or newer was found", "run: INSTALL"]),
    ("LLVM 15.0.6", None, [GOOD], ["Dr.Jit loaded LLVM 15.0.6, ", "or set NAMED=/x.so"]),
    (None, "/none", [GOOD], ["NAMED = '/none': there is no such file; unset the variable, and /x.so is used"]),
    (None, "/none", [BAD], ["NAMED = '/none': there is no such file; unset the variable and run: INSTALL"]),
    (None, __file__, [], [f"NAMED = {__file__!r}: it is not an LLVM library that loads, ", "run: INSTALL"]),
])  # fmt: skip
def test_explanations(loaded, named, found, words, monkeypatch):
    monkeypatch.setattr(llvm, "install_command", lambda: "INSTALL")
    said = llvm.explain(loaded, named, found)
    assert all(word.replace("NAMED", llvm.VARIABLE) in said for word in words)
