"""Which Dr.Jit array module to compute with, outside of Mitsuba's plugins."""

from __future__ import annotations

from types import ModuleType

import drjit as dr
import mitsuba as mi

from . import _llvm


def array_module() -> ModuleType:
    """Give `drjit.cuda` where a CUDA variant of Mitsuba is active and `drjit.llvm` elsewhere.

    Raises
    ------
    InputError
        If LLVM is needed and no usable one was found.
    """
    if (mi.variant() or "").startswith("cuda"):
        return dr.cuda
    _llvm.require()
    return dr.llvm
