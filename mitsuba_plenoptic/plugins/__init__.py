"""The plugins for Mitsuba, which are registered whenever a variant becomes active.

A plugin's class is bound to the types of the variant that was active when it was defined, so each variant gets its own
class, which is defined, and its module imported, when the first plugin is made. The callback must not raise, since an
exception would not undo the change of the variant. For a variant that cannot work, constructors are registered that
raise an error with the reason.
"""

import importlib
from collections.abc import Callable
from functools import cache
from typing import Any, NoReturn

import mitsuba as mi

from ..runtime import llvm, watch_collections

_OWN = {"plenoptic": ("sensor", "sensor"), "plenoptic_wave": ("integrator", "integrator")}
"""Plugins of the core: their modules and kinds."""


def _constructor(module: str) -> Callable[[Any], Any]:
    """Return a function that makes plugins of one variant."""

    @cache
    def own_class() -> Any:
        return importlib.import_module(module).make_class()

    return lambda props: own_class()(props)


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

    reason = None
    if new.startswith("scalar"):
        reason = f"variant {new}: this plugin needs an llvm_ad_* or cuda_ad_* variant"
    elif new.startswith("llvm"):
        reason = llvm.problem()
    plugins = [(__name__, name, entry) for name, entry in _OWN.items()]
    for package, name, (module, kind) in [*plugins, *entries("plugins")]:
        constructor = _refuse(name, reason) if reason else _constructor(f"{package}.{module}")
        getattr(mi, f"register_{kind}")(name, constructor)


watch_collections()
mi.detail.add_variant_callback(_register)
_register(None, mi.variant())
