"""The versions that results depend on to the last bit."""

from __future__ import annotations

import hashlib
import importlib.metadata
from functools import cache
from pathlib import Path

# Parts of the package that show results and do not make them.
_SHOWING = {"report", "cli"}


@cache
def software() -> dict[str, str]:
    """Return the versions that results depend on, our own by its source text."""
    package = Path(__file__).parent.parent
    text = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        if not _SHOWING & set(source.relative_to(package).parts[:-1]):
            text.update(source.read_bytes())
    versions = {name: importlib.metadata.version(name) for name in ("mitsuba", "drjit", "numpy", "scipy")}
    return {**versions, "mitsuba_plenoptic": text.hexdigest()[:16]}
