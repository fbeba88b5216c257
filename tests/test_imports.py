"""Imports run one way through the package, and importing it is quick."""

import ast
from pathlib import Path

import pytest

import mitsuba_plenoptic

PACKAGE = Path(mitsuba_plenoptic.__file__).parent

# Each may import what stands before it; runtime and io serve all of them.
FLOORS = (
    "errors", "bounds", "thin_lens", "runtime", "lattice", "prescription", "objective", "presets",
    "camera", "focusing", "io", "mosaic", "detector", "optics", "design", "capture", "plugins", "lightfield",
    "calibration", "fitting", "reconstruction", "optimisation", "report", "dataset", "cli", "__main__",
)  # fmt: skip


def imported(path: Path) -> set[str]:
    """First names, below the package, of what a file imports from it."""
    parts = path.relative_to(PACKAGE).parts[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            names = [*parts[: len(parts) - node.level + 1], *(node.module or "").split(".")]
            names = [name for name in names if name]
            found |= {names[0]} if names else {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_one_way(path):
    first = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if first == "__init__":
        return
    allowed = {*FLOORS[: FLOORS.index(first) + 1]}
    # A sentence that names the version is no arrow upwards.
    assert imported(path) - {"__version__"} <= allowed
