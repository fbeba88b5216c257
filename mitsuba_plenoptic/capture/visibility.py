"""What of the pupil each radiator sees, and which part of that sends its light into the sampled lenses."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..optics.main_lens import MainLens
from .lens_window import LensWindow
from .pupil_weights import PupilWeights

PUPIL_CELLS = 16
"""Cells of the pupil's bounding square, along an axis, whose visibility is found by one shadow ray each."""

LANES = 2**22
"""Rays that are traced at once."""


def visible_cells(scene: Any, to_world: Any, si: Any, P: np.ndarray, lens: MainLens) -> np.ndarray:
    """Find by one shadow ray a cell which cells of the pupil each hit sees.

    A cell whose centre lies beyond the pupil's edge is tested at the nearest point within. The cell that holds the
    ray which found the hit is open.

    Parameters
    ----------
    scene, to_world, si
        Scene, the camera's transform and the hits: surface interactions of Mitsuba.
    P : (hits, 2) float64 array
        Where the rays that found the hits have passed the pupil.
    lens : MainLens
        The main lens.

    Returns
    -------
    (hits, PUPIL_CELLS**2 // 8) uint8 array
        Bits of the cells, row by row along y.
    """
    radius, cells = lens.pupil_radius, PUPIL_CELLS**2
    centres = (np.arange(PUPIL_CELLS) + 0.5) * 2 / PUPIL_CELLS - 1
    x, y = (axis.ravel() for axis in np.meshgrid(centres, centres))
    inward = np.minimum(1, 0.999 / np.hypot(x, y)) * radius
    targets = to_world @ mi.Point3f(mi.Float(x * inward), mi.Float(y * inward), 0)
    own = _cell_of(P[:, 0] / radius, P[:, 1] / radius)
    bits = np.empty((len(P), cells // 8), np.uint8)
    batch = LANES // cells
    for start in range(0, len(P), batch):
        some = slice(start, min(start + batch, len(P)))
        lane = dr.arange(mi.UInt32, (some.stop - start) * cells)
        hit = lane // cells + start
        point = dr.zeros(mi.SurfaceInteraction3f, dr.width(lane))
        point.p, point.n = dr.gather(mi.Point3f, si.p, hit), dr.gather(mi.Normal3f, si.n, hit)
        blocked = scene.ray_test(point.spawn_ray_to(dr.gather(mi.Point3f, targets, lane % cells)))
        # What is at infinity has no place to send shadow rays from, and is hidden by nothing here.
        blocked &= dr.gather(mi.Bool, si.is_valid(), hit)
        seen = ~blocked.numpy().reshape(-1, cells)
        seen[np.arange(len(seen)), own[some]] = True
        bits[some] = np.packbits(seen, axis=1)
    return bits


def sampled_fraction(
    positions: np.ndarray, weights: PupilWeights | None, lens: MainLens, window: LensWindow
) -> np.ndarray:
    """Return the fraction of the visible pupil that sends each radiator's light into the sampled lenses; (n,).

    The rays through that part are those that could have found the radiator.
    """
    radius = lens.pupil_radius
    X, Y, g = positions.T
    centre = np.stack(lens.land((0.0, 0.0), (X, Y, g)), axis=-1)
    blur = np.abs(np.stack(lens.land((radius, radius), (0.0, 0.0, g)), axis=-1))
    fraction = np.ones(len(positions))
    # Only where the blur leaves the sampled lenses is there anything to count.
    partial = np.flatnonzero(((centre - blur < window.low) | (centre + blur > window.high)).any(axis=1))

    fine = (np.arange(4 * PUPIL_CELLS) + 0.5) / (2 * PUPIL_CELLS) - 1
    x, y = (axis.ravel() for axis in np.meshgrid(fine, fine))
    inside = np.hypot(x, y) <= 1
    x, y = x[inside], y[inside]
    cell = _cell_of(x, y)
    for some in np.array_split(partial, max(1, partial.size * x.size // 2**24)):
        landed = window.holds(*lens.land((x * radius, y * radius), tuple(positions[some].T[..., None])))
        seen = np.ones_like(landed)
        if weights is not None:
            seen = weights.table[weights.index[some]].reshape(len(some), PUPIL_CELLS**2)[:, cell] > 0
        # The ray that found the radiator landed, so the fraction is never nothing.
        fraction[some] = np.maximum((landed & seen).sum(axis=1), 1) / np.maximum(seen.sum(axis=1), 1)
    return fraction


def _cell_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the number of the cell that holds a point of a pupil of radius one."""
    column, row = (np.clip(((axis + 1) / 2 * PUPIL_CELLS).astype(int), 0, PUPIL_CELLS - 1) for axis in (x, y))
    return np.asarray(row * PUPIL_CELLS + column)
