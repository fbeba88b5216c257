"""Designing cameras: parameters by which a stated figure of their wave captures is best."""

from .design_search import Design, Figure, maximise
from .merit import DepthInformation, RefocusedContrast

__all__ = ["DepthInformation", "Design", "Figure", "RefocusedContrast", "maximise"]
