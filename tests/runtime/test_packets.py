"""Kernels of Dr.Jit read whole packets, which must not go beyond the memory of arrays of NumPy."""

import subprocess
import sys

import pytest

AT_THE_END_OF_A_PAGE = """
import ctypes, mmap
import mitsuba as mi
import numpy as np
from mitsuba_plenoptic.optics.waves import advance

mi.set_variant("llvm_ad_mono")
page, shape = mmap.PAGESIZE, (3, 5)
memory = mmap.mmap(-1, 2 * page)
start = ctypes.addressof(ctypes.c_char.from_buffer(memory))
libc = ctypes.CDLL(None)
libc.mprotect.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
assert libc.mprotect(start + page, page, 0) == 0
field = np.frombuffer(memory, np.complex64, 15, page - 15 * 8).reshape(shape)
field[:] = np.arange(15).reshape(shape)
np.testing.assert_array_equal(advance(field, 0.01, 0.0, 633.0), field)
print("fine")
"""


@pytest.mark.skipif(sys.platform != "linux", reason="pages are protected as on Linux")
def test_fields_that_end_with_a_page():
    """The next page is protected: reading it would end the process."""
    made = subprocess.run([sys.executable, "-c", AT_THE_END_OF_A_PAGE], capture_output=True, text=True, timeout=100)
    assert (made.returncode, made.stdout.strip()) == (0, "fine"), made.stderr
