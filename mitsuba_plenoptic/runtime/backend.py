"""The libraries used outside of Mitsuba's plugins: Dr.Jit with NumPy and SciPy, or with CuPy.

Mitsuba's active variant determines them. The same code runs on both: it takes its modules from here, and arrays created
on a CUDA device stay there until `Backend.to_host` fetches finished results. Dr.Jit and CuPy share the memory of their
arrays by DLPack, and CuPy's default stream and Dr.Jit's wait for each other, as CUDA defines it for the legacy default
stream.

Floats, NumPy arrays and Dr.Jit arrays name a few operations differently; this module gives each operation one name. All
arrays that users give are read here: what a plain array of numbers would lose is followed or refused.
"""

import functools
import importlib
import logging
import math
import os
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..errors import NO_ARRAY, InputError, refuse_if, refusing, require_choice, short_repr
from . import llvm

Array = NDArray
Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]
"""Arrays, of any numbers or by the type of their numbers."""

Shape = tuple[int, int]
"""Numbers of rows and columns, or of columns and rows."""

Sizes = tuple[int, ...]
Numbers = tuple[float, ...]
"""Shape of an array, and any number of coefficients, lengths or wavelengths."""

Named = dict[str, Any]
Facts = Mapping[str, Any]
"""Values by name: parameters, options, facts of a file; those of `Facts` stay as they are."""

Pair = tuple[Any, Any]
Triple = tuple[Any, Any, Any]
"""Two and three numbers or arrays of the backend, such as coordinates in a plane and in space."""

_P = ParamSpec("_P")
_R = TypeVar("_R")

_log = logging.getLogger(__name__)

_process_lock = threading.RLock()
_started = False
_forked = False


def _after_fork() -> None:
    global _forked
    _forked = _forked or _started or mi.variant() is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def require_own_process() -> None:
    """Refuse a forked process, which lacks Dr.Jit's threads and would wait forever."""
    refuse_if(
        _forked,
        "process: it was forked from one in which Dr.Jit was at work, and has none of its threads; start it with "
        "multiprocessing.get_context('spawn')",
    )


def require_unfrozen(work: str) -> None:
    """Refuse to compute while `dr.freeze` records a function: replays repeat kernels, and no work of the host."""
    refuse_if(
        dr.flag(dr.JitFlag.FreezingScope),
        f"{work}: dr.freeze: it repeats Dr.Jit's kernels alone, and a part of this is computed outside of them; "
        "call it outside of frozen functions",
    )


