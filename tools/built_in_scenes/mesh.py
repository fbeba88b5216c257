"""Triangle meshes, and the PLY files that Mitsuba reads.

Flat figures (letters, chart) are drawn in *picture coordinates*, u to the right and v up as the camera sees them, and
stored as (x, y, z) = (-u, v, 0) with normals along -z: the camera looks along +z with +x to its left, so they are
upright, unmirrored, and their radiating side faces the camera. Lengths are millimetres.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float]
Piece = Sequence[Point]
Array = NDArray[np.float64]


@dataclass
class Mesh:
    """Triangles with optional vertex normals and texture coordinates.

    Attributes
    ----------
    vertices : ndarray, (n, 3)
        Positions.
    faces : ndarray of int, (m, 3)
        Vertex indices, counter-clockwise seen from outside.
    normals : ndarray, (n, 3), optional
        Unit vertex normals, for smooth surfaces.
    texcoords : ndarray, (n, 2), optional
        Texture coordinates u, v.
    """

    vertices: Array
    faces: NDArray[np.int64]
    normals: Array | None = None
    texcoords: Array | None = None

    def write_ply(self, path: Path) -> None:
        """Write a binary little-endian PLY file with the property names that Mitsuba reads."""
        parts = [("x y z", self.vertices), ("nx ny nz", self.normals), ("u v", self.texcoords)]
        columns = [(names, part) for names, part in parts if part is not None]
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(self.vertices)}"]
        header += [f"property float {name}" for names, _ in columns for name in names.split()]
        header += [f"element face {len(self.faces)}", "property list uchar int vertex_indices", "end_header"]
        # Rounding hides last-digit differences between maths libraries; adding 0 turns -0 into 0.
        rows = (np.round(np.hstack([part for _, part in columns]), 6) + 0.0).astype("<f4")
        faces = np.empty(len(self.faces), dtype=[("count", "u1"), ("indices", "<i4", 3)])
        faces["count"] = 3
        faces["indices"] = self.faces
        path.write_bytes("\n".join([*header, ""]).encode("ascii") + rows.tobytes() + faces.tobytes())


def flat_mesh(pieces: Iterable[Piece]) -> Mesh:
    """Make a mesh that faces the camera of convex, counter-clockwise, disjoint polygons in picture coordinates."""
    return polygons([(-u, v, 0.0) for u, v in piece] for piece in pieces)


def polygons(pieces: Iterable[Sequence[tuple[float, float, float]]]) -> Mesh:
    """Make a mesh of convex polygons, each a fan of triangles about its first corner."""
    vertices: list[tuple[float, float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for piece in pieces:
        first = len(vertices)
        vertices += piece
        faces += [(first, first + i, first + i + 1) for i in range(1, len(piece) - 1)]
    return Mesh(np.array(vertices), np.array(faces))
