"""Two-dimensional Fourier transforms of fields: SciPy on the processor, CuPy on CUDA, under Dr.Jit arrays.

Dr.Jit has no FFT of its own. A field travels between the libraries without being copied, as one 64-bit word
per sample whose lower half is the real part and whose upper half is the imaginary part: that is how NumPy and
CuPy lay out ``complex64``, and a Dr.Jit kernel takes the halves apart again at no cost.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr
import numpy as np
import scipy.fft
from numpy.typing import NDArray

Field = NDArray[np.complex64]

_rest = threading.Lock()
_resting = 0
_busy_threads = 0


def worker_count() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def resting_drjit() -> Iterator[None]:
    """Keep Dr.Jit's own threads off the processor cores while another library uses them.

    Its idle workers wait actively for up to 20 ms, during which a threaded FFT would get half of every core. The
    number of its threads is one for the whole process: the first of several Python threads to come here sets it to
    one, and the last to leave restores it.
    """
    global _resting, _busy_threads
    with _rest:
        if _resting == 0:
            _busy_threads = dr.thread_count()
            dr.set_thread_count(1)
        _resting += 1
    try:
        yield
    finally:
        with _rest:
            _resting -= 1
            if _resting == 0:
                dr.set_thread_count(_busy_threads)


def fft2(field: Field, *, inverse: bool = False, workers: int | None = None) -> Field:
    """Transform a field over its last two axes, in place where the library can.

    Parameters
    ----------
    field : complex64 array (..., rows, columns)
        Overwritten.
    inverse : bool
        Whether to transform with a positive exponent and divide by the number of samples.
    workers : int, optional
        Threads. Default: all cores this process may use.

    Returns
    -------
    complex64 array (..., rows, columns)
        Zero frequency first.
    """
    transform = scipy.fft.ifft2 if inverse else scipy.fft.fft2
    return transform(field, overwrite_x=True, workers=workers or worker_count())


def fft2_packed(packed: Any, shape: tuple[int, ...], *, inverse: bool = False) -> Any:
    """Transform a field held in a flat Dr.Jit array of 64-bit words (see `pack`).

    Parameters
    ----------
    packed : UInt64 array of Dr.Jit, size rows * columns
        Its memory may be overwritten.
    shape : (int, int)
        Rows and columns.
    inverse : bool
        As for `fft2`.

    Returns
    -------
    UInt64 array of the same type
    """
    kind = type(packed)
    dr.eval(packed)
    if dr.backend_v(kind) == dr.JitBackend.CUDA:
        return kind(_fft2_cuda(packed, shape, inverse))
    dr.sync_thread()  # the kernel that writes the words runs asynchronously
    field = packed.numpy().view(np.complex64).reshape(shape)
    with resting_drjit():
        field = fft2(field, inverse=inverse)
    return kind(field.reshape(-1).view(np.uint64))


def _fft2_cuda(packed: Any, shape: tuple[int, ...], inverse: bool) -> Any:
    # CuPy works in the CUDA context of Dr.Jit; their streams wait for each other.
    import cupy  # type: ignore[import-not-found, unused-ignore]

    field = cupy.from_dlpack(packed).view(cupy.complex64).reshape(shape)
    field = cupy.fft.ifft2(field) if inverse else cupy.fft.fft2(field)
    return cupy.ascontiguousarray(field).reshape(-1).view(cupy.uint64)


def pack(field: Any) -> Any:
    """Lay a Dr.Jit complex array (``Complex2f``) out as 64-bit words. Carries no gradient."""
    types = array_types(field.real)
    real, imaginary = (types.UInt64(dr.reinterpret_array(types.UInt32, part)) for part in (field.real, field.imag))
    return real | (imaginary << 32)


def unpack(packed: Any) -> Any:
    """Take 64-bit words apart into a Dr.Jit complex array (``Complex2f``). Carries no gradient."""
    types = array_types(packed)
    real, imaginary = types.UInt32(packed), types.UInt32(packed >> 32)
    return types.Complex2f(dr.reinterpret_array(types.Float, real), dr.reinterpret_array(types.Float, imaginary))


def array_types(array: Any) -> Any:
    """Dr.Jit's module of array types that go with a flat array: of its backend, with or without gradients."""
    backend: Any = dr.cuda if dr.backend_v(array) == dr.JitBackend.CUDA else dr.llvm
    return backend.ad if dr.is_diff_v(array) else backend


class _FourierTransform(dr.CustomOp):
    """The transform and its adjoint: for x -> F x that is F^H = rows * columns * F^-1, and the reverse."""

    def eval(self, field: Any, shape: tuple[int, int], inverse: bool) -> Any:
        self.shape, self.inverse = shape, inverse
        return unpack(fft2_packed(pack(field), shape, inverse=inverse))

    def forward(self) -> None:
        gradient = self.grad_in("field")
        self.set_grad_out(unpack(fft2_packed(pack(gradient), self.shape, inverse=self.inverse)))

    def backward(self) -> None:
        gradient = unpack(fft2_packed(pack(self.grad_out()), self.shape, inverse=not self.inverse))
        samples = self.shape[0] * self.shape[1]
        self.set_grad_in("field", gradient / samples if self.inverse else gradient * samples)


def fft2_differentiable(field: Any, shape: tuple[int, int], *, inverse: bool = False) -> Any:
    """Transform a Dr.Jit complex array, with gradients in both directions.

    Parameters
    ----------
    field : Complex2f of Dr.Jit, size rows * columns
        Left as it is.
    shape : (int, int)
        Rows and columns.
    inverse : bool
        As for `fft2`.

    Returns
    -------
    Complex2f of Dr.Jit, size rows * columns
    """
    return dr.custom(_FourierTransform, field, shape, inverse)
