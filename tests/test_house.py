"""The size of the house, by figures that packing lines cannot shrink: each stays at its goal or the value reached."""

import ast
import gc
import re
import subprocess
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "mitsuba_plenoptic"

VAGUE = set(
    re.findall(
        r"\w+",
        """part found each own given kept used taken made wanted asked seen told brought felt drawn shown served shipped
        held number known every one other what which these those several whole rest place""",
    )
)
"""Names of bindings that do not say what they hold."""

_STRING = r"(?i:[rbuf]{0,2})(?:" + "|".join(
    rf"{quotes}(?:\\.|(?!{quotes}){other})*{quotes}"
    for quotes, other in (('"{3}', r"[^\\]"), ("'{3}", r"[^\\]"), ('"', r"[^\\\n]"), ("'", r"[^\\\n]"))
) + ")"  # fmt: skip
TOKEN = re.compile(rf"(#[^\n]*)|{_STRING}|{tokenize.Number}|{tokenize.Special}|{tokenize.Name}", re.DOTALL)
"""What Python reads as one, of which comments are a group; `tokenize`, which gives their places, takes seconds."""

GOALS = {
    "lines": 67_000,
    "lines of the core": 44_000,
    "tokens": 475_000,
    "tokens of the core": 302_000,
    "functions": 3_500,
    "percentage of functions of at most three statements": 44,
    "checks and raises": 1_450,
    "definitions of checks": 95,
    "names of the core that extensions import": 305,
    "modules of the core that extensions import": 25,
    "percentage of vague bindings": 1,
    "packings": 250,
    "constants of modules": 650,
    "lines of tests": 30_000,
    "lines of tools": 8_500,
    "words of docs": 51_000,
    "words of the changelog": 300,
    "modules that a ray capture loads": 75,
    "lines that a ray capture loads": 14_000,
    "modules that a wave capture loads": 120,
    "lines that a wave capture loads": 24_000,
}

REACHED = {
    "lines": 76_150,
    "lines of the core": 50_410,
    "tokens": 544_769,
    "tokens of the core": 351_400,
    "functions": 4_046,
    "percentage of functions of at most three statements": 47.2,
    "checks and raises": 1_766,
    "definitions of checks": 115,
    "names of the core that extensions import": 368,
    "modules of the core that extensions import": 28,
    "constants of modules": 745,
    "lines of tests": 31_213,
    "lines of tools": 10_177,
    "words of docs": 56_435,
    "modules that a ray capture loads": 97,
    "lines that a ray capture loads": 15_960,
    "modules that a wave capture loads": 133,
}
"""Values where the goal is not reached, rounded up."""

CAPTURE = """
import sys, mitsuba as mi, mitsuba_plenoptic as mp
mi.set_variant("llvm_ad_mono")
small = {"resolution": "64", "detector_width": ".128", "letter_scale": ".03125"}
for model in ("ray", "wave"):
    mp.render_capture(mp.load_scene("letters", parameters=small), model=model, spp=2)
    ours = [module.__file__ for name, module in sys.modules.items() if name.partition(".")[0] == "mitsuba_plenoptic"]
    print(len(ours), sum(open(name).read().count("\\n") for name in ours))
"""
"""All that a ray capture loads, a wave capture does, too."""


def lines_of(files):
    return sum(path.read_text().count("\n") for path in files)


def is_extension(path):
    return "extensions" in path.parts


def tokens_of(nodes, path):
    """Return the count of tokens without comments, docstrings and line ends."""
    lines = path.read_text().split("\n")
    for node in nodes:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines[node.lineno - 1 : node.end_lineno] = [""] * (node.end_lineno - node.lineno + 1)
    return sum(not match[1] for match in TOKEN.finditer("\n".join(lines)))


def statements(body):
    """Return how many statements there are in some and within them."""
    inner = ("body", "orelse", "finalbody", "handlers", "cases")
    return sum(isinstance(node, ast.stmt) + sum(statements(getattr(node, name, ())) for name in inner) for node in body)


