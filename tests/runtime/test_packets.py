"""Kernels of Dr.Jit read whole packets, which must not go beyond the memory of arrays of NumPy."""

import subprocess
import sys

import numpy as np
import pytest

from mitsuba_plenoptic.runtime.backend import packets

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


@pytest.mark.parametrize("has_room", [False, True])
@pytest.mark.parametrize("start", [0, 2])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 32, 2**18])
def test_arrays_whose_memory_holds_their_last_packet_are_not_copied(count, start, has_room):
    memory = np.empty(count + 32)
    first = -memory.ctypes.data % 64 // 8 + start
    # Of a buffer NumPy knows no more than it was given.
    given = memory[first : first + count] if has_room else np.frombuffer(memory.data, float, count, 8 * first)
    given[:] = np.arange(count)
    made = packets(given)
    np.testing.assert_array_equal(made, given)
    shared = count > 0 and start == 0 and (has_room or count % 16 == 0)
    assert np.shares_memory(made, given) == shared
    if not shared and count:
        assert made.ctypes.data % 64 == 0
        owner = made
        while owner.base is not None:
            owner = owner.base
        assert owner.ctypes.data + owner.nbytes >= made.ctypes.data + -(-count // 16) * 128
