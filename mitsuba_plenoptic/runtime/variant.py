"""The variant of Mitsuba that is active, one for the whole process."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..errors import InputError, require_choice
from . import llvm
from .backend import one_at_a_time

DEFAULT_VARIANT = "llvm_ad_mono"


@one_at_a_time
def set_variant(variant: str | None) -> None:
    """Set a Mitsuba variant, or the default one if none is named and none is active."""
    variant = variant or mi.variant() or DEFAULT_VARIANT
    require_choice("variant", variant, mi.variants())
    if variant.startswith("llvm"):
        llvm.require()
    if variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise InputError(f"variant = {variant!r}: no usable CUDA device was found; use an llvm_ad_* variant")
    if mi.variant() != variant:
        mi.set_variant(variant)
