"""Gauges of the package's structure, with one table of limits.

    python tools/house.py [--check | --json | --docs | --list WORD] [ROOT]

Without an option the command prints each gauge at the beginning (commit 32fb4b1f) and now, its limit and its goal.
`--check` prints the gauges beyond their limits, with exit status 1 if there are any; `--json` prints numbers by name;
`--docs` writes the table into the page house.md; `--list WORD` prints what the gauges with this word in their names
count. ROOT is another checkout. The core is the package without the folder `extensions`.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import re
import statistics
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from clones import clones, is_docstring, statements
from import_circles import PACKAGE, import_gauges

BEGINNING = "32fb4b1f"
LONGEST_FILE = 600
SHARED_NAMES = {"__init__.py", "__main__.py", "conftest.py"}
Function = ast.FunctionDef | ast.AsyncFunctionDef
Trees = dict[Path, ast.Module]
Gauge = float | list[str]


class Limit(NamedTuple):
    """A row of the table: today's limit, which is an interim one until the goal is reached; None: no limit."""

    name: str
    beginning: float
    limit: float | None
    goal: float | None = None
    reason: str = ""


# fmt: off
LIMITS = (
    Limit("files", 316, None),
    Limit("lines of the core", 66_151, 48_780, 43_659, "cameras 3,250; GPUs; fast lenses 190; mended faults 1,200"),
    Limit("lines of the package", 66_151, 76_510, 61_520, "particles 2,440; real pixels 1,300; mended faults 1,640"),
    Limit("statements of the package", 31_622, None),
    Limit("files above 600 lines", 0, 0, 0),
    Limit("functions", 3_878, None),
    Limit("private helpers of the core, % of its functions", 31.8, 23.5, 14.9, "named steps"),
    Limit("lines of the median function of the core", 7, 6, 9, "longer ones went to extensions"),
    Limit("functions used once", 773, None),
    Limit("private functions used once, of at most 3 statements", 174, 91),
    Limit("functions that only forward", 176, 158, None, "both kinds of rays answer alike; fitted pupils; voxels"),
    Limit("parameters", 7_519, None),
    Limit("parameters typed Any", 1_159, 1_133, None, "Dr.Jit values: ordinary cameras 31, real ones 36, GPUs 6"),
    Limit("definitions of white in the core", 28, 4, 4),
    Limit("stores for going on after a stop", 5, 1, 1),
    Limit("lines that ask for the lens's kind", 106, 117, None, "lenses with apertures; objectives, of beads 6"),
    Limit("modules on circles of imports", 16, 0, 0),
    Limit("folders on circles of imports", 22, 0, 0),
    Limit("imports inside functions", 8, 0, 0, "others than of libraries, in commands and in `__init__`"),
    Limit("imports of extensions by the core", 0, 0, 0),
    Limit("clones of eight statements", 0, 0, 0),
    Limit("class names used twice", 5, 3),
    Limit("file names that stand twice", 24, 0, 0),
    Limit("internal names that tests import", 313, 279, 150, "steps of methods; extensions; devices 8; real pixels 15"),
    Limit("modules of tools/bench/cases", 59, 31, 30, "particles"),
    Limit("words of the documentation", 91_870, 81_260, 68_902, "ordinary, real 2,900; particles 2,800; mended 1,200"),
    Limit("files visited by a ray capture", 24, 20, 20),
    Limit("files visited by a wave capture", 40, 42, 30, "signed rays: nine files, each a step; warps; pixels"),
    Limit("files visited by a coherent reconstruction", 33, 30, 28, "displaced lenses, and captures straightened"),
    Limit("files visited by a gradient", 38, 39, 35, "displaced lenses; what pixels do to light; windows of batches"),
    Limit("most lenses, checks or lattices made by a call", 5, 8, 3, "lengths that kernels do not hold"),
)
# fmt: on

AT_LEAST = {"lines of the median function of the core"}
"""Gauges whose limit is a lower one."""

