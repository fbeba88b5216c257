"""Designing cameras: parameters by which a stated figure of their wave captures is best."""

from .figures import DepthInformation, RefocusedContrast
from .search import Design, Figure, maximise

__all__ = ["DepthInformation", "Design", "Figure", "RefocusedContrast", "maximise"]
