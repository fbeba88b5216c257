"""Plenoptic (light-field) cameras for Mitsuba 3: captures by rays and by waves, and their reconstruction.

Importing the package registers its plugins for the active variant and for every one set later; it never sets a
variant itself. It may be imported before or after mitsuba, and before or after a variant is set.

Threads and processes
---------------------
The functions below may be called from several Python threads: those that compute take turns, since Mitsuba's loader
and Dr.Jit's tracing are not made for two at a time, and each has all processor cores. The active variant is one for the
whole process, and a scene belongs to the variant that it was loaded in. Once a variant is set, processes must be
spawned, not forked.

The same seed gives the same bits of captures, exposures and reconstructions on any number of threads and in any
process, with three exceptions: with CUDA variants, last bits change from run to run; reconstructions by single lenses
(``interleave="auto"``) follow the number of the BLAS's threads in their last bits; and scenes that ``mi.load_file``
loads, unless with ``optimize=False`` as `load_scene` does, have their lamps in another order each time, so that the
noise of their light differs.
"""

# ruff: noqa: E402
import importlib
import os
import pkgutil
from typing import Any

# Scenes and tables are files.
if not os.path.isfile(__file__):  # noqa: PTH113
    raise ImportError(f"{__file__}: the package cannot be imported from an archive: unpack it, or install it with pip")

import lazy_loader

from .runtime import llvm

# Dr.Jit takes its LLVM from the environment when it is first imported, which plugins do.
llvm.choose()

from . import plugins as plugins
from . import public_modules as public_modules

# Public names stand in `__init__.pyi`.
_of_stub, _, _in_stub = lazy_loader.attach_stub(__name__, __file__)


def __dir__() -> list[str]:
    from .extension import entries, missing

    added = {name for kind in ("names", "modules") for _, name, _ in entries(kind) if "." not in name}
    dunders = {name for name in globals() if name.startswith("__")}
    return sorted(
        {*(name for name in _in_stub if not missing("names", name)), *added, *dunders, "__all__", "__version__"}
    )


def __getattr__(name: str) -> Any:
    from .errors import did_you_mean
    from .extension import entries, missing, place

    modules = {key for _, key, _ in entries("modules")} | {each.name for each in pkgutil.iter_modules(__path__)}
    if name == "__version__":
        found = importlib.import_module("importlib.metadata").version("mitsuba-plenoptic")
    elif name == "__all__":
        return [each for each in __dir__() if each not in modules and not each.startswith("__")]
    elif absent := missing("modules", name):
        raise AttributeError(absent)
    elif name in modules:
        try:
            found = importlib.import_module(f"{__name__}.{name}")
        except ImportError as error:
            # So that `hasattr`, `getattr` with a default and `help` go on without the libraries of extras.
            raise AttributeError(str(error)) from error
    elif name in _in_stub:
        found = _of_stub(name)
    else:
        added = [place(package, text) for package, key, text in entries("names") if key == name]
        if not added:
            # Names of the package itself come last, and so before others.
            public = [
                f"{module}.{each}"
                for module in ("refocus", "design", "dataset", "views")
                for each in dir(importlib.import_module(f"{__name__}.{module}"))
            ]
            public += [each for each in __dir__() if not each.startswith("__")]
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}{did_you_mean(name, public)}")
        found = added[0]
    # From the second time on Python finds it in the module itself.
    return globals().setdefault(name, found)
