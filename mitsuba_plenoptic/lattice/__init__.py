"""Arrangements of microlenses: the lens that a point belongs to, the lens's centre, and the aperture's outline.

`arrangement` defines lattices and the apertures of their lenses; each lattice has its own file, which registers it
under the name that the camera's ``mla_lattice`` takes. To add a lattice, write its file and import it here.
"""

# Importing a lattice's file registers it.
from ..runtime import turn
from . import hexagonal as hexagonal
from . import square as square
from .arrangement import APERTURES, LATTICES, NO_LATTICE, Lattice, make_lattice, register
from .lens_shifts import Displacement

__all__ = ["APERTURES", "LATTICES", "NO_LATTICE", "Displacement", "Lattice", "make_lattice", "register", "turn"]
