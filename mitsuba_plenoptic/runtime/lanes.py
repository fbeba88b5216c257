"""The progress of Dr.Jit's kernels while they run, from a count of their lanes that other threads can read."""

from __future__ import annotations

import contextlib
import ctypes
import threading
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

import drjit as dr
import mitsuba as mi

from .backend import on_cuda

_INTERVAL = 0.25
"""Seconds between two reports of a kernel."""

_count: ContextVar[Any] = ContextVar("count", default=None)


def count_lanes(lanes: int) -> None:
    """Let the kernel that is being recorded count its lanes, if anyone asks for them: see `lanes_reported`."""
    if (count := _count.get()) is not None:
        # Without a copy of the count for each thread, which Dr.Jit would add up at the end.
        dr.scatter_add(count, mi.UInt32(1), dr.zeros(mi.UInt32, lanes), mode=dr.ReduceMode.Local)


@contextlib.contextmanager
def lanes_reported(report: Callable[[float], None] | None, lanes: int) -> Iterator[None]:
    """Report the fraction of lanes that kernels within the context have counted, from a thread while they run.

    What the report raises is raised at the end of the context. On CUDA nothing is reported.
    """
    if report is None or on_cuda():
        yield
        return
    count = dr.zeros(mi.UInt32, 1)
    dr.make_opaque(count)
    dr.sync_thread()
    counted = ctypes.c_uint32.from_address(count.numpy().ctypes.data)
    ended = threading.Event()
    errors: list[BaseException] = []

    def watch() -> None:
        try:
            while not ended.wait(_INTERVAL):
                if counted.value:
                    report(min(counted.value / lanes, 1.0))
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=watch, daemon=True)
    before = _count.set(count)
    thread.start()
    try:
        yield
    finally:
        _count.reset(before)
        ended.set()
        thread.join()
    if errors:
        raise errors[0]
