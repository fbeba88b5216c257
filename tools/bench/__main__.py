"""The command: list the cases, run some, write the tables of the documentation from the last results."""

from __future__ import annotations

import argparse
import importlib.util
import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import scipy

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.runtime.fft import worker_count

from . import registry, tables
from .registry import Case, Row

ROOT = Path(__file__).resolve().parents[2]
RESULTS = Path("build/bench")
PAGES = ("README.md", "docs/**/*.md")


def main(words: list[str] | None = None) -> int:
    """Do what the command line asks; 1 where a figure is beyond its limit, 2 where something cannot be done."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="name all cases, what they measure, their limits and options")
    run_parser = commands.add_parser("run", help="run cases")
    run_parser.add_argument("names", nargs="+", metavar="NAME|OPTION=VALUE", help="cases, groups of cases, and options")
    run_parser.add_argument("--quick", action="store_true", help="small sizes, to see that a case works")
    docs_parser = commands.add_parser("docs", help="write the tables of the pages from the last full results")
    docs_parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 if a table would change")
    for sub in (run_parser, docs_parser):
        sub.add_argument("--output", type=Path, default=RESULTS, help="folder of results (default: %(default)s)")
    given = parser.parse_args(words)
    try:
        if given.command == "list":
            return show_list()
        if given.command == "docs":
            return write_docs(ROOT, given.output, given.check)
        cases = registry.find(word for word in given.names if "=" not in word)
        chosen = registry.options(cases, (word for word in given.names if "=" in word))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    failed, refused = [], []
    for each in cases:
        try:
            if run(each, chosen[each.name], given.quick, given.output):
                failed.append(each.name)
        except InputError as error:
            refused.append(each.name)
            print(f"{each.name}: NOT RUN: {error}", file=sys.stderr, flush=True)
    if len(cases) > 1:
        print(f"{len(cases)} cases; FAILED: {', '.join(failed) or 'none'}; not run: {', '.join(refused) or 'none'}")
    return 1 if failed else 2 if refused else 0


def show_list() -> int:
    """Print all cases."""
    for each in registry.load().values():
        bounds = ", ".join(
            f"{limit.figure} {'>=' if limit.least else '<='} {limit.bound}"
            for limit in each.limits
            if not isinstance(limit.bound, str)
        )
        limit = bounds or ("each row its own" if each.limits else "none")
        print(f"{each.name}: {each.what}\n    limit: {limit}; page: {each.page or 'none'}")
        if each.defaults:
            print("    options: " + " ".join(f"{name}={_word(value)}" for name, value in each.defaults.items()))
    return 0


def run(case: Case, options: dict[str, Any], quick: bool, output: Path) -> bool:
    """Run a case, print its rows as they come and store them; return whether it failed."""
    missing = [name for name in case.needs if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"it needs {', '.join(missing)}, of the extras `peers` and `lenses`")
    folder = output / case.name
    folder.mkdir(parents=True, exist_ok=True)
    mi.set_variant(case.variant)
    settings = {**(case.quick if quick else {}), **options}
    files = {"output": folder} if case.writes_files else {}
    headings = {**case.columns, **({"verdict": "{verdict}"} if case.limits else {})}
    print(f"{case.name}: {case.what}\n{tables.markdown(headings, [])}", flush=True)
    rows: list[Row] = []
    result = {
        "case": case.name, "what": case.what, "quick": quick, "options": options, "machine": _machine(), "rows": rows
    }  # fmt: skip
    start = time.perf_counter()
    for row in case.function(**settings, **files):
        rows.append({**row, "verdict": case.verdict(row)})
        print(tables.markdown(headings, rows[-1:]).splitlines()[-1], flush=True)
        result["seconds"] = round(time.perf_counter() - start, 1)
        # After every row, so that what has been measured is not lost.
        (output / f"{case.name}.json").write_text(json.dumps(result, indent=1, default=_plain) + "\n")
    verdicts = [row["verdict"] for row in rows]
    failed = any(verdict.startswith("FAILED") for verdict in verdicts)
    if case.limits and not any(verdicts) and not quick:
        print(f"FAILED: {case.name} measured nothing that has a limit")
        failed = True
    print(f"{case.name}: {'FAILED' if failed else 'ok' if case.limits else 'measured'}, "
          f"{time.perf_counter() - start:.0f} s\n", flush=True)  # fmt: skip
    return failed


def write_docs(root: Path, results: Path, check: bool = False) -> int:
    """Write the tables of all pages from full results with the options that each mark states."""
    changed = False

    def table(name: str, words: list[str]) -> str | None:
        (case,) = registry.find([name])
        file = results / f"{name}.json"
        if not file.exists():
            return None
        found = json.loads(file.read_text())
        wanted = json.loads(json.dumps(registry.options([case], words)[name], default=_plain))
        if found["quick"] or found["options"] != wanted:
            print(f"{name}: the last results are quick or have other options; the table stays")
            return None
        return case.pivot.markdown(found["rows"]) if case.pivot else tables.markdown(case.columns, found["rows"])

    for page in sorted(path for pattern in PAGES for path in root.glob(pattern)):
        text = page.read_text()
        new = tables.with_tables(text, table)
        if new != text:
            changed = True
            print(f"{page.relative_to(root)}: {'differs' if check else 'written'}")
            if not check:
                page.write_text(new)
    return int(check and changed)


def _machine() -> dict[str, Any]:
    return {
        "threads": worker_count(), "python": platform.python_version(), "numpy": np.__version__,
        "scipy": scipy.__version__, "mitsuba": mi.__version__,
    }  # fmt: skip


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _word(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


if __name__ == "__main__":
    sys.exit(main())
