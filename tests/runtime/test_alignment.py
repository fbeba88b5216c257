"""NumPy's memory reaches Dr.Jit, which compiles into kernels whether memory is aligned, in one place and aligned."""

import ast
import json
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from kernel_entries import OF_EXTENSIONS, QUICK, SLOW, SLOW_OF_EXTENSIONS

from mitsuba_plenoptic.runtime.backend import drjit_array, packets

ROOT = Path(__file__).parents[2]
ALIGNED, UNALIGNED = 0, 16
EXTENSIONS = pytest.mark.needs_extension("inverse", "laser", "onchip")


@pytest.mark.skipif(sys.platform != "linux", reason="arrays are placed by glibc")
@pytest.mark.parametrize(
    "names",
    [
        pytest.param(list(QUICK), id="quick"),
        pytest.param(list(OF_EXTENSIONS), id="of extensions", marks=[EXTENSIONS, pytest.mark.slow]),
        pytest.param(list(SLOW), id="slow", marks=pytest.mark.slow),
        pytest.param(list(SLOW_OF_EXTENSIONS), id="slow of extensions", marks=[EXTENSIONS, pytest.mark.slow]),
    ],
)
def test_kernels_do_not_depend_on_where_numpys_memory_lies(names):
    """Two processes, whose arrays are all aligned or all unaligned, load or compile the same kernels."""
    command = [sys.executable, "-m", "tests.runtime.kernel_entries"]
    # One after the other: the second finds on disk what the first has compiled, and compiles the others.
    aligned, unaligned = (
        json.loads(
            subprocess.run(
                [*command, str(offset), *names], cwd=ROOT, stdout=subprocess.PIPE, text=True, timeout=600, check=True
            ).stdout
        )
        for offset in (ALIGNED, UNALIGNED)
    )
    differ = {name: len(set(aligned[name]) ^ set(unaligned[name])) for name in names}
    assert differ == dict.fromkeys(names, 0)
    assert all(aligned.values())


@pytest.mark.parametrize("offset", [0, 4, 16])
@pytest.mark.parametrize("count", [1, 16, 2**19])
def test_shared_numbers_are_aligned_and_equal(count, offset):
    memory = np.empty(4 * count + 128, np.uint8)
    start = -memory.ctypes.data % 64 + offset
    given = memory[start : start + 4 * count].view(np.float32)
    given[:] = np.arange(count)
    for kind in (mi.Float, mi.UInt32, dr.llvm.Float64):
        made = drjit_array(kind, given)
        assert made.numpy().ctypes.data % 64 == 0
        np.testing.assert_array_equal(made.numpy(), given)


def test_tensors_keep_their_shape():
    given = np.arange(24.0).reshape(2, 3, 4)[:, ::2]
    made = drjit_array(mi.TensorXf, given)
    assert isinstance(made, mi.TensorXf)
    np.testing.assert_array_equal(made.numpy(), given)


def test_aligned_arrays_are_shared():
    given = packets(np.arange(32.0))
    assert np.shares_memory(drjit_array(dr.llvm.Float64, given).numpy(), given)


_TYPES = (
    {f"{kind}{bits}" for kind in ("Float", "Int", "UInt") for bits in ("", 16, 32, 64)}
    | {f"{kind}{size}f" for kind in ("Point", "Vector") for size in (2, 3)}
    | {"Bool", "TensorXf"}
)


def shared_directly(source):
    """Return the lines on which a Dr.Jit type is called with what is NumPy's by its looks."""
    found = []
    for call in ast.walk(ast.parse(source)):
        if isinstance(call, ast.Call) and getattr(call.func, "attr", getattr(call.func, "id", "")) in _TYPES:
            inside = [node for given in call.args for node in ast.walk(given)]
            names = {getattr(node, "id", getattr(node, "attr", "")) for node in inside}
            if names & {"np", "arrays", "astype", "ravel", "as_words", "reshape"}:
                found.append(call.lineno)
    return found


@pytest.mark.parametrize(
    ("line", "is_direct"),
    [
        ("mi.Float(np.ones(3))", True),
        ("Float64(table.ravel())", True),
        ("mi.Point3f(np.ones((3, 8)))", True),
        ("types.UInt64(as_words(field))", True),
        ("drjit_array(mi.Float, np.ones(3))", False),
        ("mi.Float(index)", False),
    ],
)
def test_what_is_taken_for_numpys(line, is_direct):
    assert bool(shared_directly(line)) == is_direct


def test_no_other_module_gives_drjit_numpys_memory():
    modules = set(ROOT.glob("mitsuba_plenoptic/**/*.py")) - {ROOT / "mitsuba_plenoptic" / "runtime" / "backend.py"}
    assert len(modules) > 100
    found = {path.name: lines for path in modules if (lines := shared_directly(path.read_text()))}
    assert not found
