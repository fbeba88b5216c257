"""Two-dimensional Fourier transforms of fields: by SciPy on the processor, by CuPy on CUDA, for Dr.Jit arrays.

Dr.Jit has no FFT. Fields are shared between the libraries without copies, as one 64-bit word per sample whose lower
half is the real part and whose upper half is the imaginary part, as in NumPy's and CuPy's ``complex64``; a Dr.Jit
kernel separates the halves at no cost.

SciPy transforms in place if overwriting is allowed, including views. CuPy does so with whole arrays, copies views
first, and caches cuFFT plans by shape (`cupy.fft.config.get_plan_cache`). Callers therefore continue with the array
that a transform returns.
"""

import contextlib
import ctypes
import functools
import math
import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import scipy
from numpy.typing import NDArray

from ..errors import refuse_if
from .backend import Array, Doubles, Floats, Pair, Triple, backend_of, drjit_array, on_cuda, quotient

Field = NDArray[np.complex64]
"""A field or spectrum: NumPy's array, or with a CUDA variant CuPy's, which lies on the device."""

_rest_lock = threading.Lock()
_resting = 0
_busy_threads = 0


def worker_count() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def resting_drjit() -> Iterator[None]:
    """Keep Dr.Jit's threads off the processor cores while another library computes, until the context ends.

    Idle workers of Dr.Jit wait actively for up to 20 ms, during which a threaded FFT would get half of every core. The
    number of threads is shared by the whole process: the first Python thread to enter sets it to one, and the last to
    leave restores it. On CUDA they have nothing to do, and stay.
    """
    if on_cuda():
        yield
        return
    global _resting, _busy_threads
    with _rest_lock:
        if _resting == 0:
            # No thread is taken from kernels at work.
            dr.sync_thread()
            _busy_threads = dr.thread_count()
            stop_threads()
        _resting += 1
    try:
        yield
    finally:
        with _rest_lock:
            _resting -= 1
            if _resting == 0:
                dr.set_thread_count(_busy_threads)


@contextmanager
def busy_drjit() -> Iterator[None]:
    """Restore Dr.Jit's threads, within a context of `resting_drjit`, until this context ends."""
    with _rest_lock:
        resting = _resting > 0
        if resting:
            dr.set_thread_count(_busy_threads)
    try:
        yield
    finally:
        with _rest_lock:
            if resting and _resting > 0:
                stop_threads()


def stop_threads() -> None:
    """Stop all threads of Dr.Jit but the calling one.

    A thread that falls asleep at this very moment can miss the request, and `drjit.set_thread_count` then waits
    forever: in nanothread, `pool_set_size` looks for sleepers before the request is certain to be visible. An empty
    task wakes the thread. It is passed to nanothread directly, since Dr.Jit believes the thread is gone and would run a
    kernel in the calling thread; the request is made in another thread, without the interpreter's lock.
    """
    if dr.thread_count() == 1:
        return
    nanothread = _nanothread()
    if nanothread is None:
        dr.set_thread_count(1)
        return
    request = _requests().submit(nanothread.pool_set_size, None, 1, 0)
    # Threads of Dr.Jit that should have stopped are woken after a tenth of a second.
    while not wait([request], 0.1).done:
        # Of two units, asynchronously, so that it is queued.
        nanothread.task_wait_and_release(nanothread.task_submit_dep(None, None, 0, 2, None, None, 0, None, 1, 0))


@functools.cache
def _nanothread() -> Any:
    """Return the library of Dr.Jit's threads (nanothread), None if it is not found."""
    count = ctypes.c_uint32
    pointer = ctypes.c_void_p
    flag = ctypes.c_int
    for path in Path(dr.__file__).parent.glob("*nanothread.*"):
        with contextlib.suppress(OSError, AttributeError):
            library = ctypes.CDLL(str(path))
            library.pool_set_size.argtypes = (pointer, count, flag)
            library.pool_set_size.restype = None
            library.task_submit_dep.argtypes = (
                pointer, pointer, count, count, pointer, pointer, count, pointer, flag, flag
            )  # fmt: skip
            library.task_submit_dep.restype = pointer
            library.task_wait_and_release.argtypes = (pointer,)
            library.task_wait_and_release.restype = None
            return library
    return None


@functools.cache
def _requests() -> ThreadPoolExecutor:
    """Return the thread that makes requests to Dr.Jit's threads."""
    return ThreadPoolExecutor(1)


def fft(
    field: Field, *, axis: int, inverse: bool = False, norm: str | None = None, workers: int | None = None
) -> Field:
    """Return a field transformed along one axis, in place where the library can."""
    return _transform("ifft" if inverse else "fft", field, workers, axis=axis, norm=norm)


