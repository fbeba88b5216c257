"""Laser light: captures of coherent and partially coherent points, and the degree of coherence of a source."""

from .modes import mode_count as mode_count
from .realisations import coherent_capture as coherent_capture

__all__ = ["coherent_capture", "mode_count"]
