"""Microlens arrays: arrangements of lenses, and shapes of lenses.

`arrangement` defines lattices and the apertures of their lenses: the lens that a point belongs to, the lens's centre,
and the aperture's outline. Each lattice has its own file, which registers it under the name that the camera's
``mla_lattice`` takes. To add a lattice, write its file and import it here.

A shape states the path that light gains at each point of a cell: the phase in waves, for wave captures, and the slopes
of the path, for rays. Both are functions of the offset from the lens's centre, in the frame rotated with the lattice.
Diffraction orders, kernels of signed rays and directions of rays follow from them. A new shape is a new file here.

`__init__.pyi` names what other folders and extensions may use; it is imported when it is first asked for.
"""

import lazy_loader

# Importing a lattice's file registers it.
from . import hexagonal as hexagonal
from . import square as square

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
