"""A stand-in for CuPy on a machine without a CUDA device: arrays that refuse to be mixed with NumPy's.

It follows CuPy where it differs from NumPy: it has CuPy's functions and methods alone, by the names of CuPy 14.2 in
``cupy_names.txt``; nothing is converted implicitly; what would be a scalar stays on the device; a transform takes no
`workers`, gives a fresh array for a view, and leaves nothing of use in what it may overwrite; along an axis that is not
the last, its result lies in memory as if that axis were the last. Every way to the host is counted, that of a single
number, as in ``float(x)`` and ``if x:``, too; and so is every call that starts a kernel.
"""

import functools
import sys
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import numpy as np
import scipy.fft
import scipy.sparse

from mitsuba_plenoptic.runtime.backend import Backend

_dr_numpy = dr.ArrayBase.numpy


def recorded_names():
    """Return CuPy's names, of functions, methods, transforms and methods of universal functions."""
    parts = (Path(__file__).parent / "cupy_names.txt").read_text().split("# ")[1:]
    return {title: frozenset(" ".join(lines).split()) for title, *lines in (part.splitlines() for part in parts)}


NAMES = recorded_names()

_ATTRIBUTES = ("shape", "size", "ndim", "dtype", "flags", "itemsize", "nbytes", "strides")
_VIEWS = ("T", "real", "imag")
_TO_HOST = ("get", "item", "tolist", "tobytes")
_WITHOUT_KERNEL = ("reshape", "transpose", "view", "swapaxes", "squeeze", "empty", "broadcast_to", "moveaxis", "split")


def forget():
    """Empty the caches of all functions, whose results were computed by the other libraries."""
    for name, module in list(sys.modules.items()):
        if name.startswith("mitsuba_plenoptic"):
            for value in list(vars(module).values()):
                for each in (value, *(vars(value).values() if isinstance(value, type) else ())):
                    if isinstance(each, functools._lru_cache_wrapper):
                        each.cache_clear()


def _scalar(kind):
    def number(self):
        DeviceArray.scalars += 1
        return kind(self._host)

    return number


class DeviceArray(np.lib.mixins.NDArrayOperatorsMixin):
    """An array that only the stand-in's functions and its own operators can read."""

    __hash__ = None
    # The numbers that have left the device one by one, and the kernels started, of all arrays.
    scalars = launches = 0

    def __init__(self, host, base=None):
        self._host, self.base = host, base

    def __array_ufunc__(self, function, method, *inputs, **options):
        if function.__name__ not in NAMES["functions"]:
            raise TypeError(f"CuPy has no universal function {function.__name__}")
        DeviceArray.launches += 1
        result = getattr(function, method)(*_unwrap(inputs), **_unwrap_options(options))
        return options["out"][0] if "out" in options else _wrap(result)

    def __array__(self, *args, **kwargs):
        raise TypeError("implicit conversion to a NumPy array is not allowed")

    __array_interface__ = property(__array__)

    def __dlpack__(self, **kwargs):
        return self._host.__dlpack__(**kwargs)

    def __dlpack_device__(self):
        return self._host.__dlpack_device__()

    def __len__(self):
        return len(self._host)

    def __iter__(self):
        return (DeviceArray(part, self) for part in self._host)

    def __getitem__(self, index):
        indices = index if isinstance(index, tuple) else (index,)
        DeviceArray.launches += any(isinstance(each, DeviceArray | list) for each in indices)
        return _wrap(self._host[_unwrap(index)], self)

    def __setitem__(self, index, value):
        DeviceArray.launches += 1
        self._host[_unwrap(index)] = _unwrap(value)

    __float__, __complex__, __int__, __index__, __bool__ = map(_scalar, (float, complex, int, int, bool))

    def __getattr__(self, name):
        if name in _ATTRIBUTES:
            return getattr(self._host, name)
        if name in _VIEWS:
            return DeviceArray(getattr(self._host, name), self)
        if name not in NAMES["methods"] or name in _TO_HOST:
            raise AttributeError(f"{name}: no method of CuPy's arrays that stays on the device")
        DeviceArray.launches += name not in _WITHOUT_KERNEL
        return lambda *args, **kwargs: _wrap(getattr(self._host, name)(*_unwrap(args), **_unwrap_options(kwargs)), self)


def _wrap(result, base=None):
    if isinstance(result, np.ndarray | np.generic):
        return DeviceArray(np.asarray(result), base)
    return type(result)(_wrap(part, base) for part in result) if isinstance(result, tuple | list) else result


def _unwrap(value):
    if isinstance(value, DeviceArray):
        return value._host
    if isinstance(value, tuple | list):
        return type(value)(_unwrap(part) for part in value)
    if isinstance(value, np.ndarray):
        raise TypeError(f"a NumPy array of shape {value.shape} is mixed with arrays on the device")
    return value