def one_at_a_time(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let only one thread at a time into all functions with this decorator.

    Mitsuba's loader changes where the whole process looks for files, and Dr.Jit confuses arrays if two threads trace
    scenes at once. No time is lost, since each computation uses all cores.
    """

    @functools.wraps(function)
    def in_turn(*arguments: _P.args, **options: _P.kwargs) -> _R:
        require_own_process()
        require_unfrozen(function.__name__)
        with _process_lock:
            try:
                return function(*arguments, **options)
            finally:
                # Kernels that nobody waits for may still read NumPy's arrays, which the caller is free to drop.
                dr.sync_thread()

    return in_turn


_PACKET = 16
_ALIGNMENT = 64
"""Numbers that kernels of Dr.Jit read at once, and bytes on which they may rely for that, at most."""


def drjit_array(kind: Any, numbers: Any) -> Any:
    """Return an array of a Dr.Jit type with the numbers of a NumPy or CuPy array, or of a plain list.

    Dr.Jit shares memory with NumPy, and compiles separate kernels for NumPy memory that is not aligned to whole
    packets, which depends on `malloc`. All NumPy arrays are therefore passed to Dr.Jit through this function.
    """
    if isinstance(numbers, np.ndarray):
        numbers = packets(numbers, np.dtype(dr.type_v(kind).name.lower()))
    elif not hasattr(numbers, "shape"):
        return kind(numbers)
    if dr.is_tensor_v(kind):
        return kind(dr.array_t(kind)(numbers.reshape(-1)), numbers.shape)
    return kind(numbers.reshape(-1))


def interleaved(parts: list) -> Any:
    """Return one Dr.Jit array with the first number of each of some arrays, then the second ones, and so on."""
    count = dr.width(parts)
    numbers = dr.empty(type(parts[0]), dr.width(parts) * len(parts))
    dr.scatter(numbers, mi.ArrayXf(parts), dr.arange(mi.UInt32, count))
    return numbers


def packets(array: NDArray, kind: Any = None) -> NDArray:
    """Return a NumPy array, or a copy of it in another type, in memory from which kernels read whole packets.

    Kernels also read beyond the end of an array. If the array ends with a page, and the next page does not belong to
    the process, this read would end the process. Arrays not known to own their whole last packet are therefore copied,
    too.
    """
    kind = array.dtype if kind is None else np.dtype(kind)
    if array.dtype == kind and array.flags.c_contiguous and array.ctypes.data % _ALIGNMENT == 0:
        owner = array
        while isinstance(owner.base, np.ndarray):
            owner = owner.base
        end = owner.ctypes.data + (owner.nbytes if owner.flags.c_contiguous else 0)
        if array.ctypes.data + _whole_packets(array.size) * array.itemsize <= end:
            return array
    copy = empty_packets(array.shape, kind)
    copy[...] = array
    return copy


def _whole_packets(count: int) -> int:
    """Return the size of the whole packets that hold `count` numbers."""
    return -(-count // _PACKET) * _PACKET


def empty_packets(shape: tuple[int, ...], kind: Any) -> NDArray:
    """Return an uninitialised NumPy array whose memory `packets` need not copy."""
    count = math.prod(shape)
    size = np.dtype(kind).itemsize
    memory = np.empty(_whole_packets(count) * size + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    return memory[start : start + count * size].view(kind).reshape(shape)


@dataclass(frozen=True)
class Backend:
    """The array, FFT and sparse libraries for one type of processor."""

    # Types of Dr.Jit's arrays, without gradients.
    types: Any
    # NumPy, or CuPy, which has its functions.
    arrays: Any
    # `scipy.fft` or `cupyx.scipy.fft`.
    transforms: Any
    # `scipy.sparse` or `cupyx.scipy.sparse`.
    sparse: Any
    # Whether the arrays lie on a CUDA device.
    is_cuda: bool

    def empty(self, shape: tuple[int, ...], kind: Any) -> Any:
        """Return an uninitialised array of the library `arrays`, which `drjit_array` need not copy."""
        return self.arrays.empty(shape, kind) if self.is_cuda else empty_packets(shape, kind)

    def from_drjit(self, array: Any) -> Any:
        """Return the memory of a flat Dr.Jit array as an array of the library `arrays`, perhaps not yet computed."""
        return self.arrays.from_dlpack(array) if self.is_cuda else array.numpy()

    def to_host(self, array: Any) -> NDArray:
        """Return a finished array in NumPy's memory."""
        return self.arrays.asnumpy(array) if self.is_cuda else array

    def free_memory(self) -> float:
        """Return the bytes that are free on the CUDA device; what the libraries keep for later is not."""
        return float(self.arrays.cuda.runtime.memGetInfo()[0])

    def release(self) -> None:
        """Give the memory that is not in use back to the device: neither library takes it from the other's cache."""
        if self.is_cuda:
            dr.sync_thread()
            self.arrays.cuda.Device().synchronize()
            dr.flush_malloc_cache()
            self.arrays.get_default_memory_pool().free_all_blocks()
            self.arrays.get_default_pinned_memory_pool().free_all_blocks()


def active_backend() -> Backend:
    """Return the libraries for the active variant: CUDA's for a CUDA variant, the processor's elsewhere."""
    return _cuda() if on_cuda() else _processor()


def free_device_memory(needed: float) -> float | None:
    """Return the bytes free on the active variant's device, None for the processor's variants or without CuPy.

    Where they are fewer than needed, what the libraries keep is released first.
    """
    if not on_cuda():
        return None
    try:
        device = _cuda()
    except InputError:
        return None
    if device.free_memory() < needed:
        device.release()
    return device.free_memory()


def on_cuda() -> bool:
    """Return whether the active variant computes on a CUDA device."""
    return array_module() is dr.cuda


def backend_of(array: Any) -> Backend:
    """Return the libraries for a Dr.Jit, NumPy or CuPy array, by the memory it lies in."""
    if dr.is_array_v(array):
        return _cuda() if dr.backend_v(array) == dr.JitBackend.CUDA else _processor()
    return _processor() if isinstance(array, np.ndarray) else _cuda()


def array_module() -> Any:
    """Return Dr.Jit's types for the active variant; unlike `active_backend` this needs no CuPy."""
    global _started
    require_own_process()
    _started = True
    if (mi.variant() or "").startswith("cuda"):
        return dr.cuda
    return _usable_llvm()


# One for the process: Dr.Jit loads one LLVM.
@functools.cache
def _usable_llvm() -> Any:
    reason = llvm.problem()
    refuse_if(reason, str(reason))
    return dr.llvm


# One for the process: it holds no data of a camera.
@functools.cache
def _processor() -> Backend:
    return Backend(dr.llvm, np, scipy.fft, scipy.sparse, is_cuda=False)


# One for the process, as importing CuPy and asking for the device take long.
@functools.cache
def _cuda() -> Backend:
    try:
        cupy, transforms, sparse = map(importlib.import_module, ("cupy", "cupyx.scipy.fft", "cupyx.scipy.sparse"))
    except ImportError as missing:
        raise InputError(
            f"variant {mi.variant()}: waves on CUDA need CuPy, which does not load ({missing}); "
            "pip install cupy-cuda12x, or cupy-cuda13x by the driver's CUDA"
        ) from None
    return Backend(dr.cuda, cupy, transforms, sparse, is_cuda=True)


DEFAULT_VARIANT = "llvm_ad_mono"


@one_at_a_time
def set_variant(variant: str | None) -> None:
    """Set a Mitsuba variant, or the default one if none is named and none is active."""
    variant = variant or mi.variant() or DEFAULT_VARIANT
    require_choice("variant", variant, mi.variants())
    if variant.startswith("llvm"):
        _usable_llvm()
    refuse_if(
        variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA),
        f"variant = {variant!r}: no usable CUDA device was found; use an llvm_ad_* variant",
    )
    if mi.variant() != variant:
        mi.set_variant(variant)
    _log.debug("variant %s", variant)


