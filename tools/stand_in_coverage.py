"""Measure which lines of array code run with the stand-in for CuPy: part of ``make coverage``.

The lines counted are those that run while the stand-in is chosen, and those that run as modules are imported. The
modules are those that take their libraries from `runtime.backend`.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import coverage

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "mitsuba_plenoptic"
DATA = ROOT / "build/coverage/stand-in"
TESTS = tuple(f"tests/runtime/test_{name}.py" for name in ("cuda", "device_memory", "launches"))

FAIL_UNDER = 95.0
"""Percent of the lines, below which something has gone untested; some lines are the processor's alone."""

_USES = re.compile(r"\bbackend\(\)|\bbackend_of\(|\.is_cuda\b|\.to_host\(|\.from_drjit\(")


def modules() -> list[Path]:
    """Return the modules whose arrays may lie on a device, without those that store results or manage threads."""
    others = {"checkpoints.py", "batches.py"}
    return [
        path for path in sorted(PACKAGE.rglob("*.py")) if path.name not in others and _USES.search(path.read_text())
    ]


def main() -> None:
    """Run the tests that use the stand-in, print the table, and fail below the limit."""
    DATA.parent.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-m",
        "slow or not slow",
        "--cov",
        "--cov-report=",
        "--cov-fail-under=0",
        *TESTS,
    ]
    subprocess.run(command, check=True, cwd=ROOT, env={**os.environ, "COVERAGE_FILE": str(DATA)})
    measured = coverage.Coverage(data_file=str(DATA), config_file=str(ROOT / "pyproject.toml"))
    measured.load()
    measured.get_data().set_query_contexts(["^$", "^device$"])
    include = [str(path) for path in modules()]
    total = measured.report(include=include, contexts=["^$", "^device$"], show_missing=True, skip_covered=False)
    print(f"Array code run with the stand-in: {total:.1f} %, at least {FAIL_UNDER:g} %")
    sys.exit(total < FAIL_UNDER)


if __name__ == "__main__":
    main()