def _function(function):
    def call(*args, out=None, **kwargs):
        DeviceArray.launches += getattr(function, "__name__", "") not in _WITHOUT_KERNEL
        given = {} if out is None else {"out": _unwrap(out)}
        result = function(*_unwrap(args), **_unwrap_options(kwargs), **given)
        return _wrap(result) if out is None else out

    return call


def _unwrap_options(options):
    return {name: _unwrap(value) for name, value in options.items()}


def _transform(function):
    def call(x, *args, overwrite_x=False, **options):
        if "workers" in options:
            raise TypeError("a transform on the device takes no workers")
        DeviceArray.launches += 1
        host = _unwrap(x)
        axis = options.get("axes", [options.get("axis", -1)])[-1]
        result = function(host.copy(), *args, **options)
        result = np.ascontiguousarray(result.swapaxes(axis, -1)).swapaxes(axis, -1)
        if overwrite_x and np.iscomplexobj(host):
            host[...] = np.nan
        return DeviceArray(result)

    return call


class _Named:
    """Functions of a library of the processor, of which CuPy has these names alone."""

    def __init__(self, library, names, wrap, **own):
        self._library, self._names, self._wrap = library, names, wrap
        vars(self).update(own)

    def __getattr__(self, name):
        if name.startswith("_") or name not in self._names:
            raise AttributeError(f"CuPy has no function {name}")
        given = getattr(self._library, name)
        made = self._wrap(given)
        for method in NAMES["ufunc methods"] if isinstance(given, np.ufunc) else ():
            setattr(made, method, _function(getattr(given, method)))
        return made


class _Matrix:
    def __init__(self, matrix):
        self._matrix = matrix

    @classmethod
    def csr(cls, given, shape=None):
        """Return a matrix of one of NumPy's, or of values, columns and pointers on the device."""
        host = _unwrap(given) if isinstance(given, tuple) else given
        return cls(scipy.sparse.csr_matrix(host, shape=shape))

    @property
    def T(self):
        return _Matrix(self._matrix.T)

    def __matmul__(self, other):
        DeviceArray.launches += 1
        return DeviceArray(np.asfortranarray(self._matrix @ _unwrap(other)))


class StandIn:
    """The libraries of a CUDA device, in the processor's memory."""

    def __init__(self):
        self.to_host = []
        # The device's memory, in bytes, and what a library keeps of it.
        self.free, self.kept, self.total = 16 * 2**30, 0, 16 * 2**30
        self._before = DeviceArray.scalars, DeviceArray.launches
        arrays = _Named(
            np,
            NAMES["functions"],
            _function,
            ndarray=DeviceArray,
            asarray=self._asarray,
            array=self._array,
            asnumpy=self._asnumpy,
            from_dlpack=lambda array: DeviceArray(_dr_numpy(array)),
            lib=SimpleNamespace(stride_tricks=SimpleNamespace(as_strided=_function(np.lib.stride_tricks.as_strided))),
            get_default_memory_pool=lambda: SimpleNamespace(free_all_blocks=self._release),
            get_default_pinned_memory_pool=lambda: SimpleNamespace(free_all_blocks=lambda: None),
            cuda=SimpleNamespace(
                runtime=SimpleNamespace(memGetInfo=lambda: (self.free, self.total)),
                Device=lambda: SimpleNamespace(synchronize=lambda: None),
                Event=lambda: SimpleNamespace(record=lambda: None, synchronize=lambda: None),
                get_elapsed_time=lambda start, end: 1.0,
            ),
        )
        transforms = _Named(scipy.fft, NAMES["transforms"], _transform)
        self.backend = Backend(dr.llvm, arrays, transforms, SimpleNamespace(csr_matrix=_Matrix.csr), is_cuda=True)

    @property
    def scalars(self):
        """Numbers that have left the device one by one."""
        return DeviceArray.scalars - self._before[0]

    @property
    def launches(self):
        """Kernels started by the array library."""
        return DeviceArray.launches - self._before[1]

    def _release(self):
        self.free, self.kept = self.free + self.kept, 0

    def _asarray(self, array, dtype=None, order="K"):
        if isinstance(array, DeviceArray):
            if order == "K" and dtype in (None, array.dtype):
                return array
            return DeviceArray(np.asarray(array._host, dtype, order=order))
        return DeviceArray(np.array(array, dtype, order=order))

    def _array(self, array, dtype=None, copy=True, order="K"):
        host = array._host if isinstance(array, DeviceArray) else array
        return DeviceArray(np.array(host, dtype, copy=copy, order=order))

    def _asnumpy(self, array):
        self.to_host.append(array.shape)
        return array._host.copy()