def module_of(value: Any) -> Any:
    """Return the module whose functions take `value`: Dr.Jit or NumPy."""
    return dr if dr.is_array_v(value) else np


def floor(value: Any) -> Any:
    """Return the largest integer not greater than a value, as a float."""
    return module_of(value).floor(value)


def select(condition: Any, yes: Any, no: Any) -> Any:
    """Return `yes` where the condition holds, `no` elsewhere."""
    return dr.select(condition, yes, no) if dr.is_array_v(condition) else np.where(condition, yes, no)


def take(values: Any, index: Any) -> Any:
    """Return values of a flat table at indices given as floats, as an array of the indices' type."""
    kind = type(index)
    if not dr.is_array_v(index):
        return values[np.asarray(index, np.int64)]
    table = values if dr.is_array_v(values) else drjit_array(kind, values)
    return dr.gather(kind, table, dr.uint32_array_t(kind)(index))


def minimum(a: Any, b: Any) -> Any:
    """Return the smaller of two numbers, plain if both are plain."""
    return min(a, b) if isinstance(a, (int, float)) else module_of(a).minimum(a, b)


def maximum(a: Any, b: Any) -> Any:
    """Return the greater of two numbers, plain if both are plain."""
    return max(a, b) if isinstance(a, (int, float)) else module_of(a).maximum(a, b)


