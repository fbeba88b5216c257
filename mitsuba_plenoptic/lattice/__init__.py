"""Arrangements of microlenses: which lens a point belongs to, where its centre is, what its aperture lets through.

`base` says what a lattice is; each lattice has a file of its own, which registers it under the name that the camera's
``mla_lattice`` takes; `apertures` holds the shapes of the lenses. To add a lattice, write its file and import it here.
"""

# Importing a lattice's file registers it.
from ..runtime.backend import turn
from . import hexagonal as hexagonal
from . import square as square
from .apertures import APERTURES
from .arrangement import LATTICES, Lattice, make_lattice, register

__all__ = ["APERTURES", "LATTICES", "Lattice", "make_lattice", "register", "turn"]
