"""Shapes of microlenses: the path that light gains at each point of a cell. A new shape is a new file here.

A shape states the phase in waves, for wave captures, and the slopes of the path, for rays. Both are functions of the
offset from the lens's centre, in the frame rotated with the lattice. Diffraction orders, kernels of signed rays and
directions of rays follow from them.
"""

from .conic import Conic
from .phase_map import PhaseMap
from .sampled import Sampled
from .shape import MicrolensShape
from .zone_lens import ZoneLens

__all__ = ["Conic", "MicrolensShape", "PhaseMap", "Sampled", "ZoneLens"]