def sqrt(value: Any) -> Any:
    """Return the square root, plain for a plain number, as NumPy's would turn Dr.Jit arrays into NumPy's."""
    return float(np.sqrt(value)) if isinstance(value, (int, float)) else module_of(value).sqrt(value)


def safe_sqrt(value: Any, least: float = 1e-20) -> Any:
    """Return the square root of the value, or of `least` if that is greater, so that the derivative is finite."""
    return sqrt(maximum(value, least))


def rsqrt(value: Any) -> Any:
    """Return the reciprocal of the square root."""
    if dr.is_array_v(value):
        return dr.rsqrt(value)
    return float(1 / np.sqrt(value)) if isinstance(value, float) else 1 / np.sqrt(value)


def quotient(index: Any, divisor: int, types: Any = mi) -> Any:
    """Return the integer quotients of Dr.Jit indices below 2^32 by a divisor, in types of the active variant or others.

    They are computed as products, several times faster than Dr.Jit's integer division.
    """
    return types.UInt32((types.Float64(index) + 0.5) * dr.opaque(types.Float64, 1 / divisor))


def is_zero(value: Any) -> bool:
    """Return whether a value is a plain number equal to zero, so that products with it can be left out."""
    return isinstance(value, (int, float)) and value == 0


def turn(x: Any, y: Any, degrees: Any) -> tuple[Any, Any]:
    """Return positions turned counter-clockwise about the axis; floats, NumPy or Dr.Jit arrays."""
    if is_zero(degrees):
        return x, y
    angle = degrees * (math.pi / 180)
    # A number of NumPy would turn Dr.Jit's arrays into its own.
    module = dr if dr.is_array_v(angle) else math
    cosine = module.cos(angle)
    sine = module.sin(angle)
    return cosine * x - sine * y, sine * x + cosine * y


Names = tuple[str, ...]

IMAGE = ("y t row rows", "x s column columns", "c channel channels band")
POINTS = ("point particle", "axis channel wavelength")
"""Names of the dimensions of images, and of points and their weights, those of one meaning together."""

MILLIMETRES = "mm", "millimeter", "millimetre", "millimeters", "millimetres"
"""Names of the unit of lengths."""

BRIGHTEST = 1e30
"""Magnitude of a pixel at most: what is summed and squared of it stays within single precision's 3e38."""