def fft2(field: Field, *, inverse: bool = False, workers: int | None = None) -> Field:
    """Return a field (..., rows, columns) transformed over its last two axes, like `fft` over one axis."""
    return _transform("ifft2" if inverse else "fft2", field, workers)


def rfft(samples: Floats, *, axis: int) -> Field:
    """Return the spectrum of real samples along one axis, at nonnegative frequencies."""
    return _transform("rfft", samples, None, axis=axis)


def irfft(spectrum: Field, count: int, *, axis: int) -> Floats:
    """Return `count` real samples along one axis from a spectrum of `rfft`, which is overwritten."""
    return _transform("irfft", spectrum, None, n=count, axis=axis)


def _transform(name: str, field: Any, workers: int | None, **options: Any) -> Any:
    libraries = backend_of(field)
    if not libraries.is_cuda:
        options["workers"] = workers or worker_count()
    return getattr(libraries.transforms, name)(field, overwrite_x=True, **options)


def fft2_packed(packed: Any, shape: tuple[int, ...], *, inverse: bool = False) -> Any:
    """Return the transform of a field (rows, columns) in a flat Dr.Jit array of 64-bit words (see `pack`).

    The result is an array of the same type; the memory of the input may be overwritten.
    """
    words = type(packed)
    field = as_field(packed, shape)
    with resting_drjit():
        field = fft2(field, inverse=inverse)
    return drjit_array(words, as_words(field))


def pack(field: Any) -> Any:
    """Return a Dr.Jit complex array (``Complex2f``) as 64-bit words, without gradient."""
    types = array_types(field.real)
    real, imaginary = (
        types.UInt64(dr.reinterpret_array(types.UInt32, component)) for component in (field.real, field.imag)
    )
    return real | (imaginary << 32)


def unpack(packed: Any) -> Any:
    """Return 64-bit words as a Dr.Jit complex array (``Complex2f``), without gradient."""
    types = array_types(packed)
    real = types.UInt32(packed)
    imaginary = types.UInt32(packed >> 32)
    return types.Complex2f(dr.reinterpret_array(types.Float, real), dr.reinterpret_array(types.Float, imaginary))


def as_field(packed: Any, shape: tuple[int, ...]) -> Field:
    """Return the evaluated memory of a flat Dr.Jit array of 64-bit words as a complex field."""
    dr.eval(packed)
    return backend_of(packed).from_drjit(packed).view(np.complex64).reshape(shape)


def as_words(field: Field) -> Any:
    """Return the memory of a contiguous field, or a copy, as 64-bit words for `drjit_array`."""
    return field.reshape(-1).view(np.uint64)


def array_types(array: Any) -> Any:
    """Return Dr.Jit's module of array types for a flat array: of its backend, with or without gradients."""
    types = backend_of(array).types
    return types.ad if dr.is_diff_v(array) else types


def rows_and_columns(types: Any, rows: int, columns: int) -> Pair:
    """Return the row and the column of each sample of an image, line by line."""
    index = dr.arange(types.UInt32, rows * columns)
    row = quotient(index, columns, types)
    return row, index - row * dr.opaque(types.UInt32, columns)


def images_rows_and_columns(types: Any, images: int, rows: int, columns: int) -> Triple:
    """Return the image, the row and the column of each sample of some images, line by line."""
    index = dr.arange(types.UInt32, images * rows * columns)
    line = quotient(index, columns, types)
    image = quotient(line, rows, types)
    return (image, line - image * dr.opaque(types.UInt32, rows), index - line * dr.opaque(types.UInt32, columns))


def convolve(image: Array, kernel: Array) -> Doubles:
    """Return the full convolution of two images, n + k - 1 samples along each axis.

    Shapes: `image`, `kernel` (rows, columns).
    """
    from scipy.signal import oaconvolve  # loads slowly

    return oaconvolve(np.asarray(image, np.float64), kernel)


def blur(image: Array, kernel: Array) -> Doubles:
    """Return the convolution cropped to the image, with the kernel's middle on each sample."""
    rows, columns = ((k - 1) // 2 for k in kernel.shape)
    return convolve(image, kernel)[rows : rows + image.shape[0], columns : columns + image.shape[1]]


def fast_length(minimum: float, multiple: int = 1) -> int:
    """Return the smallest fast FFT length that is at least `minimum` and a multiple of `multiple`."""
    check_samples(minimum, "along an axis")
    return multiple * int(scipy.fft.next_fast_len(max(1, math.ceil(minimum / multiple)), real=True))


def check_samples(count: float, where: str) -> None:
    """Refuse a field with more samples along an axis than memory can hold, before conversion to integers."""
    # Written so that NaN is refused.
    refuse_if(not count <= 2**31, f"a field of {count:.3g} samples {where}: at most {2**31} can be computed")
