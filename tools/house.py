"""Counts of how the house looks: statements, files, clones, docstrings, imports; a Markdown table.

    python tools/house.py [ROOT ...]

With several checkouts, one column for each, such as before and after a change. Statements are those of Python's syntax
tree without docstrings, so that neither comments nor the formatter count. A clone is a run of eight statements or more
that stands in two places, with names and constants made equal.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

PACKAGE = "mitsuba_plenoptic"
CLONE = 8

LENS_KIND = re.compile(
    r"\.objective is |\.prescription is |(if|and|or|not) \w+(\.\w+)*\.(objective|prescription)\b(?!\.)|"
    r"isinstance\([\w.]+, \(?(FittedLens|ThinLens|TelecentricLens|LensSystem|DistortedLens)|is_fourier\b"
)

WORDS = {
    "tell": r"\b(tell|tells|told)\b", "so many": r"\bso (many|few|much)\b", "is none": r"\b(is|are) none\b",
    "as of": r"\bas of\b", "goes on": r"\b(go|goes|going) on\b", "kept": r"\bkept\b", "but for": r"\bbut for\b",
    "beside": r"\bbeside\b", "what": r'"""What\b', "number": r"\bnumbers?\b",
    "place": r"\bplaces?\b", "way": r"\bways?\b", "share": r"\bshares?\b",
}  # fmt: skip


def sources(root: Path) -> dict[Path, ast.Module]:
    """Parse the package's files."""
    return {path: ast.parse(path.read_text()) for path in sorted((root / PACKAGE).rglob("*.py"))}


