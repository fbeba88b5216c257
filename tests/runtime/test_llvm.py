"""Which LLVM is chosen, and what a user is told where none is usable."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mitsuba_plenoptic.runtime import llvm as _llvm

ROOT = Path(__file__).parents[2]
OLD = [item for item in _llvm.candidates() if item.version and not item.usable]


def python(code, **environment):
    """Run code in a fresh process, where Dr.Jit has not loaded LLVM yet."""
    base = {name: value for name, value in os.environ.items() if name != _llvm.VARIABLE}
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env=base | environment,
        cwd=ROOT,
    )


@pytest.mark.parametrize(
    ("path", "version"),
    [
        ("/x/lib/libLLVM-14.0.6.so.1", (14, 0, 6)),
        ("/x/lib/libLLVM-15.so.1", (15,)),
        ("/usr/lib64/libLLVM.so.21.1", (21, 1)),
        ("/usr/lib64/llvm19/lib64/libLLVM.so", (19,)),
        ("/env/lib/libLLVM-19.so", (19,)),
        ("/env/lib/libLLVM.19.1.dylib", (19, 1)),
        ("/opt/homebrew/Cellar/llvm/21.1.7_1/lib/libLLVM.dylib", (21, 1, 7)),
        ("/opt/homebrew/Cellar/llvm@18/18.1.8/lib/libLLVM.dylib", (18, 1, 8)),
        ("/some/where/libLLVM.so", ()),
        ("/some/where/libLLVM-C.dylib", ()),
    ],
)
def test_version_from_the_name(path, version):
    assert _llvm.library(path).version == version


def test_candidates_come_newest_first_and_each_once(tmp_path, monkeypatch):
    for name in ("libLLVM-14.so.1", "libLLVM.so.22.1", "libLLVM-17.so.1", "libLLVM-C.so", "libLLVMCore.a"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-17.so").symlink_to("libLLVM-17.so.1")
    (tmp_path / "libLLVM-30.so").symlink_to("gone")
    monkeypatch.setattr(_llvm, "_folders", lambda: iter([tmp_path, tmp_path / "missing"]))
    found = _llvm.candidates()
    assert [item.version for item in found] == [(22, 1), (17,), (14,)]
    assert [item.usable for item in found] == [True, True, False]


def test_conda_environment_is_searched(tmp_path, monkeypatch):
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "libLLVM-99.so").touch()
    monkeypatch.setenv("CONDA_PREFIX", str(tmp_path))
    assert _llvm.candidates()[0].path == tmp_path / "lib" / "libLLVM-99.so"


def test_choose_takes_the_newest_and_leaves_a_users_choice(tmp_path, monkeypatch):
    (tmp_path / "libLLVM-17.so").touch()
    (tmp_path / "libLLVM-16.so").touch()
    monkeypatch.setattr(_llvm, "_folders", lambda: iter([tmp_path]))
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.setenv(_llvm.VARIABLE, "")
    _llvm.choose()
    assert os.environ[_llvm.VARIABLE] == str(tmp_path / "libLLVM-17.so")
    monkeypatch.setenv(_llvm.VARIABLE, "/mine.so")
    _llvm.choose()
    assert os.environ[_llvm.VARIABLE] == "/mine.so"


def test_choose_does_nothing_once_drjit_is_loaded(monkeypatch):
    monkeypatch.delenv(_llvm.VARIABLE, raising=False)
    _llvm.choose()
    assert _llvm.VARIABLE not in os.environ


def test_fresh_process_loads_a_usable_llvm():
    result = python(
        "import mitsuba_plenoptic, drjit as dr, mitsuba as mi; mi.set_variant('llvm_ad_mono');"
        "print(dr.detail.llvm_version()[0] >= 17, dr.maximum(mi.Float([1, 2]), 1.5))"
    )
    assert (result.stdout, result.stderr) == ("True [1.5, 2]\n", "")


USE = {
    "sensor": "mi.set_variant('llvm_ad_mono'); mi.load_dict({'type': 'plenoptic'})",
    "scene": "mp.load_scene('letters')",
    "reconstruct": "mp.reconstruct(np.zeros((64, 64)), 240,"
    " camera=mp.PlenopticCamera(resolution=(64, 64), detector_width=0.128))",
}


@pytest.mark.parametrize("use", USE)
@pytest.mark.parametrize("library", ["text", *(str(item.path) for item in OLD[:2])])
def test_unusable_llvm_raises_when_used_and_not_on_import(library, use, tmp_path):
    if library == "text":
        library = tmp_path / "libLLVM.so"
        library.write_text("no library")
    prologue = "import mitsuba_plenoptic as mp, mitsuba as mi, numpy as np; print('imported');"
    result = python(prologue + USE[use], DRJIT_LIBLLVM_PATH=str(library))
    # Not a negative status: the process is never aborted.
    assert (result.stdout, result.returncode) == ("imported\n", 1)
    last = result.stderr.splitlines()[-1]
    assert "17 or newer" in last or "inactive" in last
    if use != "sensor":
        assert str(library) in last


def run_command(*arguments, **environment):
    code = f"import sys; from mitsuba_plenoptic.cli import main; sys.exit(main({list(arguments)!r}))"
    return python(code, **environment)


def test_missing_library_named_by_the_user_gives_one_clear_line(tmp_path):
    output = tmp_path / "raw.exr"
    result = run_command("render", "letters", "-o", str(output), DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert result.stderr.splitlines()[-1].startswith(
        "mitsuba-plenoptic: error: DRJIT_LIBLLVM_PATH = '/nowhere/libLLVM.so': there is no such file"
    )


def test_doctor_works_without_llvm():
    result = run_command("doctor", DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert "Traceback" not in result.stderr
    assert result.returncode in (0, 1)
    assert "Problem: DRJIT_LIBLLVM_PATH = '/nowhere/libLLVM.so': there is no such file" in result.stdout


def test_explanations(monkeypatch):
    monkeypatch.setattr(_llvm, "install_command", lambda: "apt-get install -y libllvm19")
    good = _llvm.Library(Path("/x/libLLVM-19.so"), (19,))
    assert _llvm.explain(None, None, []) == (
        "no LLVM 17 or newer was found, which the llvm variants need; run: apt-get install -y libllvm19"
    )
    assert _llvm.explain("LLVM 15.0.6", None, [good]) == (
        "Dr.Jit loaded LLVM 15.0.6, but the llvm variants need LLVM 17 or newer; import mitsuba_plenoptic "
        "before drjit and mitsuba, or set DRJIT_LIBLLVM_PATH=/x/libLLVM-19.so"
    )
    assert _llvm.explain(None, "/none", [good]) == (
        "DRJIT_LIBLLVM_PATH = '/none': there is no such file; unset the variable, and /x/libLLVM-19.so is used"
    )
    assert _llvm.explain(None, "/none", []).endswith("unset the variable and run: apt-get install -y libllvm19")


def test_newest_apt_package(monkeypatch):
    listing = "libllvm16 - x\nlibllvm19 - x\nlibllvm17t64 - x\nlibllvm9 - x\n"
    answer = subprocess.CompletedProcess([], 0, stdout=listing)
    monkeypatch.setattr(_llvm.subprocess, "run", lambda *_, **__: answer)
    assert _llvm.newest_apt_package() == "libllvm19"
    answer.stdout = "libllvm16 - x\n"
    assert _llvm.newest_apt_package() is None


class TestTool:
    """`tools/ensure_llvm.py`, with apt and sudo replaced by scripts that write down what they are asked."""

    def run(self, tmp_path, *, names, **environment):
        """Run the tool where only the programs in `names` exist and no LLVM is found."""
        programs = tmp_path / "bin"
        programs.mkdir()
        for name, text in names.items():
            (programs / name).write_text(f'#!/bin/sh\necho "{name} $*" >> {tmp_path}/log\n{text}\n')
            (programs / name).chmod(0o755)
        # The tool reads its own copy of llvm.py, in which no folder is searched.
        tree = tmp_path / "tree"
        (tree / "tools").mkdir(parents=True)
        (tree / "mitsuba_plenoptic" / "runtime").mkdir(parents=True)
        (tree / "tools" / "ensure_llvm.py").write_text((ROOT / "tools" / "ensure_llvm.py").read_text())
        source = (ROOT / "mitsuba_plenoptic" / "runtime" / "llvm.py").read_text()
        source += f"\n\ndef _folders():\n    yield Path({str(tmp_path)!r})\n"
        (tree / "mitsuba_plenoptic" / "runtime" / "llvm.py").write_text(source)
        result = subprocess.run(
            [sys.executable, str(tree / "tools" / "ensure_llvm.py")],
            capture_output=True,
            text=True,
            check=False,
            env={"PATH": str(programs), **environment},
        )
        log = tmp_path / "log"
        return result, log.read_text().splitlines() if log.exists() else []

    @pytest.mark.skipif(os.geteuid() != 0, reason="as another user the tool goes through sudo")
    def test_installs_as_root_after_an_update(self, tmp_path):
        install = f'[ "$1" = install ] && /usr/bin/touch {tmp_path}/libLLVM-22.so; exit 0'
        names = {"apt-get": install, "apt-cache": "echo 'libllvm19 - x'; echo 'libllvm22 - x'"}
        names["env"] = 'exec /usr/bin/env "$@"'
        result, log = self.run(tmp_path, names=names)
        assert result.returncode == 0, result.stderr
        assert "apt-get update -q" in log
        assert "apt-get install -y -q libllvm22" in log

    def test_says_what_to_run_where_nothing_can_be_installed(self, tmp_path):
        result, _ = self.run(tmp_path, names={"dnf": "exit 1"})
        assert result.returncode == 1
        assert result.stderr == (
            "ensure_llvm: no LLVM 17 or newer was found, which the llvm variants need; "
            "run: sudo dnf install llvm-libs\n"
        )

    def test_leaves_a_users_choice(self, tmp_path):
        result, log = self.run(tmp_path, names={"apt-get": "", "apt-cache": ""}, DRJIT_LIBLLVM_PATH="/nowhere.so")
        assert (result.returncode, [line for line in log if "install" in line]) == (1, [])
        assert "there is no such file" in result.stderr
