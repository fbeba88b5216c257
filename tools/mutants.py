"""Mistakes drawn in numeric files, and which of two versions' tests notice them.

    python tools/mutants.py OLD NEW [--count 60] [--seed 1] [--limit 300] [--first 0]

OLD and NEW are checkouts. Mistakes are drawn in functions of FOLDERS that are equal in both, wherever they stand: a
sign, an operator, an index, a bound, a number or a term that is dropped. First the suite of each runs once, with a mark
at the statement of every mistake, which notes the tests that come by; this prints how long each suite took. The notes
stay in build/mutants, where a second call finds them. Then each mistake is made in one checkout after the other, the
tests that come by it run until one fails, and the file is restored. The table has a line a mistake; the exit status is
1 where only the old tests notice one.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

FOLDERS = [
    "array",
    "camera",
    "design",
    "detector",
    "extensions/deconvolution",
    "extensions/inverse",
    "extensions/laser",
    "extensions/particles",
    "extensions/prediction",
    "extensions/sharpness",
    "extensions/wavefront",
    "fields",
    "lattice",
    "lenses",
    "light",
    "linear",
    "microlens",
    "optics",
    "points",
    "prescription",
    "rays",
    "refocus",
    "scene",
    "waves",
]
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
BOUNDS = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
# The module that marks import, which notes the current test of pytest; commands that a test runs inherit its name.
NOTES = """import os
met = set()
def note(number):
    test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
    if test and (number, test) not in met:
        met.add((number, test))
        with open(os.path.join({folder!r}, str(number)), "a") as file:
            file.write(test + "\\n")
"""

Mistake = tuple[ast.stmt, ast.expr, ast.expr]
"""A statement, an expression of it, and the one in its place."""


def mistakes(source: str) -> dict[tuple[str, str], list[Mistake]]:
    """Return the mistakes for each function of a file, by the function's name and text."""
    found = {}
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        inside: list[Mistake] = []
        for statement in _statements(function.body):
            # A mark has no place before a condition that is asked after another.
            if source.splitlines()[statement.lineno - 1].lstrip().startswith("elif "):
                continue
            # Blocks of a statement are statements of their own.
            own = [child for child in ast.iter_child_nodes(statement) if isinstance(child, ast.expr)]
            nodes = [node for part in own for node in ast.walk(part)]
            # Python 3.11 states no true columns inside formatted strings.
            messages = {node for text in nodes if isinstance(text, ast.JoinedStr) for node in ast.walk(text)}
            for node in nodes:
                if isinstance(node, ast.expr) and node not in messages:
                    inside += [(statement, node, new) for new in _replacements(node)]
        key = function.name, ast.get_source_segment(source, function) or ""
        found[key] = sorted(inside, key=lambda one: (one[1].lineno, one[1].col_offset, ast.unparse(one[2])))
    return found


def functions_of(checkout: Path) -> dict[tuple[str, str], tuple[Path, list[Mistake]]]:
    """Return file and mistakes for each function of FOLDERS that stands once, by the function's name and text."""
    found: dict[tuple[str, str], tuple[Path, list[Mistake]]] = {}
    twice = set()
    for folder in FOLDERS:
        for path in sorted((checkout / "mitsuba_plenoptic" / folder).glob("*.py")):
            for key, inside in mistakes(path.read_text()).items():
                if key in found:
                    twice.add(key)
                found[key] = path.relative_to(checkout), inside
    return {key: entry for key, entry in found.items() if key not in twice}


