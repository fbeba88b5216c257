"""Limits of the memory of a computation, estimated before allocation; a refusal says what would fit.

What is read, written and decoded lies in the machine's memory, `require_memory`. Fields, rays and images that Dr.Jit
and the backend's library compute lie where the active variant computes, `check_memory`: with CUDA on the device.
"""

import hashlib
import importlib.metadata
import math
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from threadpoolctl import ThreadpoolController

from ..errors import InputError, refusing, require_number
from .backend import free_device_memory

GIB = 2**30

_Fits = Callable[[float], str | None] | None

VARIABLE = "MITSUBA_PLENOPTIC_MEMORY"
"""Environment variable that sets the limit, in GiB."""

_FRACTION = 0.75
"""Fraction of a memory that is allowed by default; the rest is for what is underestimated."""

MEMORY_LIMIT = 4 * GIB
"""Largest memory in bytes for one propagation."""


def memory_limit() -> float:
    """Return the bytes that one computation may take.

    The limit is three quarters of the memory of the machine, or of the container that the process runs in; or as many
    GiB as the environment variable ``MITSUBA_PLENOPTIC_MEMORY`` says.
    """
    text = os.environ.get(VARIABLE)
    if text is None:
        return _FRACTION * _machine_memory()
    with refusing(f"{VARIABLE} = {text!r}: it must be a number of GiB", ValueError):
        gib = float(text)
    return require_number(VARIABLE, gib, positive=True) * GIB


def work_limit(needed: float) -> float:
    """Return the bytes that one computation of `needed` bytes may take where the active variant computes.

    On a CUDA device it is three quarters of the memory that is free, once caches are released if they are in the way,
    and no more than ``MITSUBA_PLENOPTIC_MEMORY`` says.
    """
    free = free_device_memory(needed / _FRACTION)
    if free is None:
        return memory_limit()
    return min(_FRACTION * free, memory_limit() if VARIABLE in os.environ else math.inf)


def require_memory(needed: float, work: str, fits: _Fits = None) -> None:
    """Refuse work that needs more of the machine's memory than is allowed."""
    _require(needed, work, fits, memory_limit(), "memory")


def check_memory(needed: float, work: str, fits: _Fits = None, *, most: float | None = None) -> None:
    """Refuse work that needs more than `most` bytes, or than `work_limit` allows where the active variant computes.

    By default `most` is `MEMORY_LIMIT`.
    """
    most = MEMORY_LIMIT if most is None else most
    name = "memory" if free_device_memory(0.0) is None else "device memory"
    _require(needed, work, fits, min(most, work_limit(needed)), name)


def _require(needed: float, work: str, fits: _Fits, limit: float, name: str) -> None:
    """Refuse work that needs more than `limit` bytes of a memory of this name."""
    for sizes in _memory_requests:
        sizes.append(needed)
    # Written so that an estimate that is not a number is refused too.
    if needed <= limit:
        return
    hint = fits(limit) if fits else None
    raise InputError(
        f"{work}: it would need {_gib(needed)} of {name}, at most {_gib(limit)} are allowed"
        + (f"; {hint} would fit" if hint else "")
        + unit_hint(needed, limit)
    )


_memory_requests: list[list[float]] = []


@contextmanager
def memory_asked() -> Iterator[list[float]]:
    """Collect the bytes of all computations that ask for memory within the context."""
    sizes: list[float] = []
    _memory_requests.append(sizes)
    try:
        yield sizes
    finally:
        _memory_requests.remove(sizes)


def unit_hint(needed: float, limit: float) -> str:
    """Return a sentence to add to a refusal of memory, if lengths are probably not in millimetres."""
    # Estimates of 64 times the limit are rather of lengths in other units.
    return "; lengths are millimetres: check their unit" if not needed <= 64 * limit else ""


def largest_fitting(estimate: Callable[[int], float], limit: float, highest: int) -> int:
    """Return the largest count whose estimate is within a limit, for an estimate that grows with the count."""
    low = 0
    high = highest + 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if estimate(middle) <= limit else (low, middle)
    return low


def require_memory_for(
    memory: Callable[[int], float], size: int, work: str, words: Callable[[int], str], *, computed: bool = False
) -> None:
    """Refuse work of a size, whose bytes `memory` gives; `words` state a size that fits.

    It lies in the machine's memory, or is `computed` where the active variant computes.
    """

    def fitting(limit: float) -> str | None:
        largest = largest_fitting(memory, limit, size)
        return words(largest) if largest else None

    if computed:
        check_memory(memory(size), work, fitting, most=math.inf)
    else:
        require_memory(memory(size), work, fitting)


# The memory of a machine does not change.
@cache
def _machine_memory() -> float:
    """Bytes of memory of the machine or of the container, whichever has less."""
    try:
        machine = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, OSError, ValueError):
        # What most machines have at least.
        machine = 8 * GIB
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            text = Path(name).read_text().strip()
        except OSError:
            continue
        if text.isdecimal():
            machine = min(machine, float(text))
    return machine


def _gib(size: float) -> str:
    return f"{size / GIB:.0f} GiB" if size >= 10 * GIB else f"{size / GIB:.1f} GiB"


# The versions are those of the loaded modules.
@cache
def software() -> dict[str, str]:
    """Return {package: version} for all packages that results depend on, and a source hash for this package."""
    package = Path(__file__).parent.parent
    text = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        text.update(source.read_bytes())
    versions = {name: importlib.metadata.version(name) for name in ("mitsuba", "drjit", "numpy", "scipy")}
    return {**versions, "mitsuba_plenoptic": text.hexdigest()[:16]}


_limiting = threading.Lock()
_limits: list = []


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Keep NumPy's and SciPy's linear algebra on the calling thread; a context, or a decorator when called.

    The limit is that of the process: of contexts that overlap in several threads, the last to end lifts it.
    """
    with _limiting:
        if not _limits:
            _allow_this_thread()
        _limits.append(_limits[0] if _limits else _libraries().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _limiting:
            limit = _limits.pop()
            if not _limits:
                _allow_this_thread()
                limit.restore_original_limits()


def _allow_this_thread() -> None:
    """Let the calling thread set limits: from version 3.8 on threadpoolctl obeys the first thread alone, in silence."""
    for library in _libraries().lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)


@cache
def _libraries() -> ThreadpoolController:
    """Return the linear algebra libraries, cached as finding them takes longer than many a product."""
    # SciPy may have a library of its own, which is found once it is loaded.
    import scipy.linalg  # noqa: F401

    return ThreadpoolController()
