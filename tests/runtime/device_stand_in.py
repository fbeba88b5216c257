"""A stand-in for CuPy on a machine without a CUDA device: arrays that refuse to be mixed with NumPy's.

It follows CuPy where it differs from NumPy: nothing is converted implicitly, a transform takes no `workers`, gives a
fresh array for a view, and leaves nothing of use in what it may overwrite. Every way to the host is counted.
"""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import scipy.fft

from mitsuba_plenoptic.runtime.backend import Backend

_dr_numpy = dr.ArrayBase.numpy

_FUNCTIONS = (
    "arange", "ascontiguousarray", "bincount", "clip", "copyto", "cumsum", "einsum", "empty", "eye", "floor",
    "iscomplexobj",
    "matmul", "maximum", "moveaxis", "multiply", "ones", "pad", "repeat", "roll", "sqrt", "square", "stack",
    "tensordot", "where", "zeros",
)  # fmt: skip


class DeviceArray(np.lib.mixins.NDArrayOperatorsMixin):
    """An array that only the stand-in's functions and its own operators can read."""

    __hash__ = None

    def __init__(self, host, base=None):
        self._host, self.base = host, base

    def __array_ufunc__(self, function, method, *inputs, **options):
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
        return _wrap(self._host[_unwrap(index)], self)

    def __setitem__(self, index, value):
        self._host[_unwrap(index)] = _unwrap(value)

    def __float__(self):
        return float(self._host)

    def __complex__(self):
        return complex(self._host)

    def __getattr__(self, name):
        if name in ("shape", "size", "ndim", "dtype", "flags"):
            return getattr(self._host, name)
        if name in ("T", "real", "imag"):
            return DeviceArray(getattr(self._host, name), self)
        if name in ("astype", "conj", "copy", "ravel", "reshape", "sum", "transpose", "view"):
            return lambda *args, **kwargs: _wrap(getattr(self._host, name)(*_unwrap(args), **kwargs), self)
        raise AttributeError(name)


def _wrap(result, base=None):
    # As in CuPy, what would be a scalar stays on the device.
    return DeviceArray(np.asarray(result), base) if isinstance(result, np.ndarray | np.generic) else result


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
        host = _unwrap(x)
        result = np.ascontiguousarray(function(host.copy(), *args, **options))
        if overwrite_x and np.iscomplexobj(host):
            host[...] = np.nan
        return DeviceArray(result)

    return call


class _Matrix:
    def __init__(self, matrix):
        self._matrix = matrix

    def __matmul__(self, other):
        return DeviceArray(np.asfortranarray(self._matrix @ _unwrap(other)))


def _with_reduceat():
    add = _function(np.add)
    add.reduceat = _function(np.add.reduceat)
    return add


class StandIn:
    """The libraries of a CUDA device, in the processor's memory."""

    def __init__(self):
        self.to_host = []
        self.free, self.kept, self.total = 16 * 2**30, 0, 16 * 2**30
        arrays = SimpleNamespace(
            **{name: _function(getattr(np, name)) for name in _FUNCTIONS},
            # A universal function of CuPy has this method, too.
            **{"add": _with_reduceat()},
            ndarray=DeviceArray,
            asarray=self._asarray,
            array=self._array,
            asnumpy=self._asnumpy,
            from_dlpack=lambda array: DeviceArray(_dr_numpy(array)),
            get_default_memory_pool=lambda: SimpleNamespace(free_all_blocks=self._release),
            get_default_pinned_memory_pool=lambda: SimpleNamespace(free_all_blocks=lambda: None),
            cuda=SimpleNamespace(
                runtime=SimpleNamespace(memGetInfo=lambda: (self.free, self.total)),
                Device=lambda: SimpleNamespace(synchronize=lambda: None),
                Event=lambda: SimpleNamespace(record=lambda: None, synchronize=lambda: None),
                get_elapsed_time=lambda start, end: 1.0,
            ),
        )
        names = "fft", "ifft", "rfft", "irfft", "fft2", "ifft2"
        transforms = SimpleNamespace(**{name: _transform(getattr(scipy.fft, name)) for name in names})
        self.backend = Backend(dr.llvm, arrays, transforms, SimpleNamespace(csr_matrix=_Matrix), is_cuda=True)

    def _release(self):
        self.free, self.kept = self.free + self.kept, 0

    def _asarray(self, array, dtype=None, order="K"):
        if isinstance(array, DeviceArray):
            return array if order == "K" else DeviceArray(np.asarray(array._host, dtype, order=order))
        return DeviceArray(np.array(array, dtype, order=order))

    def _array(self, array, dtype=None, copy=True, order="K"):
        host = array._host if isinstance(array, DeviceArray) else array
        return DeviceArray(np.array(host, dtype, copy=copy, order=order))

    def _asnumpy(self, array):
        self.to_host.append(array.shape)
        return array._host.copy()
