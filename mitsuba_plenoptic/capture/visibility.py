"""What of the pupil each radiator sees, and which part of that sends its light into the sampled lenses."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..optics.main_lens import MainLens
from ..optics.telecentric import TelecentricLens
from ..optics.thin import ThinLens
from .chains import Optics, leads_to
from .entrance import Entrances
from .lens_window import LensWindow
from .places import Place, Vertex
from .pupil_weights import PupilWeights

PUPIL_CELLS = 16
"""Cells of the pupil's bounding square, along an axis, whose visibility is found by one shadow ray each."""

LANES = 2**22
"""Rays that are traced at once."""

_PLANE_TOLERANCE = 2e-4
"""How far from a place, over the distance, a shadow ray may pass it: the rounding of single precision."""

_CURVED_TOLERANCE = 0.02
"""The same behind refracting or curved surfaces, whose light does not seem to come from one point."""


def visible_cells(
    optics: Optics, to_world: Any, vertex: Vertex, ray: Any, entrances: Entrances, radius: float
) -> NDArray[np.uint8]:
    """Find by one shadow ray a cell which cells of the pupil see each place from which light comes.

    Shadow rays take the same null and delta lobes as the rays that have found the places; those from infinity are
    parallel. A cell whose centre lies beyond the pupil's edge is tested at the nearest point within. The cell that
    holds the ray which found the place is open.

    Parameters
    ----------
    optics : Optics
        Scene and child.
    to_world : Transform4f
        The camera's transform.
    vertex : Vertex
        The places.
    ray : Ray3f
        The rays that have found them.
    entrances : Entrances
        Where light enters the main lens.
    radius : float
        Of the pupil.

    Returns
    -------
    (n, PUPIL_CELLS**2 // 8) uint8 array
        Bits of the cells, row by row along y.
    """
    cells, P = PUPIL_CELLS**2, entrances.pupil
    centres = (np.arange(PUPIL_CELLS) + 0.5) * 2 / PUPIL_CELLS - 1
    x, y = (axis.ravel() for axis in np.meshgrid(centres, centres))
    inward = np.minimum(1, 0.999 / np.hypot(x, y)) * radius
    targets = mi.Point2f(mi.Float(x * inward), mi.Float(y * inward))
    own = _cell_of(P[:, 0] / radius, P[:, 1] / radius)
    bits = np.empty((len(P), cells // 8), np.uint8)
    batch = LANES // cells
    for start in range(0, len(P), batch):
        some = slice(start, min(start + batch, len(P)))
        lane = dr.arange(mi.UInt32, (some.stop - start) * cells)
        which, place = lane // cells + dr.opaque(mi.UInt32, start), dr.gather(mi.Point2f, targets, lane % cells)
        target = to_world @ entrances.at(place.x, place.y, which)
        blocked = _blocked(optics, target, dr.gather(Vertex, vertex, which), dr.gather(mi.Ray3f, ray, which))
        seen = ~blocked.numpy().reshape(-1, cells)
        seen[np.arange(len(seen)), own[some]] = True
        bits[some] = np.packbits(seen, axis=1)
    return bits


def _blocked(optics: Optics, target: Any, vertex: Vertex, ray: Any) -> Any:
    """Whether something stands between points of the pupil and the places that rays from others have found."""
    place = vertex.place
    if optics.plain:
        point = dr.zeros(mi.SurfaceInteraction3f, dr.width(target))
        point.p, point.n = place.point, place.normal
        towards = point.spawn_ray_to(target)
        away = mi.Ray3f(target, ray.d)
        return optics.scene.ray_test(dr.select(place.escaped, away, towards))
    arrived, _, _ = leads_to(optics, aimed_at(vertex, ray, target), vertex.key, place, tolerance(place))
    return ~arrived


def aimed_at(vertex: Vertex, ray: Any, point: Any) -> Any:
    """Return rays from points of the pupil towards the places from which light seems to come, be it beyond infinity.

    Parameters
    ----------
    vertex : Vertex
        The places.
    ray : Ray3f
        The rays that have found them.
    point : Point3f
        Points of the pupil in the world.
    """
    direction = dr.normalize(ray.d + (ray.o - point) * dr.rcp(vertex.place.distance))
    return mi.Ray3f(point, direction, ray.time, ray.wavelengths)


def tolerance(place: Place) -> Any:
    """Return how far from places, over the distance, rays may pass that count as coming from there."""
    return dr.select(place.curved, _CURVED_TOLERANCE, _PLANE_TOLERANCE)


def sampled_fraction(
    positions: np.ndarray, weights: PupilWeights | None, lens: MainLens, window: LensWindow
) -> np.ndarray:
    """Return the fraction of the visible pupil that sends each radiator's light into the sampled lenses; (n,).

    The rays through that part are those that could have found the radiator.
    """
    radius = lens.pupil_radius
    centre = lens.images(positions)
    # More than any ray's: aberrations are small against half of a lens and a tenth of the blur.
    blur = radius * np.abs(1 - lens.pupil_distance * lens.convergence(positions[:, 2]))[:, None]
    if isinstance(lens, TelecentricLens):
        blur = np.array([[lens.objective.blur_diameter(depth) / 2] for depth in positions[:, 2].tolist()])
    elif not isinstance(lens, ThinLens):
        blur = 1.1 * blur + np.hypot(*window.lattice.basis[0]) / 2
    fraction = np.ones(len(positions))
    # Only where the blur leaves the sampled lenses is there anything to count.
    partial = np.flatnonzero(((centre - blur < window.low) | (centre + blur > window.high)).any(axis=1))

    fine = (np.arange(4 * PUPIL_CELLS) + 0.5) / (2 * PUPIL_CELLS) - 1
    x, y = (axis.ravel() for axis in np.meshgrid(fine, fine))
    inside = np.hypot(x, y) <= 1
    x, y = x[inside], y[inside]
    cell = _cell_of(x, y)
    for some in np.array_split(partial, max(1, partial.size * x.size // 2**24)):
        light, pupil = lens.bind(positions[some]), (x * radius, y * radius)
        landed = window.holds(*light.land(pupil, tuple(positions[some].T[..., None])))
        seen = np.broadcast_to(light.is_open(pupil), landed.shape).astype(float)
        if weights is not None:
            seen *= 1 + weights.slant[some] @ np.stack([x, y])
            seen *= weights.table[weights.index[some]].reshape(len(some), PUPIL_CELLS**2)[:, cell] > 0
        # The ray that found the radiator landed, so the fraction is never nothing.
        fraction[some] = np.maximum((landed * seen).sum(axis=1), 1) / np.maximum(seen.sum(axis=1), 1)
    return fraction


def _cell_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the number of the cell that holds a point of a pupil of radius one."""
    column, row = (np.clip(((axis + 1) / 2 * PUPIL_CELLS).astype(int), 0, PUPIL_CELLS - 1) for axis in (x, y))
    return np.asarray(row * PUPIL_CELLS + column)
