"""The square microlens lattice: which cell holds a point, and where that cell's centre is.

The lattice covers the whole plane and a corner of four cells lies on the axis, so that a detector of an even
number of lenses holds whole ones. Along each axis the cells are the same, so every function works on one
coordinate, and on floats, NumPy arrays and Dr.Jit arrays alike.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


def cell_index(coordinate: Any, pitch: Any) -> Any:
    """Index (a whole number, as a float) of the cell that holds a coordinate in the MLA plane."""
    scaled = coordinate / pitch
    return np.floor(scaled) if isinstance(scaled, (float, np.ndarray)) else dr.floor(scaled)


def cell_centre(index: Any, pitch: Any) -> Any:
    """Coordinate of the centre of the cell with this index, :math:`(i + 1/2) D_2`."""
    return (index + 0.5) * pitch
