"""Extent of a scene point's light in a camera, and the sampling and window that the light's field needs.

Directions are given as direction cosines, as in the angular spectrum.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..errors import SHORTEST, InputError
from ..lenses import Light, MainLens
from ..runtime import MILLIMETRES, POINTS, Doubles, Flags, as_array

_FARTHEST = 1e16
"""Largest coordinate of a scene point, in millimetres; beyond the longest focal length it counts as infinity."""

_WIDEST = 1000
"""Largest number of microlenses across that the light of a point within the focal length may cover."""

_RIM_ANGLES = 32


@dataclass(frozen=True)
class Footprint:
    """Geometric images of scene points on the MLA, with the directions of their light there.

    Every array has the shape (n, 2), for x and y.
    """

    centre: Doubles
    half_width: Doubles
    cosine: Doubles
    half_cosine: Doubles


def footprint(lens: MainLens, positions: Doubles) -> Footprint:
    """Return the footprints of scene points, (n, 3), from rays traced through the pupil to the MLA."""
    angle = 2 * math.pi * np.arange(_RIM_ANGLES) / _RIM_ANGLES
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    P = lens.pupil.radius * np.concatenate([radius * circle for radius in (0.0, 0.4, 0.7, 1.0)])
    point = (positions[:, None, 0], positions[:, None, 1], positions[:, None, 2])
    light = lens.bind(positions)
    is_open = np.broadcast_to(light.is_open((P[:, 0], P[:, 1])), (len(positions), len(P)))
    pupil = np.broadcast_to(P.T[:, None], (2, len(positions), len(P)))
    if not is_open.all():
        positions_in = _drawn_in(light, np.broadcast_to(P, (len(positions), *P.shape)), is_open)
        pupil = np.moveaxis(positions_in, -1, 0)
    cosine = np.stack(np.broadcast_arrays(*light.cosines((pupil[0], pupil[1]), point)))
    square = (cosine**2).sum(0)
    if np.any(square >= 1):
        worst = positions[np.argmax(square.max(1))]
        raise InputError(f"position = {tuple(worst.tolist())}: its light leaves the main lens too steeply")
    cosine = np.broadcast_to(cosine, pupil.shape)
    if lens.pupil.finite:
        return bundle_footprint(pupil, cosine, lens.pupil.distance)
    return _bounds(np.stack(np.broadcast_arrays(*light.land((pupil[0], pupil[1]), point))), cosine)


def _drawn_in(light: Light, P: Doubles, is_open: Flags) -> Doubles:
    """Return points (n, m, 2) with blocked points moved inwards to open places; the last ones are points of the rim.

    Rim points move towards the mean of the open points; other blocked points move to this mean.
    """
    if not is_open.any(1).all():
        # The beam is narrow and passes between these points.
        raise InputError("position: hardly any light of one of the scene points passes the main_lens")
    middle = (P * is_open[..., None]).sum(1, keepdims=True) / is_open.sum(1)[:, None, None]
    away = P[:, -_RIM_ANGLES:] - middle
    low, high = np.zeros((2, *away.shape[:2]))
    high += 1
    # 6: Bisections that find the edges of beams.
    for _ in range(6):
        half = (low + high) / 2
        x, y = np.moveaxis(middle + half[..., None] * away, -1, 0)
        within = light.is_open((x, y))
        low = np.where(within, half, low)
        high = np.where(within, high, half)
    # Just outside the edge, so that the bounds contain the whole beam.
    edge = middle + high[..., None] * away
    return np.concatenate([np.where(is_open[..., None], P, middle)[:, :-_RIM_ANGLES], edge], axis=1)


def bundle_footprint(pupil: Doubles, cosine: Doubles, distance: float) -> Footprint:
    """Return the footprint on the MLA of rays from the exit pupil; both arrays have the shape (2, n, rays)."""
    landing = pupil + distance * cosine / np.sqrt(1 - (cosine**2).sum(0))
    return _bounds(landing, cosine)


def _bounds(landing: Doubles, cosine: Doubles) -> Footprint:
    """Return the bounding boxes of positions and direction cosines, (2, n, rays)."""
    low = landing.min(-1).T
    high = landing.max(-1).T
    first = cosine.min(-1).T
    last = cosine.max(-1).T
    return Footprint((low + high) / 2, (high - low) / 2, (first + last) / 2, (last - first) / 2)


def check_positions(positions: Any, camera: PlenopticCamera | None = None, *, virtual: bool = False) -> Doubles:
    """Return scene points as a float64 array (n, 3); refuse anything else."""
    rule = "it must be numbers (X, Y, g)"
    points = as_array("positions", positions, POINTS, rule=rule, units=MILLIMETRES, shape=(None, 3))
    far = (np.abs(points) > _FARTHEST).any(1)
    rule = f"its coordinates must be {_FARTHEST:g} at most, and g"
    nearest = None if camera is None else camera.lens_data.nearest
    if nearest is not None:
        _refuse_any(points, far | (points[:, 2] <= nearest), f"{rule} more than {nearest:.6g}: before the objective")
        return points
    g = np.abs(points[:, 2]) if virtual else points[:, 2]
    _refuse_any(points, far | (g < SHORTEST), f"{rule} at least {SHORTEST:g}: in front of the main lens")
    if camera is not None and len(points):
        # A point far within the focal length, such as one given in metres, has light that exceeds any memory.
        closest = points[np.abs(points[:, 2]).argmin()]
        depth = float(closest[2])
        image, width = camera.image_samples
        blur = 2 * camera.aperture_radius * abs(1 + camera.mla_distance * (1 / depth - 1 / camera.focal_length))
        if abs(depth) < camera.focal_length and blur > _WIDEST * width:
            raise InputError(
                f"position = {_format(closest)}: its light would cover {blur / width:.3g} {image} across, "
                f"as it is within the focal length of {camera.focal_length:g} mm: lengths are millimetres; are the "
                "points in metres?"
            )
    return points


def _refuse_any(points: Doubles, bad: Any, rule: str) -> None:
    """Refuse points if any is bad, with the first bad one in the message."""
    if bad.any():
        raise InputError(f"position = {_format(points[bad][0])}: {rule}")


def _format(point: Doubles) -> str:
    return "(" + ", ".join(f"{coordinate:g}" for coordinate in point) + ")"
