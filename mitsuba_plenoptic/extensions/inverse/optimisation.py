"""Camera design: parameters that maximise a figure of merit of the camera's wave captures."""

from .design_search import Design, Figure, maximise
from .merit import DepthInformation, RefocusedContrast

__all__ = ["DepthInformation", "Design", "Figure", "RefocusedContrast", "maximise"]
