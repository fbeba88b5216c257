"""Write `mitsuba_plenoptic/shipped.py`: what each shipped extension adds, so that the core can name a missing one."""

from __future__ import annotations

import ast
import importlib
import json
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from mitsuba_plenoptic import extensions
from mitsuba_plenoptic.extension import Extension, installed

PATH = Path(__file__).parents[1] / "mitsuba_plenoptic" / "shipped.py"

KINDS = (
    "names",
    "modules",
    "commands",
    "parameters",
    "presets",
    "captures",
    "comparisons",
    "cameras",
    "generators",
    "formats",
    "methods",
    "plugins",
)


def _records() -> Iterator[tuple[str, Extension]]:
    """Yield names and records of the shipped extensions."""
    for module in sorted(each.name for each in pkgutil.iter_modules(extensions.__path__)):
        yield module, installed()[f"mitsuba_plenoptic.extensions.{module}"]


def _annotation(package: str, place: str) -> tuple[str, str]:
    """Return module and name of the type alias that annotates the entry of a camera's parameter."""
    module, _, name = place.partition(":")
    tree = ast.parse((PATH.parent / "extensions" / package / f"{module}.py").read_text(encoding="utf-8"))
    found = (node for node in tree.body if isinstance(node, ast.AnnAssign))
    entry = next(node for node in found if isinstance(node.target, ast.Name) and node.target.id == name)
    return module, ast.unparse(entry.annotation)


def text() -> str:
    """Return the text of the module."""
    tables: dict[str, dict[str, str]] = {kind: {} for kind in KINDS}
    imports, fields, public = [], [], []
    for name, record in _records():
        for module, names in record.names.items():
            tables["names"] |= dict.fromkeys(names, name)
            direct = [each for each in names if "." not in each]
            imports += [f"    from .extensions.{name}.{module} import {each} as {each}" for each in direct]
            public += direct
        for served, module in record.modules.items():
            if served not in ("torch", "jax", "hcipy"):
                imports.append(f"    from .extensions.{name} import {module} as {served}")
                public.append(served)
        for parameter, place in record.parameters.items():
            module, annotation = _annotation(name, place)
            imports.append(f"    from .extensions.{name}.{module} import {annotation}")
            fields.append(f"        {parameter}: {annotation}")
        for kind in KINDS[1:-1]:
            tables[kind] |= dict.fromkeys(getattr(record, kind), name)
        plugins = [importlib.import_module(f"mitsuba_plenoptic.extensions.{name}.{each}") for each in record.plugins]
        tables["plugins"] |= dict.fromkeys((plugin.NAME for plugin in plugins), name)
    body = "\n".join(fields) or "        pass"
    return (
        '"""Names of everything that the shipped extensions add; written by ``tools/make_shipped.py``."""\n\n'
        "from __future__ import annotations\n\n"
        "from typing import TYPE_CHECKING\n\n"
        f"SHIPPED: dict[str, dict[str, str]] = {json.dumps(tables, indent=4)}\n\n"
        "# For type checkers: at run time names are served when they are asked for.\n"
        "if TYPE_CHECKING:\n" + "\n".join(imports) + "\n\n"
        f"    __all__ = {json.dumps(sorted(public), indent=8)}\n\n"
        "    class ShippedParameters:\n"
        '        """Camera parameters that shipped extensions add."""\n\n' + body + "\n"
    )


def write(path: Path) -> None:
    """Write the module to a file, formatted as the rest of the package."""
    path.write_text(text(), encoding="utf-8")
    for words in (("check", "--fix"), ("format",)):
        settings = ["--quiet", "--config", str(PATH.parents[1] / "pyproject.toml")]
        subprocess.run([sys.executable, "-m", "ruff", *words, *settings, str(path)], check=True)


if __name__ == "__main__":
    write(PATH)
