"""Designing cameras: numbers by which a stated figure of their wave captures is best."""

from .depth import DepthInformation
from .search import Design, Figure, maximise
from .sharpness import RefocusedContrast

__all__ = ["DepthInformation", "Design", "Figure", "RefocusedContrast", "maximise"]
