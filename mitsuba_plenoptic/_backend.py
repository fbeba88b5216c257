"""Which Dr.Jit array module to compute with, outside of Mitsuba's plugins, and whether this process can at all."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from types import ModuleType
from typing import ParamSpec, TypeVar

import drjit as dr
import mitsuba as mi

from . import _llvm
from .errors import InputError

_P = ParamSpec("_P")
_R = TypeVar("_R")

_turn = threading.RLock()
_started = False
_forked = False


def _after_fork() -> None:
    global _forked
    _forked = _forked or _started or mi.variant() is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def require_own_process() -> None:
    """Make sure that Dr.Jit's threads are this process's own: without them it waits for ever, sooner or later.

    Raises
    ------
    InputError
        If the process was forked from one in which Dr.Jit was at work.
    """
    if _forked:
        raise InputError(
            "process: it was forked from one in which Dr.Jit was at work, and has none of its threads; start it with "
            "multiprocessing.get_context('spawn')"
        )


def one_at_a_time(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let only one thread at a time into all functions that are decorated so.

    Mitsuba's loader changes where the whole process looks for files, and Dr.Jit confuses arrays when two threads trace
    scenes at once. Nothing is lost: each computation has all cores to itself.
    """

    @functools.wraps(function)
    def in_turn(*arguments: _P.args, **options: _P.kwargs) -> _R:
        require_own_process()
        with _turn:
            return function(*arguments, **options)

    return in_turn


def array_module() -> ModuleType:
    """Give `drjit.cuda` where a CUDA variant of Mitsuba is active and `drjit.llvm` elsewhere.

    Raises
    ------
    InputError
        If LLVM is needed and no usable one was found, or the process was forked while Dr.Jit was at work.
    """
    global _started
    require_own_process()
    _started = True
    if (mi.variant() or "").startswith("cuda"):
        return dr.cuda
    _llvm.require()
    return dr.llvm
