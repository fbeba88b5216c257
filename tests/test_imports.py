"""Imports run one way through the package, and importing it is quick."""

import ast
from pathlib import Path

import pytest

import mitsuba_plenoptic

PACKAGE = Path(mitsuba_plenoptic.__file__).parent

# Each may import what stands before it. Of io, the modules that read lens files serve the camera, too.
FLOORS = (
    "errors", "lens_data", "runtime", "lattice", "prescription", "objective", "collimator", "presets",
    "io.files", "microlens", "phase_screen", "far_sources", "io.lens_designs", "io.zemax_file", "io.codev_file",
    "io.lens_file", "camera",
    "focusing", "io", "detector", "optics", "lenses", "system", "design", "operator", "capture", "laser",
    "plugins", "lightfield", "calibration", "fitting", "onchip", "reconstruction", "wavefront", "optimisation",
    "array_functions", "scene_functions", "torch", "jax", "hcipy", "report", "dataset",
    "benchmark", "cli", "__main__",
)  # fmt: skip


def floor(names: list[str]) -> str:
    """The floor of a module below the package, which most share with all of their folder."""
    return ".".join(names[:2]) if ".".join(names[:2]) in FLOORS else names[0]


def imported(path: Path) -> set[str]:
    """Floors, below the package, of what a file imports from it."""
    parts = path.relative_to(PACKAGE).parts[:-1]
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            names = [*parts[: len(parts) - node.level + 1], *(node.module or "").split(".")]
            names = [name for name in names if name]
            found |= {floor(names)} if names else {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_one_way(path):
    first = floor(list(path.relative_to(PACKAGE).with_suffix("").parts))
    if first == "__init__":
        return
    allowed = {*FLOORS[: FLOORS.index(first) + 1]}
    # A sentence that names the version is no arrow upwards.
    assert imported(path) - {"__version__"} <= allowed