def imported_of_core(nodes):
    """Return names, with their modules, that extensions import from the core."""
    names = set()
    for path, those in nodes.items():
        if not is_extension(path):
            continue
        here = path.relative_to(ROOT).parts
        for node in those:
            if isinstance(node, ast.ImportFrom):
                base = list(here[: len(here) - node.level]) if node.level else []
                module = ".".join(base + (node.module or "").split("."))
                if module.startswith("mitsuba_plenoptic") and ".extensions" not in module:
                    names |= {(module, alias.name) for alias in node.names}
    return names


def figures():
    trees = {path: ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))}
    core = [path for path in trees if not is_extension(path)]
    by_path = {path: list(ast.walk(tree)) for path, tree in trees.items()}
    tokens = {path: tokens_of(nodes, path) for path, nodes in by_path.items()}
    nodes = [node for nodes in by_path.values() for node in nodes]
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    small = [function for function in functions if statements(function.body) - bool(ast.get_docstring(function)) <= 3]
    bound = [node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)]
    bound += [
        argument.arg
        for function in functions
        for argument in (*function.args.args, *function.args.kwonlyargs)
        if argument.arg not in ("self", "cls")
    ]
    packings = [
        node
        for node in nodes
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple) and isinstance(node.targets[0], ast.Tuple)
    ]
    top = [node for tree in trees.values() for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)]
    targets = [node.targets if isinstance(node, ast.Assign) else [node.target] for node in top]
    constants = [
        names for names in targets if any(re.fullmatch(r"_?[A-Z][A-Z0-9_]+", getattr(name, "id", "")) for name in names)
    ]
    called = [getattr(node.func, "attr", getattr(node.func, "id", "")) for node in nodes if isinstance(node, ast.Call)]
    checks = [name for name in called if re.match(r"(require|refuse|known_to|check_)", name)]
    imported = imported_of_core(by_path)
    docs = [path for kind in ("*.md", "*.rst") for path in (ROOT / "docs").rglob(kind)]
    captured = subprocess.run([sys.executable, "-c", CAPTURE], capture_output=True, text=True, check=True).stdout
    loaded = zip(("ray", "wave"), (map(int, line.split()) for line in captured.splitlines()), strict=True)
    return {
        "lines": lines_of(trees),
        "lines of the core": lines_of(core),
        "tokens": sum(tokens.values()),
        "tokens of the core": sum(tokens[path] for path in core),
        "functions": len(functions),
        "percentage of functions of at most three statements": 100 * len(small) / len(functions),
        "checks and raises": len(checks) + sum(isinstance(node, ast.Raise) for node in nodes),
        "definitions of checks": sum(
            bool(re.match(r"_?(require|refuse|known_to)", function.name)) for function in functions
        ),
        "names of the core that extensions import": len(imported),
        "modules of the core that extensions import": len({module for module, _ in imported}),
        "percentage of vague bindings": 100 * sum(name.strip("_") in VAGUE for name in bound) / len(bound),
        "packings": len(packings),
        "constants of modules": len(constants),
        "lines of tests": lines_of((ROOT / "tests").rglob("*.py")),
        "lines of tools": lines_of((ROOT / "tools").rglob("*.py")),
        "words of docs": sum(len(path.read_text().split()) for path in docs),
        "words of the changelog": len((ROOT / "CHANGELOG.md").read_text().split()),
        **{
            f"{what} that a {model} capture loads": count
            for model, counts in loaded
            for what, count in zip(("modules", "lines"), counts, strict=True)
        },
    }


def test_the_house_does_not_grow():
    # Collections of garbage would look at all nodes again and again.
    gc.disable()
    try:
        values = figures()
    finally:
        gc.enable()
    limits = GOALS | REACHED
    assert set(values) == set(limits)
    assert {name: value for name, value in values.items() if value > limits[name]} == {}


def test_the_files_of_ideas_exist():
    page = (ROOT / "docs" / "reference" / "develop" / "ideas.md").read_text()
    rows = re.findall(r"^\| [^*-].*\| `(\S+)` \|$", page, flags=re.MULTILINE)
    assert 40 < len(rows) <= 65
    assert [name for name in rows if not (PACKAGE / name).is_file()] == []
