"""Solid objects: those of the still life, standing on the plane y = 0, y up, and the fibres before a microscope."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .mesh import Array, Mesh, Point, flat_mesh, polygons


def grid_faces(rows: int, columns: int, *, wrap_rows: bool = False, wrap_columns: bool = False) -> NDArray[np.int64]:
    """Triangles of a grid of rows x columns vertices, optionally closed along an axis."""
    i, j = np.indices((rows if wrap_rows else rows - 1, columns if wrap_columns else columns - 1))
    i1, j1 = (i + 1) % rows, (j + 1) % columns
    a, b, c, d = (p * columns + q for p, q in ((i, j), (i, j1), (i1, j1), (i1, j)))
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], -2).reshape(-1, 3)


def smooth_profile(points: Sequence[Point], samples: int) -> Array:
    """Catmull-Rom curve through points; a point given twice in a row makes a sharp corner."""
    p = np.array(points)
    p = np.vstack([2 * p[0] - p[1], p, 2 * p[-1] - p[-2]])
    curve = []
    for k in range(1, len(p) - 2):
        p0, p1, p2, p3 = p[k - 1 : k + 3]
        if np.array_equal(p1, p2):
            continue
        # Corners take no slope from beyond them.
        p0 = 2 * p1 - p2 if np.array_equal(p0, p1) else p0
        p3 = 2 * p2 - p1 if np.array_equal(p2, p3) else p3
        for t in np.linspace(0, 1, samples, endpoint=False):
            curve.append(
                0.5
                * (2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3)
            )
    curve.append(p[-2])
    return np.array(curve)


def lathe(profile: Array, segments: int) -> Mesh:
    """Turn a profile of (radius, height), bottom to top, about the y axis; edges are shaded smoothly."""
    tangent = np.gradient(profile, axis=0)
    angle = np.arange(segments) * (2 * math.pi / segments)
    c, s = np.cos(angle)[None, :], np.sin(angle)[None, :]

    def turned(radius: Array, height: Array) -> Array:
        return np.stack(np.broadcast_arrays(radius * c, height, radius * s), -1).reshape(-1, 3)

    vertices, normal = turned(profile[:, :1], profile[:, 1:]), turned(tangent[:, 1:], -tangent[:, :1])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    faces = grid_faces(len(profile), segments, wrap_columns=True)[:, ::-1]
    # Those at the poles have no area.
    p, q, r = (vertices[faces[:, k]] for k in range(3))
    return Mesh(vertices, faces[np.linalg.norm(np.cross(q - p, r - p), axis=1) > 1e-9], normal)


def pawn() -> Mesh:
    """Return a chess pawn, 5.2 mm tall on a foot of 1.45 mm radius."""
    foot = [(0.0, 0.0), (1.38, 0.0), (1.38, 0.0), (1.45, 0.1), (1.45, 0.38), (1.3, 0.55), (1.12, 0.66)]
    body = [(1.12, 0.66), (1.16, 0.82), (1.04, 0.98), (0.78, 1.3), (0.57, 1.9), (0.47, 2.6), (0.46, 3.0)]
    collar = [(0.46, 3.0), (0.62, 3.1), (0.86, 3.2), (0.88, 3.3), (0.7, 3.42), (0.46, 3.5)]
    # A ball of radius 0.9 whose equator is at 4.3; the profile runs up its meridian.
    start = math.asin((3.5 - 4.3) / 0.92)
    ball = [(0.92 * math.cos(t), 4.3 + 0.92 * math.sin(t)) for t in np.linspace(start, math.pi / 2, 9)[1:]]
    return lathe(smooth_profile([*foot, *body, *collar, (0.46, 3.5), *ball], 3), 48)


def rounded_die(size: float, radius: float, steps: int) -> Mesh:
    """Return a cube with rounded edges; its six faces share one texture, a 3 x 2 grid of pictures.

    Face k, in the order +x, -x, +y, -y, +z, -z, uses the picture in column k % 3 and row k // 3.
    """
    half, flat = size / 2, size / 2 - radius
    # More lines where the edge bends: its arc in `steps` equal angles, the flat part in one.
    arc = flat + radius * np.tan(np.linspace(0, math.pi / 4, steps + 1))
    line = np.concatenate([-arc[::-1], arc])
    a, b = np.meshgrid(line, line, indexing="ij")
    vertices, normals, texcoords, faces = [], [], [], []
    for k in range(6):
        axis, sign = k // 2, 1.0 if k % 2 == 0 else -1.0
        point = np.empty((*a.shape, 3))
        # (first, second, axis) is right-handed for +, so that faces turn outwards.
        first, second = (axis + 1) % 3, (axis + 2) % 3
        point[..., first], point[..., second], point[..., axis] = sign * a, b, sign * half
        core = np.clip(point, -flat, flat)
        normal = point - core
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        surface = core + radius * normal
        u, v = (a / half + 1) / 2, (b / half + 1) / 2
        texcoords.append(np.stack([(k % 3 + u) / 3, (k // 3 + v) / 2], -1).reshape(-1, 2))
        faces.append(grid_faces(*a.shape)[:, ::-1] + k * a.size)
        vertices.append((surface + np.array([0, half, 0])).reshape(-1, 3))
        normals.append(normal.reshape(-1, 3))
    return Mesh(np.vstack(vertices), np.vstack(faces), np.vstack(normals), np.vstack(texcoords))


def torus_knot(radius: float, tube: float, rows: int, columns: int) -> Mesh:
    """Return a trefoil knot of round section, its axis along z, standing on y = 0."""

    def curve(t: Array) -> Array:
        around = 2 + np.cos(3 * t)
        return np.stack([around * np.cos(2 * t), around * np.sin(2 * t), np.sin(3 * t)], -1) * (radius / 3)

    def unit(x: Array) -> Array:
        return x / np.linalg.norm(x, axis=-1, keepdims=True)

    t = np.arange(rows) * (2 * math.pi / rows)
    h = 1e-3
    centre = curve(t)
    tangent = unit(curve(t + h) - curve(t - h))
    # The frame leans on the torus's own direction, which never runs along the curve.
    spine = np.stack([2 * np.cos(2 * t), 2 * np.sin(2 * t), np.zeros(rows)], -1) * (radius / 3)
    outward = centre - spine
    side = unit(np.cross(tangent, outward))
    up = np.cross(side, tangent)
    angle = np.arange(columns) * (2 * math.pi / columns)
    normal = up[:, None, :] * np.cos(angle)[None, :, None] + side[:, None, :] * np.sin(angle)[None, :, None]
    vertices = (centre[:, None, :] + tube * normal).reshape(-1, 3)
    vertices[:, 1] -= vertices[:, 1].min()
    faces = grid_faces(rows, columns, wrap_rows=True, wrap_columns=True)
    return Mesh(vertices, faces, normal.reshape(-1, 3))


def solid_lambda(height: float, depth: float) -> Mesh:
    """Return the letter lambda, cut from a plate of the given depth, standing on y = 0."""
    h, z = height, depth / 2
    stroke = 0.2 * h
    foot_right, head = 0.36 * h, -0.22 * h

    def long_leg(v: float) -> float:
        """Left edge of the long leg."""
        return head + (foot_right - head) * (1 - v / h)

    join_high, join_low = 0.66 * h, 0.41 * h
    left_foot = -0.46 * h
    long_piece = [(long_leg(0), 0.0), (long_leg(0) + stroke, 0.0), (long_leg(h) + stroke, h), (long_leg(h), h)]
    short_piece = [
        (left_foot, 0.0),
        (left_foot + stroke, 0.0),
        (long_leg(join_low), join_low),
        (long_leg(join_high), join_high),
    ]
    # In picture coordinates, counter-clockwise: short leg, long leg, head.
    outline = [*short_piece[:3], *long_piece, short_piece[3]]
    front = flat_mesh([short_piece, long_piece])
    front.vertices[:, 2] = -z
    sides = polygons(
        [(-u0, v0, -z), (-u0, v0, z), (-u1, v1, z), (-u1, v1, -z)]
        for (u0, v0), (u1, v1) in zip(outline, [*outline[1:], outline[0]], strict=True)
    )
    count = len(front.vertices)
    vertices = np.vstack([front.vertices, front.vertices * [1, 1, -1], sides.vertices])
    return Mesh(vertices, np.vstack([front.faces, front.faces[:, ::-1] + count, sides.faces + 2 * count]))


def fibres() -> Mesh:
    """Return thin fibres between pairs of points: prisms whose perimeter is that of a circle 1 um wide."""
    radius, sides, rings = 0.0005, 16, 9
    angle = np.arange(sides) * (2 * math.pi / sides)
    corners = radius * (math.pi / sides) / math.sin(math.pi / sides) * np.stack([np.cos(angle), np.sin(angle)])
    # Long thin triangles would make it slow to find what a ray meets.
    part = np.linspace(0, 1, rings)[:, None]
    vertices, faces = [], []
    for number, (first, last) in enumerate(np.array(_FIBRES)):
        along = (last - first) / np.linalg.norm(last - first)
        across = np.cross(along, [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        ring = corners[0][:, None] * across + corners[1][:, None] * np.cross(along, across)
        vertices.append(((first + part * (last - first))[:, None] + ring).reshape(-1, 3))
        faces.append(grid_faces(rings, sides, wrap_columns=True) + rings * sides * number)
    return Mesh(np.concatenate(vertices), np.concatenate(faces))


# Their ends in pairs, in millimetres: within 60 um of the native plane of a microscope, in a field of 225 um.
_FIBRES = (
    ((-0.0518, -0.0137, 0.0600), (0.1073, -0.0311, -0.0210)),
    ((-0.0453, -0.0447, 0.0183), (0.1052, 0.0098, 0.0101)),
    ((-0.0513, -0.0801, 0.0600), (0.0507, 0.0431, -0.0080)),
    ((-0.0548, -0.0897, -0.0494), (-0.0028, 0.0617, 0.0310)),
    ((-0.0092, -0.0933, 0.0600), (-0.0372, 0.0643, 0.0055)),
    ((0.0455, -0.0504, -0.0353), (-0.0602, 0.0697, 0.0030)),
    ((0.0810, -0.0107, 0.0439), (-0.0631, 0.0589, -0.0276)),
)
