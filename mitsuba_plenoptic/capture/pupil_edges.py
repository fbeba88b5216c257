"""The edges of a real main lens's exit pupil as microlenses see them: which places are open, roughly but quickly."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics.lens_system import LensSystem
from ..optics.open_pupil import pupil_bound

Pair = tuple[Any, Any]

_WITHIN = 3
"""Times that a place is moved within all edges, one after the other."""

_HEIGHTS, _ACROSS, _WIDER = 17, 61, 1.3
"""Lenses and places on the pupil from which edges are found, and how far out, over the radius that light fills."""

_NEAR = 0.1
"""How far from an edge, over its radius, rays tell where it is."""

_OUTSIDE = 1.1
"""Largest height of lenses over that of the detector's corner."""

_LEAST = 12
"""Rays near an edge from which on they tell where it is."""

_POWERS = 3
"""Coefficients of the edges over the squared height of the lens."""


@dataclass(frozen=True)
class PupilEdges:
    """The edges that cut the beams to lenses: about circles on the exit pupil.

    Attributes
    ----------
    surfaces : tuple of int
        Their numbers in the order of the scene's light.
    centres, radii : list of float64 array (powers,)
        For lenses at the height h above the axis, how far above it a circle's centre lies, over h, and its radius:
        coefficients of the powers of :math:`h^2`, from the highest on.
    """

    surfaces: tuple[int, ...]
    centres: list[NDArray[np.float64]]
    radii: list[NDArray[np.float64]]

    @classmethod
    def of(cls, camera: PlenopticCamera) -> PupilEdges:
        """Find those of a camera with a real main lens, for lenses all over its detector."""
        return _edges(camera.replace(crop_offset=(0, 0), crop_size=camera.resolution))

    def within(self, pupil: Pair, centre: Pair) -> Pair:
        """Return places of the pupil, those that are beyond an edge for a lens moved to it."""
        square = centre[0] * centre[0] + centre[1] * centre[1]
        circles = [tuple(_horner(row, square) for row in rows) for rows in zip(self.centres, self.radii, strict=True)]
        x, y = pupil
        for _ in range(_WITHIN):
            for away, radius in circles:
                mx, my = (away * c for c in centre)
                dx, dy = x - mx, y - my
                inward = dr.minimum(1, radius * dr.rsqrt(dr.maximum(dx * dx + dy * dy, 1e-12)))
                x, y = mx + dx * inward, my + dy * inward
        return x, y


@functools.lru_cache(maxsize=8)
def _edges(camera: PlenopticCamera) -> PupilEdges:
    """Trace rays to all of the pupil, and fit circles to the edges that they meet first."""
    lens, radius = LensSystem.of(camera), _WIDER * pupil_bound(camera)
    corner = _OUTSIDE * np.hypot(camera.detector_width, camera.detector_height) / 2
    axis = np.linspace(-1, 1, _ACROSS) * radius
    h, x, y = (v.ravel() for v in np.meshgrid(np.linspace(0, corner, _HEIGHTS), axis, axis, indexing="ij"))
    every = range(len(lens.prescription.surfaces))
    with np.errstate(all="ignore"):
        edges = np.array(lens.ray_and_edges((x, y), (0 * h, h), every)[2])
    edges[~np.isfinite(edges)] = np.inf
    greatest = edges.max(0)
    rim = np.abs(greatest - 1) < _NEAR
    rows = {int(surface): _circles(h, x, y, edges[surface]) for surface in np.unique(edges.argmax(0)[rim])}
    # An edge that hardly any ray meets cuts next to nothing.
    found = {surface: row for surface, row in rows.items() if row is not None}
    return PupilEdges(tuple(found), [row[0] for row in found.values()], [row[1] for row in found.values()])


def _circles(
    h: NDArray, x: NDArray, y: NDArray, edge: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Fit circles to an edge, height by height, and polynomials to these; return as of `PupilEdges`, or None."""
    found = []
    for height in np.unique(h):
        near = (h == height) & (np.abs(edge - 1) < _NEAR)
        if np.count_nonzero(near) < _LEAST:
            continue
        # r^2 = p (x^2 + y^2) + q y + t
        basis = np.column_stack([x[near] ** 2 + y[near] ** 2, y[near], np.ones(np.count_nonzero(near))])
        p, q, t = np.linalg.lstsq(basis, edge[near] ** 2, rcond=None)[0]
        middle = -q / (2 * p)
        found.append((height**2, middle / height if height else np.nan, np.sqrt((1 - t) / p + middle**2)))
    square, middle, radius = np.array(found).reshape(-1, 3).T
    known = np.isfinite(middle)
    if not known.any():
        return None
    powers = min(_POWERS, int(np.count_nonzero(known))) - 1
    return np.polyfit(square[known], middle[known], powers), np.polyfit(square, radius, powers)


def _horner(coefficients: NDArray[np.float64], value: Any) -> Any:
    total: Any = float(coefficients[0])
    for coefficient in coefficients[1:]:
        total = total * value + float(coefficient)
    return total