LENS_FLAGS = {"is_thin", "images_stop", "is_fourier", "is_paraxial", "converges"}
"""Names that ask for the kind of a main lens wherever their values are read."""

LENS_NAMES = {
    "lens_model", "main_lens", "objective", "prescription", "traced_surfaces", "LensData", "Objective", "Prescription",
    "Collimator", "ThinLens", "DistortedLens", "TelecentricLens", "CollimatedLens", "FittedLens", "LensSystem",
    "RealLens", "VaryingLens", "ExitPupil", "UniformLens", "FiniteDistance", "FinitePupil",
}  # fmt: skip
"""Names that ask for the kind of a main lens where a condition compares them, is true of them, or tests a type."""

STORES = re.compile(r"(Store|Checkpoint|Log|Layout)$")
"""Classes that store what a run needs to go on after a stop."""


def sources(root: Path) -> Trees:
    """Parse the package's files, by their paths in the package."""
    package = root / PACKAGE
    return {path.relative_to(package): ast.parse(path.read_text()) for path in sorted(package.rglob("*.py"))}


def asks_for_lens(node: ast.AST) -> bool:
    """Whether an expression asks for the kind of a main lens, by a flag, a condition or a type."""

    def has(part: ast.AST, words: set[str]) -> bool:
        if isinstance(part, ast.Tuple | ast.List | ast.Set | ast.BinOp):
            return any(has(child, words) for child in ast.iter_child_nodes(part))
        return getattr(part, "attr", getattr(part, "id", None)) in words

    # A lens model is never empty, so that its truth is no question.
    may_be_none = LENS_NAMES - {"lens_model"}
    match node:
        case ast.Attribute(ctx=ast.Load()) | ast.Name(ctx=ast.Load()):
            return has(node, LENS_FLAGS)
        case ast.Compare():
            return any(has(part, LENS_NAMES) for part in (node.left, *node.comparators))
        case ast.BoolOp():
            return any(has(part, may_be_none) for part in node.values)
        case ast.UnaryOp(op=ast.Not()):
            return has(node.operand, may_be_none)
        case ast.If() | ast.While() | ast.IfExp() | ast.Assert():
            return has(node.test, may_be_none)
        case ast.ListComp() | ast.SetComp() | ast.DictComp() | ast.GeneratorExp():
            return any(has(test, may_be_none) for part in node.generators for test in part.ifs)
        case ast.Match():
            return has(node.subject, LENS_NAMES)
        case ast.MatchClass():
            return has(node.cls, LENS_NAMES)
        case ast.Call(func=ast.Name(id="isinstance" | "issubclass" | "bool" | "hasattr" | "callable")):
            return any(has(part, LENS_NAMES) for part in node.args)
    return False