def _statements(body: list[ast.stmt]) -> list[ast.stmt]:
    """Return the statements of a body and of the blocks in it, without those of functions and classes defined there."""
    found = []
    for statement in body:
        if isinstance(statement, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            continue
        found.append(statement)
        for blocks in ("body", "orelse", "finalbody"):
            found += _statements(getattr(statement, blocks, []))
        for handler in getattr(statement, "handlers", []):
            found += _statements(handler.body)
    return found


def _replacements(node: ast.AST) -> list[ast.expr]:
    """Return the expressions that mistakes put in place of one."""
    match node:
        case ast.BinOp(left, operator, right) if type(operator) in OPERATORS:
            swapped = ast.BinOp(left, OPERATORS[type(operator)](), right)
            return [swapped, left] if isinstance(operator, ast.Add | ast.Sub) else [swapped]
        case ast.UnaryOp(ast.USub(), operand):
            return [operand]
        case ast.Compare(left, [operator], [right]) if type(operator) in BOUNDS:
            return [ast.Compare(left, [BOUNDS[type(operator)]()], [right])]
        case ast.Subscript(value, ast.Constant(int(index))) if index in (0, 1):
            return [ast.Subscript(value, ast.Constant(1 - index), ast.Load())]
        case ast.Constant(float(value)) if value:
            return [ast.Constant(2.0 * value)]
        case ast.Constant(int(value)) if value > 1 and not isinstance(value, bool):
            return [ast.Constant(value + 1)]
    return []


def mutated(source: str, old: ast.expr, new: ast.expr) -> str:
    """Return a source whose one expression is replaced by another, in brackets."""
    lines = source.encode().splitlines(keepends=True)
    assert old.end_lineno is not None and old.end_col_offset is not None
    start = sum(map(len, lines[: old.lineno - 1])) + old.col_offset
    end = sum(map(len, lines[: old.end_lineno - 1])) + old.end_col_offset
    text = source.encode()
    return (text[:start] + f"({ast.unparse(new)})".encode() + text[end:]).decode()


def marked(source: str, marks: list[tuple[int, int]]) -> str:
    """Return a source with a mark before the statements at some lines, each given by line and number."""
    lines = source.splitlines(keepends=True)
    for line, number in sorted(marks, reverse=True):
        text = lines[line - 1]
        indent = text[: len(text) - len(text.lstrip())]
        lines.insert(line - 1, f"{indent}__import__('mutant_notes').note({number})\n")
    return "".join(lines)


def tests_that_come_by(checkout: Path, drawn: list[tuple[Path, Mistake]]) -> list[list[str]]:
    """Return for each mistake the tests of a checkout that come by its statement, after one run of the suite."""
    folder = checkout / "build" / "mutants"
    if not (folder / "done").exists():
        folder.mkdir(parents=True, exist_ok=True)
        for path in folder.iterdir():
            path.unlink()
        (folder / "mutant_notes.py").write_text(NOTES.format(folder=str(folder)))
        names = {name for name, *_ in drawn}
        before = {name: (checkout / name).read_text() for name in names}
        try:
            for name in names:
                marks = [(one[0].lineno, number) for number, (file, one) in enumerate(drawn) if file == name]
                text = marked(before[name], marks)
                ast.parse(text)
                (checkout / name).write_text(text)
            start = time.monotonic()
            run = _pytest(checkout, ["-n", "2", "--dist", "loadfile", "-q"], None)
        finally:
            for name in names:
                (checkout / name).write_text(before[name])
        seconds = time.monotonic() - start
        (folder / "done").write_text(json.dumps({"seconds": seconds, "last": run.stdout.splitlines()[-1:]}))
    print(checkout, (folder / "done").read_text(), flush=True)
    noted = [folder / str(number) for number in range(len(drawn))]
    return [sorted(set(path.read_text().splitlines())) if path.exists() else [] for path in noted]


def _pytest(checkout: Path, arguments: list[str], limit: float | None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments]
    paths = {"PYTHONPATH": os.pathsep.join([str(checkout), str(checkout / "build" / "mutants")])}
    # Of processor time, so that other work on the machine does not matter; tests that wait without end stop later.
    bounded = None if limit is None else partial(resource.setrlimit, resource.RLIMIT_CPU, (int(limit), int(limit)))
    return subprocess.run(
        command,
        cwd=checkout,
        env=os.environ | paths,
        capture_output=True,
        text=True,
        timeout=limit and 5 * limit,
        check=False,
        preexec_fn=bounded,
    )


def notice(path: Path, text: str, checkout: Path, tests: list[str], limit: float, seed: int) -> str:
    """Return the first of some tests that fails with another text of a file, 'none' or 'no end'."""
    if not tests:
        return "no test"
    original = path.read_text()
    files = sorted({test.partition("::")[0] for test in tests})
    random.Random(seed).shuffle(files)
    ordered = sorted(tests, key=lambda test: files.index(test.partition("::")[0]))
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as names:
        names.write("\n".join(ordered))
        names.flush()
        try:
            path.write_text(text)
            run = _pytest(checkout, ["-x", "-q", f"@{names.name}"], limit)
        except subprocess.TimeoutExpired:
            return "no end"
        finally:
            path.write_text(original)
    if run.returncode == -signal.SIGKILL:
        return "no end"
    failures = [row.split()[1] for row in run.stdout.splitlines() if row.startswith(("FAILED ", "ERROR "))]
    return failures[0] if failures else "none" if run.returncode == 0 else f"status {run.returncode}"


def main() -> None:
    """Draw the mistakes and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", nargs=2, type=Path, metavar=("OLD", "NEW"))
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="the first of the drawn mistakes that is tried")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=300.0, help="processor time in s for a mistake's tests")
    arguments = parser.parse_args()
    checkouts = [checkout.resolve() for checkout in arguments.checkouts]
    before, after = map(functions_of, checkouts)
    candidates: list[list[tuple[Path, Mistake]]] = []
    for key in sorted(before.keys() & after.keys()):
        (old, first), (new, second) = before[key], after[key]
        candidates += [[(old, a), (new, b)] for a, b in zip(first, second, strict=True)]
    drawn = random.Random(arguments.seed).sample(candidates, arguments.count)
    reached = [
        tests_that_come_by(checkout, [pair[index] for pair in drawn]) for index, checkout in enumerate(checkouts)
    ]
    missed = 0
    for number, pair in enumerate(drawn[arguments.first :], arguments.first):
        verdicts = []
        for checkout, (name, (_, wrong, instead)), tests in zip(checkouts, pair, reached, strict=True):
            path = checkout / name
            text = mutated(path.read_text(), wrong, instead)
            verdicts.append(notice(path, text, checkout, tests[number], arguments.limit, arguments.seed))
        # Tests without an end in a mistake's limit notice it.
        noticed = ["::" in verdict or verdict == "no end" for verdict in verdicts]
        missed += noticed[0] and not noticed[1]
        name, (_, wrong, instead) = pair[1]
        print(f"{number:3} {name}:{wrong.lineno}  {ast.unparse(wrong)}  ->  {ast.unparse(instead)}")
        print(
            f"    old: {verdicts[0]}\n    new: {verdicts[1]}{'   MISSED' if noticed[0] and not noticed[1] else ''}",
            flush=True,
        )
    print(f"{arguments.count - arguments.first} mistakes; noticed by the old tests alone: {missed}")
    sys.exit(missed > 0)


if __name__ == "__main__":
    main()
