"""Figures beside their limits."""

from __future__ import annotations


class Verdict:
    """Prints figures beside their limits and remembers whether all were kept."""

    def __init__(self) -> None:
        self.kept = True

    def judge(self, what: str, figure: float, limit: float, unit: str = "") -> None:
        """Print a figure that must not be above its limit."""
        good = figure <= limit
        self.kept &= good
        print(f"{'kept  ' if good else 'BROKEN'} {what}: {figure:.5g} {unit}(limit {limit:.5g})", flush=True)
