"""The finder of public modules that extensions add, such as `mitsuba_plenoptic.torch`."""

import importlib
import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


class PublicModules(MetaPathFinder, Loader):
    """Finder and loader of the modules that the records of extensions name under `modules`."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a public module of an extension, None for other modules; refuse what is not there."""
        root, _, name = fullname.partition(".")
        if root != __package__ or name in ("", "extensions") or "." in name:
            return None
        from .extension import entries, missing

        for package, public, module in entries("modules"):
            if public == name:
                return ModuleSpec(fullname, self, loader_state=f"{package}.{module}")
        if absent := missing("modules", name):
            # Without the module's name, which would let ``from mitsuba_plenoptic import ...`` pass over the line.
            raise ModuleNotFoundError(absent)
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return the extension's module itself; without a library that it needs, raise an ImportError that says so."""
        from .errors import InputError

        try:
            module = importlib.import_module(spec.loader_state)
        except InputError as error:
            raise ImportError(str(error), name=spec.name) from None
        spec.loader_state = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Restore the module's own spec, which the import system has overwritten."""
        module.__spec__ = module.__spec__.loader_state if module.__spec__ else None


sys.meta_path.append(PublicModules())