def function_gauges(trees: Trees) -> dict[str, Gauge]:
    """Return the gauges of functions; lines of a function are those from `def` to its end."""
    functions = {node: path for path, tree in trees.items() for node in ast.walk(tree) if isinstance(node, Function)}
    core = [node for node, path in functions.items() if path.parts[0] != "extensions"]
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    uses = Counter(getattr(node, "attr", getattr(node, "id", None)) for node in nodes)

    def lines(node: Function) -> int:
        return (node.end_lineno or 0) - node.lineno + 1

    def is_private(node: Function) -> bool:
        return node.name.startswith("_") and not node.name.startswith("__")

    def body(node: Function) -> list[ast.stmt]:
        return [part for part in node.body if not is_docstring(part)]

    def forwards(node: Function) -> bool:
        """Whether a function's one statement calls another with names and constants."""
        call = getattr(body(node)[0], "value", None) if len(body(node)) == 1 else None
        calm = (ast.Name, ast.Attribute, ast.Constant, ast.Starred, ast.expr_context)
        return isinstance(call, ast.Call) and all(
            isinstance(part, calm)
            for argument in (*call.args, *(keyword.value for keyword in call.keywords))
            for part in ast.walk(argument)
        )

    def listed(chosen: list[Function]) -> list[str]:
        return [f"{functions[node]}:{node.lineno} {node.name}" for node in chosen]

    once = [node for node in functions if uses[node.name] == 1]
    private = [node for node in core if is_private(node)]
    parameters = [
        argument
        for node in functions
        for argument in ast.walk(node.args)
        if isinstance(argument, ast.arg) and argument.arg not in ("self", "cls")
    ]
    stores = [
        node.name
        for node in nodes
        if isinstance(node, ast.ClassDef)
        and STORES.search(node.name)
        and "Protocol" not in map(ast.unparse, node.bases)
    ]
    return {
        "functions": len(functions),
        "private helpers of the core, % of its functions": round(100 * len(private) / max(len(core), 1), 1),
        "lines of the median function of the core": statistics.median_low([lines(node) for node in core] or [0]),
        "functions used once": listed(once),
        "private functions used once, of at most 3 statements": listed(
            [node for node in once if is_private(node) and len(body(node)) <= 3]
        ),
        "functions that only forward": listed([node for node in functions if forwards(node)]),
        "parameters": len(parameters),
        "parameters typed Any": sum(getattr(argument.annotation, "id", None) == "Any" for argument in parameters),
        "definitions of white in the core": listed([node for node in core if "white" in node.name.lower()]),
        "stores for going on after a stop": stores,
    }


def shown(root: Path) -> set[str]:
    """Return the full names of what the reference shows, modules with all members, and of what pages import."""
    reference = "\n".join(page.read_text() for page in (root / "docs" / "reference" / "python").glob("*.rst"))
    directive = r"^\.\. auto(?:module|class|function):: (\S+)(?!\n   :no-members:)$"
    names = set(re.findall(directive, reference, flags=re.MULTILINE))
    for page in (root / "docs").rglob("*.md"):
        for module, imported in re.findall(rf"from ({PACKAGE}[\w.]*) import ([\w, ]+)", page.read_text()):
            names |= {f"{module}.{name.strip()}" for name in imported.split(",")}
    return names


def tested_internals(root: Path) -> list[str]:
    """Return the names that tests import and that neither the reference nor the code on pages shows."""
    public, names = shown(root) | {PACKAGE, f"{PACKAGE}.cli.main"}, set()
    for path in (root / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (module := node.module or "").split(".")[0] == PACKAGE:
                full = {f"{module}.{alias.name}" for alias in node.names}
                names |= set() if module in public else full - public
            elif isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names if alias.name.startswith(f"{PACKAGE}.")} - public
    return sorted(names)


def names_twice(root: Path) -> list[str]:
    """Return the names of files that stand twice in the package, the tests or the tools."""
    files = [(part, path.name) for part in (PACKAGE, "tests", "tools") for path in (root / part).rglob("*.py")]
    return [
        f"{part}: {name}" for (part, name), count in Counter(files).items() if count > 1 and name not in SHARED_NAMES
    ]


TABLE = re.compile(r"(<!-- gauges -->\n).*(?=<!-- end of gauges -->)", flags=re.DOTALL)
"""The table that this tool writes into docs/reference/develop/house.md, which counts no words."""


def docs_words(root: Path) -> int:
    """Count the words of the handwritten pages, those of the changelog left out."""
    pages = [page for page in (root / "docs").rglob("*.md") if page.name != "changelog.md"]
    return sum(len(TABLE.sub("", page.read_text()).split()) for page in pages)


