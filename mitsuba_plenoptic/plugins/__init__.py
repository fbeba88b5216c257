"""The plugins for Mitsuba, which are registered whenever a variant becomes active.

A plugin's class is bound to the types of the variant that was active when it was defined, so each variant gets its own
class. The callback must not raise, since an exception would not undo the change of the variant. For a variant that
cannot work, constructors are registered that raise an error with the reason.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, NoReturn

import mitsuba as mi

from ..runtime import llvm


def _refuse(name: str, reason: str) -> Callable[[Any], NoReturn]:
    def constructor(props: Any) -> NoReturn:
        from ..errors import InputError

        raise InputError(f"{name}: {reason}")

    return constructor


def _register(old: str | None, new: str | None) -> None:
    if new is None:
        return
    # Without a variant nothing needs what these import.
    from ..extension import entries
    from . import integrator, sensor

    reason = None
    if new.startswith("scalar"):
        reason = f"variant {new}: this plugin needs an llvm_ad_* or cuda_ad_* variant"
    elif new.startswith("llvm"):
        reason = llvm.problem()
    plugins = [(sensor, "sensor"), (integrator, "integrator")]
    plugins += [(importlib.import_module(f"{package}.{module}"), kind) for package, module, kind in entries("plugins")]
    for plugin, kind in plugins:
        getattr(mi, f"register_{kind}")(plugin.NAME, _refuse(plugin.NAME, reason) if reason else plugin.make_class())


mi.detail.add_variant_callback(_register)
_register(None, mi.variant())
