"""Measurements of accuracy, speed and memory: ``python -m tools.bench list|run|docs``.

A measurement is a case, a function registered by `case` in a module of `tools.bench.cases`. It yields rows of figures
as they are measured. The command prints them as a table with a verdict for each row that has a limit, stores them as
JSON, and writes the tables of the documentation from the stored results.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

# The scenes and cameras of `tests/cases.py`.
sys.path.append(str(Path(__file__).parents[2] / "tests"))

from mitsuba_plenoptic import PhysicsWarning

from .registry import Limit, Row, at_least, at_most, case, figure, pick
from .tables import Pivot

__all__ = ["Limit", "Pivot", "Row", "at_least", "at_most", "case", "figure", "pick"]

# Evenly lit pixels and extreme cameras are measured on purpose.
warnings.filterwarnings("ignore", category=PhysicsWarning)
