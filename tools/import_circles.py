"""Imports of the package: circles of modules and of folders, imports inside functions, extensions in the core."""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

PACKAGE = "mitsuba_plenoptic"


class Import(NamedTuple):
    """An import of a module or a library, and the place of the statement: top, TYPE_CHECKING or function."""

    target: str
    line: int
    place: str


def imports(tree: ast.Module, package: str, modules: dict[str, Path]) -> Iterator[Import]:
    """Find the imports of a file in a package, those in functions, by `import_module` and for types included."""

    def absolute(name: str, level: int) -> str:
        base = package.split(".")[: len(package.split(".")) - level + 1] if level else []
        return ".".join([*base, *([name] if name else [])])

    def targets(node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = absolute(node.module or "", node.level)
            members = [f"{base}.{alias.name}" for alias in node.names]
            yield from {member if member in modules else base for member in members}
        elif isinstance(node, ast.Call) and node.args and ast.unparse(node.func).endswith("import_module"):
            name = node.args[0]
            words = [part.value for part in getattr(name, "values", [name]) if isinstance(part, ast.Constant)]
            text = "".join(str(word) for word in words)
            bare = text.strip(".")
            possible = absolute(bare, len(text) - len(text.lstrip("."))), f"{PACKAGE}.{bare}"
            yield from [found for found in possible if bare and found in modules][:1]

    def visit(node: ast.AST, place: str) -> Iterator[Import]:
        for target in targets(node):
            yield Import(target, getattr(node, "lineno", 0), place)
        for child in ast.iter_child_nodes(node):
            inner = place
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                inner = "function"
            elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test) and place == "top":
                inner = "TYPE_CHECKING"
            yield from visit(child, inner)

    yield from visit(tree, "top")


def room(module: str) -> str:
    """Return the folder of a module: the first below the package, or the extension."""
    parts = module.split(".")[1:]
    return ".".join(parts[:2] if parts[0] == "extensions" else parts[:1])


def on_circles(edges: dict[tuple[str, str], list[str]]) -> list[str]:
    """Return the nodes that import each other, each with the imports that make its circle."""
    nodes = sorted({node for edge in edges for node in edge})
    rows, columns = ([nodes.index(edge[end]) for edge in edges] for end in (0, 1))
    graph = coo_array(([1] * len(edges), (rows, columns)), shape=(len(nodes), len(nodes)))
    labels = dict(zip(nodes, connected_components(graph, connection="strong")[1] if nodes else (), strict=True))
    members: dict[int, list[str]] = defaultdict(list)
    for node, label in labels.items():
        members[label].append(node)
    result = []
    for number, circle in enumerate((circle for circle in members.values() if len(circle) > 1), 1):
        for node in circle:
            to = {there: places for (here, there), places in edges.items() if here == node and there in circle}
            shown = [f"{there} ({', '.join(places[:3])}{', ...' * (len(places) > 3)})" for there, places in to.items()]
            result.append(f"circle {number}: {node} -> " + "; ".join(shown))
    return result


def import_gauges(trees: dict[Path, ast.Module]) -> dict[str, list[str]]:
    """Return the gauges of imports from the package's files, by their paths in the package.

    The package's own `__init__` serves public names lazily, so that its imports and those of it are no edges.
    """
    modules = {".".join([PACKAGE, *path.with_suffix("").parts]).removesuffix(".__init__"): path for path in trees}
    files: dict[tuple[str, str], list[str]] = defaultdict(list)
    folders: dict[tuple[str, str], list[str]] = defaultdict(list)
    late, upward = [], []
    for module, path in modules.items():
        if path.name == "shipped.py":
            # A generated list of what extensions add, whose imports type checkers alone read.
            continue
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        may_be_late = "cli" in path.parts or "command" in path.stem or path.name in ("__init__.py", "served.py")
        for found in imports(trees[path], package, modules):
            line = f"{path}:{found.line} {found.place}"
            library = found.target.partition(".")[0]
            is_own = library == PACKAGE
            if found.place == "function" and not may_be_late and (is_own or library in sys.stdlib_module_names):
                late.append(f"{path}:{found.line} {found.target}")
            if not is_own or PACKAGE in (module, found.target) or module == found.target:
                continue
            files[module, found.target].append(line)
            if room(module) != room(found.target):
                folders[room(module), room(found.target)].append(line)
            if room(found.target).startswith("extensions") and not room(module).startswith("extensions"):
                upward.append(f"{line} {found.target}")
    return {
        "modules on circles of imports": on_circles(files),
        "folders on circles of imports": on_circles(folders),
        "imports inside functions": late,
        "imports of extensions by the core": upward,
    }