def as_array(
    name: str,
    values: Any,
    dims: Names = IMAGE,
    *,
    dtype: DTypeLike | None = np.float64,
    rule: str = "",
    units: Names | None = None,
    shape: tuple[int | None, ...] | None = None,
    least: float | None = None,
) -> np.ndarray:
    """Return a new array of numbers, real ones but for a complex type; refuse masked ones, and other units than named.

    Labelled arrays, of which `dims` lists the names in order, are transposed; they may state any unit without `units`.
    With a `shape`, in which None is any size, the numbers must be finite, too, and none less than `least`.
    """
    unit = "" if units is None and hasattr(values, "attrs") else unit_of(values)
    plain = f"give plain numbers{f' in {units[0]}' if units else ''}"
    refuse_if(unit not in ("", "1", "dimensionless", *(units or ())), f"{name} in {short_repr(unit)}: {plain}")
    masked = np.count_nonzero(values.mask) if isinstance(values, np.ma.MaskedArray) else 0
    refuse_if(masked, f"{name}: {masked} of its values are masked: give an array without a mask")
    if isinstance(values, (list, tuple)):
        # NumPy would drop masks, units and names of arrays in a list.
        arrays = (hasattr(item, "__array__") and not isinstance(item, np.generic) for item in values)
        values = [
            as_array(name, item, dims[1:], dtype=None, rule=rule, units=units) if is_array else item
            for item, is_array in zip(values, arrays, strict=True)
        ]
    named = getattr(values, "dims", None)
    if isinstance(named, tuple) and len(named) > 1 and named != tuple(f"dim_{index}" for index in range(len(named))):
        order = [item for dimension in dims for item in named if item in dimension.split()]
        dimension = ", ".join(item.split()[0] for item in dims)
        refuse_if(len(order) != len(named), f"{name} with dimensions {named}: they must be {dimension}")
        values = values.transpose(*order)
    described = f"{name} = {short_repr(values)}" if isinstance(values, (str, bytes)) else name
    rule = f"{described}: {rule or 'it must be an array'}"
    refuse_if(
        getattr(values, "requires_grad", False) is True, f"{name}: it requires gradients: give it without, by detach()"
    )
    narrow = str(getattr(values, "dtype", "")).endswith("bfloat16")
    refuse_if(narrow, f"{name} of type bfloat16, which NumPy does not have: give float32")
    with refusing(rule, RuntimeError, *NO_ARRAY):
        array = np.array(values)
    refuse_if(array.dtype.kind not in "biufc", rule)
    real = array.dtype.kind != "c" or np.dtype(dtype or float).kind == "c"
    refuse_if(not real, f"{name} of type {array.dtype}: it must hold real numbers")
    array = array.astype(dtype or array.dtype, copy=False)
    if shape is not None:
        alike = array.ndim == len(shape) and all(n in (None, size) for n, size in zip(shape, array.shape, strict=True))
        sizes = ", ".join("n" if size is None else str(size) for size in shape)
        refuse_if(not alike, f"{name} of shape {array.shape}: it must be ({sizes}{',' * (len(shape) == 1)})")
        require_all(name, array, np.isfinite(array), "finite")
    if least is not None:
        require_all(name, array, array >= least, f"at least {least:g}")
    return array


def require_all(name: str, array: np.ndarray, right: np.ndarray, rule: str) -> None:
    """Refuse an array of which a number is not right, and name the first one."""
    for index in np.argwhere(~right)[:1] if not right.all() else ():
        at = f"[{', '.join(map(str, index))}]" if len(index) else ""
        raise InputError(f"{name}{at} = {array[tuple(index)]:g}: it must be {rule}")


def unit_of(values: Any) -> str:
    """Return the unit that a labelled array, or a quantity of another library, states; empty if it states none."""
    if hasattr(values, "attrs"):
        return str(values.attrs.get("units", ""))
    stated = getattr(values, "unit", getattr(values, "units", None))
    return "" if stated is None else str(stated)


def require_units(name: str, data: Any, expected: Mapping[str, Names]) -> None:
    """Refuse labelled data that states another unit of a variable than one of those named."""
    for variable, units in expected.items():
        unit = unit_of(data[variable])
        refuse_if(unit not in ("", *units), f"{name}: {variable} is in {unit}: it must be in {units[0]}")


def as_pixels(name: str, values: ArrayLike, dtype: DTypeLike | None = None) -> np.ndarray:
    """Return a new array of the pixels of an image, which are finite and not too large."""
    image = as_array(name, values, dtype=None)
    require_pixels(name, image)
    return image.astype(dtype or image.dtype, copy=False)


def require_pixels(name: str, image: np.ndarray) -> None:
    """Refuse an image with pixels that are not finite or above `BRIGHTEST`, and name their number and the first one."""
    # The largest and the smallest value show every NaN too, and cost far less than a test of each.
    if image.size == 0 or max(float(image.max()), -float(image.min())) <= BRIGHTEST:
        return
    bad = ~np.isfinite(image)
    fault = "NaN or infinite"
    rule = "finite"
    if not bad.any():
        bad = np.abs(np.float64(image)) > BRIGHTEST
        fault = "too large"
        rule = f"{BRIGHTEST:g} at most in magnitude"
    first = ", ".join(str(index) for index in np.argwhere(bad)[0])
    raise InputError(f"{name}: {bad.sum()} of its pixels are {fault}, the first at ({first}): all must be {rule}")