def is_docstring(node: ast.stmt) -> bool:
    """Whether a statement is a string and nothing else."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def statements(tree: ast.AST) -> int:
    """Count the statements of a tree without docstrings."""
    return sum(isinstance(node, ast.stmt) and not is_docstring(node) for node in ast.walk(tree))


class _Normal(ast.NodeTransformer):
    """Makes names, attributes, and constants equal."""

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return ast.Name("x", ast.Load())

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        return ast.Attribute(self.visit(node.value), "x", ast.Load())

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return ast.Constant(0)

    def visit_arg(self, node: ast.arg) -> ast.AST:
        return ast.arg("x", None)


def _blocks(tree: ast.AST) -> Iterator[list[ast.stmt]]:
    for node in ast.walk(tree):
        for name in ("body", "orelse", "finalbody"):
            block = getattr(node, name, None)
            if isinstance(block, list) and not isinstance(node, (ast.Module, ast.ClassDef)):
                yield [each for each in block if not is_docstring(each)]


def clones(trees: dict[Path, ast.Module]) -> list[tuple[str, str]]:
    """List pairs of places with the same run of statements, each pair of blocks once."""
    found: dict[str, list[tuple[str, int]]] = defaultdict(list)
    for path, tree in trees.items():
        for number, block in enumerate(_blocks(tree)):
            normal = [ast.dump(_Normal().visit(ast.parse(ast.unparse(each)))) for each in block]
            for first in range(len(block)):
                # Runs of as many statements as hold eight, nested ones included.
                count, last = 0, first
                while last < len(block) and count < CLONE:
                    count += statements(block[last])
                    last += 1
                if count >= CLONE and last - first > 1:
                    key = "\n".join(normal[first:last])
                    found[key].append((f"{path.name}:{block[first].lineno}", hash((path, number))))
    pairs = {}
    for places in found.values():
        for i, (a, block_a) in enumerate(places):
            for b, block_b in places[i + 1 :]:
                if block_a != block_b:
                    pairs.setdefault((block_a, block_b), (a, b))
    return sorted(pairs.values())


def shown(root: Path) -> set[str]:
    """Return the modules whose members the pages of the reference list, and the names that the package offers."""
    pages = "\n".join(page.read_text() for page in (root / "docs" / "reference" / "python").glob("*.rst"))
    names = set(re.findall(r"^\.\. auto(?:module|class|function):: (\S+)", pages, flags=re.MULTILINE))
    listed: set[str] = set()
    for package in (root / PACKAGE).rglob("__init__.py"):
        for node in ast.parse(package.read_text()).body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
                listed |= set(ast.literal_eval(node.value))
    return names | listed


def internal_sections(root: Path, trees: dict[Path, ast.Module]) -> int:
    """Count objects with NumPy sections that the reference does not show."""
    public, count = shown(root), 0

    def visit(node: ast.AST, is_public: bool) -> Iterator[int]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                seen = is_public or child.name in public
                doc = ast.get_docstring(child) or ""
                yield int(not seen and re.search(r"^-{3,}$", doc, flags=re.MULTILINE) is not None)
                yield from visit(child, seen)

    for path, tree in trees.items():
        module = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        count += sum(visit(tree, module in public))
    return count


def circles(root: Path, trees: dict[Path, ast.Module]) -> int:
    """Count modules on a circle of imports that stand at the top of files."""
    names = {".".join(p.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): p for p in trees}
    edges: dict[str, set[str]] = {}
    for name, path in names.items():
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        edges[name] = set()
        for node in trees[path].body:
            if isinstance(node, ast.ImportFrom) and node.level:
                base = package.split(".")[: len(package.split(".")) - node.level + 1]
                module = ".".join([*base, *([node.module] if node.module else [])])
                edges[name] |= {
                    f"{module}.{alias.name}" if f"{module}.{alias.name}" in names else module for alias in node.names
                }
    on_circles = 0
    for start in names:
        seen, waiting = set(), list(edges[start])
        while waiting:
            module = waiting.pop()
            if module not in seen:
                seen.add(module)
                waiting += edges.get(module, ())
        on_circles += start in seen and not start.endswith(PACKAGE)
    return on_circles


def tested_internals(root: Path) -> int:
    """Count internal names that tests import: of modules of which the reference does not list the members."""
    public, found = shown(root), set()
    for path in (root / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.ImportFrom)
                and (node.module or "").startswith(PACKAGE)
                and node.module not in public
            ):
                found |= {(node.module, alias.name) for alias in node.names if alias.name not in public}
    return len(found)


def counts(root: Path) -> dict[str, int]:
    """Return the counts of a checkout by their names."""
    trees = sources(root)
    texts = {path: path.read_text() for path in trees}
    classes = Counter(n.name for tree in trees.values() for n in ast.walk(tree) if isinstance(n, ast.ClassDef))
    tools = list((root / "tools").rglob("*.py"))
    everything = "\n".join(texts.values())
    rows = {
        "files": len(trees),
        "lines": sum(len(text.splitlines()) for text in texts.values()),
        "statements": sum(statements(tree) for tree in trees.values()),
        "files above 400 lines": sum(len(text.splitlines()) > 400 for text in texts.values()),
        "clones of eight statements": len(clones(trees)),
        "internal objects with NumPy sections": internal_sections(root, trees),
        "class names used twice": sum(count > 1 for name, count in classes.items()),
        "modules on circles of imports": circles(root, trees),
        "lines that ask for the lens's kind": sum(
            bool(LENS_KIND.search(line)) for text in texts.values() for line in text.splitlines()
        ),
        "hidden caches": len(re.findall(r"^@(?:functools\.)?(?:lru_)?cache\b", everything, flags=re.MULTILINE)),
        "internal names that tests import": tested_internals(root),
        "lines of tools": sum(len(p.read_text().splitlines()) for p in tools),
        "lines of tests": sum(len(p.read_text().splitlines()) for p in (root / "tests").rglob("*.py")),
    }
    return rows | {f'"{word}"': len(re.findall(how, everything)) for word, how in WORDS.items()}


def main() -> None:
    """Print the table."""
    roots = [Path(each) for each in sys.argv[1:]] or [Path()]
    if "--clones" in sys.argv:
        print(*(f"{a}  {b}" for a, b in clones(sources(Path()))), sep="\n")
        return
    columns = [counts(root) for root in roots]
    print("| count | " + " | ".join(str(root) for root in roots) + " |")
    print("|---|" + "---:|" * len(roots))
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(f"{column[name]:,}" for column in columns) + " |")


if __name__ == "__main__":
    main()
