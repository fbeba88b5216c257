"""Mistakes drawn in numeric files, and which of two versions' tests notice them.

    python tools/mutants.py OLD NEW [--count 60] [--seed 1] [--limit 300] [--first 0]

OLD and NEW are checkouts in which ``pytest --cov --cov-context=test`` has run: its data says which tests reach a line.
Mistakes are drawn in files of FOLDERS that are equal in both: a sign, an operator, an index, a bound, a number or a
term that is dropped. Each is made in one checkout after the other, the tests that reach its line run until one fails,
and the file is restored. The table has a line a mistake; the exit status is 1 where only the old tests notice one.
"""

from __future__ import annotations

import argparse
import ast
import random
import subprocess
import sys
import tempfile
from pathlib import Path

import coverage

FOLDERS = ("camera", "design", "lattice", "lenses", "light", "microlens", "optics", "points", "prescription", "refocus")
OPERATORS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
BOUNDS = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}


def mistakes(tree: ast.Module) -> list[tuple[ast.expr, ast.expr]]:
    """Return the expressions inside functions that a mistake replaces, each with the expression in its place."""
    replaced: list[tuple[ast.expr, ast.expr]] = []
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    nodes = {node for function in functions for statement in function.body for node in ast.walk(statement)}
    # Python 3.11 states no true columns inside formatted strings.
    messages = {node for text in nodes if isinstance(text, ast.JoinedStr) for node in ast.walk(text)}
    for node in nodes - messages:
        match node:
            case ast.BinOp(left, operator, right) if type(operator) in OPERATORS:
                replaced.append((node, ast.BinOp(left, OPERATORS[type(operator)](), right)))
                if isinstance(operator, ast.Add | ast.Sub):
                    replaced.append((node, left))
            case ast.UnaryOp(ast.USub(), operand):
                replaced.append((node, operand))
            case ast.Compare(left, [operator], [right]) if type(operator) in BOUNDS:
                replaced.append((node, ast.Compare(left, [BOUNDS[type(operator)]()], [right])))
            case ast.Subscript(value, ast.Constant(int(index))) if index in (0, 1):
                replaced.append((node, ast.Subscript(value, ast.Constant(1 - index), ast.Load())))
            case ast.Constant(float(value)) if value:
                replaced.append((node, ast.Constant(2.0 * value)))
            case ast.Constant(int(value)) if value > 1 and not isinstance(value, bool):
                replaced.append((node, ast.Constant(value + 1)))
    return sorted(replaced, key=lambda pair: (pair[0].lineno, pair[0].col_offset, ast.unparse(pair[1])))


def mutated(source: str, old: ast.expr, new: ast.expr) -> str:
    """Return a source whose one expression is replaced by another, in brackets."""
    lines = source.encode().splitlines(keepends=True)
    assert old.end_lineno is not None and old.end_col_offset is not None
    start = sum(map(len, lines[: old.lineno - 1])) + old.col_offset
    end = sum(map(len, lines[: old.end_lineno - 1])) + old.end_col_offset
    text = source.encode()
    return (text[:start] + f"({ast.unparse(new)})".encode() + text[end:]).decode()


def tests_of(data: coverage.CoverageData, path: Path, line: int) -> list[str]:
    """Return the tests that reach a line of a file."""
    contexts = data.contexts_by_lineno(str(path)).get(line, [])
    return sorted({context.partition("|")[0] for context in contexts if context})


def notice(checkout: Path, path: Path, text: str, tests: list[str], limit: float, seed: int) -> str:
    """Return the first of some tests that fails with another text of a file, 'none' or 'no end'."""
    original = path.read_text()
    files = sorted({test.partition("::")[0] for test in tests})
    random.Random(seed).shuffle(files)
    ordered = sorted(tests, key=lambda test: files.index(test.partition("::")[0]))
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as names:
        names.write("\n".join(ordered))
        names.flush()
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", f"@{names.name}"]
        try:
            path.write_text(text)
            run = subprocess.run(command, cwd=checkout, capture_output=True, text=True, timeout=limit, check=False)
        except subprocess.TimeoutExpired:
            return "no end"
        finally:
            path.write_text(original)
    failures = [row.split()[1] for row in run.stdout.splitlines() if row.startswith(("FAILED ", "ERROR "))]
    return failures[0] if failures else "none" if run.returncode == 0 else f"status {run.returncode}"


def main() -> None:
    """Draw the mistakes and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", nargs=2, type=Path, metavar=("OLD", "NEW"))
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="the first of the drawn mistakes that is tried")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for the tests of a mistake")
    arguments = parser.parse_args()
    checkouts = [checkout.resolve() for checkout in arguments.checkouts]
    reached = []
    for checkout in checkouts:
        recorded = coverage.Coverage(data_file=str(checkout / "build" / "coverage" / "data"))
        recorded.load()
        reached.append(recorded.get_data())
    draws = random.Random(arguments.seed)
    old = checkouts[0] / "mitsuba_plenoptic"
    files = [path.relative_to(checkouts[0]) for folder in FOLDERS for path in sorted((old / folder).glob("*.py"))]
    candidates = []
    for name in files:
        source = (checkouts[0] / name).read_text()
        if (checkouts[1] / name).is_file() and (checkouts[1] / name).read_text() == source:
            candidates += [(name, source, *pair) for pair in mistakes(ast.parse(source))]
    drawn = draws.sample(candidates, arguments.count)
    missed = 0
    for number, (name, source, before, after) in enumerate(drawn[arguments.first :], arguments.first):
        text = mutated(source, before, after)
        verdicts = []
        for checkout, data in zip(checkouts, reached, strict=True):
            tests = tests_of(data, checkout / name, before.lineno)
            verdicts.append(
                notice(checkout, checkout / name, text, tests, arguments.limit, arguments.seed) if tests else "no test"
            )
        noticed = ["::" in verdict for verdict in verdicts]
        missed += noticed[0] and not noticed[1]
        print(f"{number:3} {name}:{before.lineno}  {ast.unparse(before)}  ->  {ast.unparse(after)}")
        print(
            f"    old: {verdicts[0]}\n    new: {verdicts[1]}{'   MISSED' if noticed[0] and not noticed[1] else ''}",
            flush=True,
        )
    print(f"{arguments.count - arguments.first} mistakes; noticed by the old tests alone: {missed}")
    sys.exit(missed > 0)


if __name__ == "__main__":
    main()
