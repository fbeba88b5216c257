"""The ten figures of the case ``history``, followed from commit to commit by ``asv run`` and ``asv publish``."""

from __future__ import annotations

import sys
from pathlib import Path

# At the end, so that the package is that of the commit which is measured, not of this tree.
sys.path.append(str(Path(__file__).resolve().parents[1]))

import mitsuba as mi

from tools.bench.cases.costs import HISTORY


class History:
    """Each figure in its unit."""

    timeout = 300
    params = tuple(HISTORY)
    param_names = ("figure",)

    def setup(self, name: str) -> None:
        """Choose the variant."""
        mi.set_variant("llvm_ad_mono")

    def track(self, name: str) -> float:
        """Return the figure."""
        return HISTORY[name][0]()