def visits(root: Path) -> dict[str, Gauge]:
    """Return the files that typical calls visit, by a process that imports the checkout's package."""
    environment = os.environ | {"PYTHONPATH": str(root.resolve()), "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, str(Path(__file__).with_name("count_visits.py"))]
    output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
    return dict(json.loads(output.splitlines()[-1]))


def measure(root: Path) -> dict[str, Gauge]:
    """Return the gauges of a checkout that need no run, by their names."""
    trees = sources(root)
    lines = {path: len((root / PACKAGE / path).read_text().splitlines()) for path in trees}
    classes = Counter(n.name for tree in trees.values() for n in ast.walk(tree) if isinstance(n, ast.ClassDef))
    questions = {
        f"{path}:{node.lineno}": None
        for path, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.expr | ast.stmt | ast.pattern) and asks_for_lens(node)
    }
    return {
        "files": len(trees),
        "lines of the core": sum(count for path, count in lines.items() if path.parts[0] != "extensions"),
        "lines of the package": sum(lines.values()),
        "statements of the package": sum(statements(tree) for tree in trees.values()),
        f"files above {LONGEST_FILE} lines": [f"{path.name} {n}" for path, n in lines.items() if n > LONGEST_FILE],
        **function_gauges(trees),
        **import_gauges(trees),
        "lines that ask for the lens's kind": list(questions),
        "clones of eight statements": clones(trees),
        "class names used twice": [name for name, count in classes.items() if count > 1],
        "file names that stand twice": names_twice(root),
        "internal names that tests import": tested_internals(root),
        "modules of tools/bench/cases": [
            p.name for p in (root / "tools/bench/cases").rglob("*.py") if p.name[0] != "_"
        ],
        "words of the documentation": docs_words(root),
    }


def value(gauge: Gauge) -> float:
    """Return the number of a gauge."""
    return len(gauge) if isinstance(gauge, list) else gauge


def exceeded(values: dict[str, Gauge]) -> list[str]:
    """Return a line for each gauge beyond its limit."""
    return [
        f"{row.name}: {value(values[row.name]):,}, {'at least' if row.name in AT_LEAST else 'at most'} {row.limit:,}"
        for row in LIMITS
        if row.limit is not None and (value(values[row.name]) - row.limit) * (-1 if row.name in AT_LEAST else 1) > 0
    ]


def table(values: dict[str, Gauge], *, with_limits: bool) -> str:
    """Return the gauges as a Markdown table."""
    rows = [("gauge", "at the beginning", "now", "limit", "goal", "reason"), ("---", *["---:"] * 4, "---")]
    for row in LIMITS:
        numbers = (row.beginning, value(values[row.name]), row.limit, row.goal)
        rows.append((row.name, *("" if n is None else f"{n:,}" for n in numbers), row.reason))
    chosen = range(6) if with_limits else (0, 1, 2, 4)
    return "".join("| " + " | ".join(row[column] for column in chosen) + " |\n" for row in rows)


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("root", metavar="ROOT", nargs="?", type=Path, default=Path(__file__).parents[1])
    options = parser.add_mutually_exclusive_group()
    options.add_argument("--check", action="store_true", help="print the gauges beyond their limits; status 1 if any")
    options.add_argument("--json", action="store_true", help="print numbers by name")
    options.add_argument("--docs", action="store_true", help="write the table into docs/reference/develop/house.md")
    options.add_argument("--list", metavar="WORD", help="print what the gauges with this word in their names count")
    given = parser.parse_args()
    values = measure(given.root) | visits(given.root)
    if given.check:
        print(*exceeded(values) or ["house: all gauges are within their limits"], sep="\n")
        return int(bool(exceeded(values)))
    if given.json:
        print(json.dumps({name: value(gauge) for name, gauge in values.items()}, indent=1))
    elif given.docs:
        page = given.root / "docs" / "reference" / "develop" / "house.md"
        page.write_text(TABLE.sub(lambda found: found[1] + table(values, with_limits=False), page.read_text()))
    elif given.list:
        for name, gauge in values.items():
            if given.list in name and isinstance(gauge, list):
                print(f"{name}: {len(gauge)}", *gauge, sep="\n    ")
    else:
        print(table(values, with_limits=True), end="")
    return 0


if __name__ == "__main__":
    sys.exit(main())
