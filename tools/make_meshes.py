"""Write the meshes and textures of the built-in scenes.

Usage: ``python tools/make_meshes.py [-o DIRECTORY]``; without a directory, the files in ``scenes/`` are
replaced.

Everything is defined by the geometry below and comes out the same, byte for byte, wherever it runs:
coordinates are rounded to a nanometre before they become float32, and textures are stored without
compression, because compressors differ between builds of zlib.

Lengths are millimetres. Flat figures (letters, chart) are drawn in *picture coordinates*, u to the right and
v up as the camera sees them, and stored as (x, y, z) = (-u, v, 0) with normals along -z: the camera looks
along +z with +x to its left, so they are upright, unmirrored, and their radiating side faces the camera.
Their triangles never overlap, so that the area of a mesh is the area of the figure. Solid objects stand on
the plane y = 0, y up.
"""

from __future__ import annotations

import argparse
import itertools
import math
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SCENES = Path(__file__).resolve().parent.parent / "scenes"

Point = tuple[float, float]
Piece = Sequence[Point]
Colour = tuple[int, int, int]
Array = NDArray[np.float64]

LETTER_HEIGHT = 4.0


# ------------------------------------------------------------------------------------------------------------
# Files
# ------------------------------------------------------------------------------------------------------------


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


def write_png(path: Path, indices: NDArray[np.uint8], palette: Sequence[Colour]) -> None:
    """Write a PNG of 4 bits per pixel with a palette of up to 16 sRGB colours, uncompressed."""
    rows, columns = indices.shape
    packed = (indices[:, 0::2] << 4) | indices[:, 1::2]
    raw = np.hstack([np.zeros((rows, 1), np.uint8), packed.astype(np.uint8)]).tobytes()
    stream = b"\x78\x01"
    for start in range(0, len(raw), 65535):
        block = raw[start : start + 65535]
        stream += struct.pack("<BHH", start + 65535 >= len(raw), len(block), len(block) ^ 0xFFFF) + block
    stream += struct.pack(">I", zlib.adler32(raw))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 4, 3, 0, 0, 0))
        + chunk(b"PLTE", bytes(value for colour in palette for value in colour))
        + chunk(b"IDAT", stream)
        + chunk(b"IEND", b"")
    )


def write_hdr(path: Path, image: Array) -> None:
    """Write (rows, columns, 3) radiances as Radiance HDR, uncompressed."""
    exponent = np.frexp(image.max(axis=-1))[1]
    mantissa = np.clip(np.floor(np.ldexp(image, 8 - exponent[..., None]) + 0.500001), 0, 255)
    pixels = np.concatenate([mantissa, exponent[..., None] + 128], axis=-1).astype(np.uint8)
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {len(image)} +X {image.shape[1]}\n"
    path.write_bytes(header.encode("ascii") + pixels.tobytes())


# ------------------------------------------------------------------------------------------------------------
# Flat figures, in picture coordinates
# ------------------------------------------------------------------------------------------------------------


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


def rectangle(left: float, right: float, bottom: float, top: float) -> Piece:
    """Corners of an upright rectangle."""
    return [(left, bottom), (right, bottom), (right, top), (left, top)]


def clipped_ring(centre: Point, outer: Point, inner: Point, level: float, segments: int) -> list[Piece]:
    """Quadrilaterals of an elliptical ring, cut off at a level that lies between hole and rim.

    Parameters
    ----------
    centre, outer, inner : (float, float)
        Centre and the semi-axes of rim and hole.
    level : float
        The ring is cut at v = `level`; its centre's side is kept.
    segments : int
        Number of quadrilaterals around an uncut ring.
    """
    sine = (level - centre[1]) / outer[1]
    corner = math.asin(sine)
    step = 2 * math.pi / segments
    # The corners where the rim meets the cut must be among the angles, or they would be cut off.
    angles = sorted({*(i * step for i in range(segments)), corner % (2 * math.pi), (math.pi - corner) % (2 * math.pi)})
    side = 1.0 if level < centre[1] else -1.0

    def ends(angle: float) -> tuple[Point, Point]:
        c, s = math.cos(angle), math.sin(angle)
        hole = (centre[0] + inner[0] * c, centre[1] + inner[1] * s)
        rim = (centre[0] + outer[0] * c, centre[1] + outer[1] * s)
        if side * (rim[1] - level) < 0:
            t = (level - hole[1]) / (rim[1] - hole[1])
            rim = (hole[0] + t * (rim[0] - hole[0]), level)
        return hole, rim

    quads = []
    for a, b in zip(angles, [*angles[1:], angles[0]], strict=True):
        (hole_a, rim_a), (hole_b, rim_b) = ends(a), ends(b)
        quads.append([hole_a, rim_a, rim_b, hole_b])
    return quads


def letter_eight() -> list[Piece]:
    """Return the '8': two elliptical rings that share a stroke at the waist, each cut at the waist line."""
    stroke, waist, half_width, top = 0.74, 0.12, 1.1, LETTER_HEIGHT / 2
    lower = (half_width, (waist + stroke / 2 + top) / 2)
    lower_centre = (0.0, lower[1] - top)
    upper_height = (top - waist + stroke / 2) / 2
    upper_centre = (0.0, top - upper_height)
    # The upper rim is as wide as makes both rims meet at the waist line.
    meet = lower[0] * math.sqrt(1 - ((waist - lower_centre[1]) / lower[1]) ** 2)
    upper = (meet / math.sqrt(1 - ((waist - upper_centre[1]) / upper_height) ** 2), upper_height)
    pieces = []
    for centre, outer in ((upper_centre, upper), (lower_centre, lower)):
        pieces += clipped_ring(centre, outer, (outer[0] - stroke, outer[1] - stroke), waist, 64)
    return pieces


def letter_f() -> list[Piece]:
    """Return the 'F': a stem and two bars that touch it."""
    half, top, stroke = 1.05, LETTER_HEIGHT / 2, 0.72
    return [
        rectangle(-half, -half + stroke, -top, top),
        rectangle(-half + stroke, half, top - stroke, top),
        rectangle(-half + stroke, half - 0.3, -0.2, -0.2 + stroke),
    ]


def letter_hash() -> list[Piece]:
    """Return the '#': two slanted bars whole, and two level ones in pieces between and beside them."""
    half, top, stroke, slant = 1.4, LETTER_HEIGHT / 2, 0.62, 0.16
    stems = [(-0.55 - stroke / 2, -0.55 + stroke / 2), (0.55 - stroke / 2, 0.55 + stroke / 2)]

    def at(u: float, v: float) -> Point:
        return (u + slant * v, v)

    pieces = [[at(a, -top), at(b, -top), at(b, top), at(a, top)] for a, b in stems]
    for middle in (-0.68, 0.68):
        low, high = middle - stroke / 2, middle + stroke / 2
        # The free ends are upright at the mean slant of the bar's height.
        left, right = -half + slant * middle, half + slant * middle
        (a0, a1), (b0, b1) = stems
        pieces += [
            [(left, low), at(a0, low), at(a0, high), (left, high)],
            [at(a1, low), at(b0, low), at(b0, high), at(a1, high)],
            [at(b1, low), (right, low), (right, high), at(b1, high)],
        ]
    return pieces


def siemens_star(cycles: int, inner_radius: float, outer_radius: float, arc_steps: int) -> list[Piece]:
    """Spokes of a Siemens star: `cycles` bright sectors, each half a period wide.

    The frequency at radius r is cycles / (2 pi r). Arcs are polygons of `arc_steps` sides per spoke.
    """
    pieces = []
    for spoke, step in itertools.product(range(cycles), range(arc_steps)):
        a, b = (math.pi / cycles * (2 * spoke + (step + k) / arc_steps) for k in (0, 1))
        corners = ((inner_radius, a), (outer_radius, a), (outer_radius, b), (inner_radius, b))
        pieces.append([(radius * math.cos(angle), radius * math.sin(angle)) for radius, angle in corners])
    return pieces


def bar_group(frequency: float, left: float, top: float, gap: float) -> tuple[list[Piece], float]:
    """Three upright and three level bars of `frequency` line pairs per mm, the upright ones at the left.

    Returns
    -------
    pieces : list of polygons
        The bars; each is as wide as the dark space between two, and five times as long.
    right : float
        Where the group ends.
    """
    width = 0.5 / frequency
    size = 5 * width
    second = left + size + gap
    upright = [rectangle(left + i * width, left + (i + 1) * width, top - size, top) for i in (0, 2, 4)]
    level = [rectangle(second, second + size, top - (i + 1) * width, top - i * width) for i in (0, 2, 4)]
    return upright + level, second + size


def chart_bars() -> list[Piece]:
    """Bar groups of 1.5; 2 and 6; 3 and 4 line pairs per mm in three rows, the finest at the right."""
    pieces: list[Piece] = []
    top = 2.1
    for row in ((1.5,), (2.0, 6.0), (3.0, 4.0)):
        left = -1.95
        for frequency in row:
            group, right = bar_group(frequency, left, top, gap=0.15)
            pieces += group
            left = right + 0.24
        top -= 2.5 / row[0] + 0.3
    return pieces


def slanted_square(side: float, degrees: float) -> list[Piece]:
    """Return a square turned by a few degrees: slanted edges along both axes, as ISO 12233 wants them."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    h = side / 2
    return [[(c * u - s * v, s * u + c * v) for u, v in rectangle(-h, h, -h, h)]]


# ------------------------------------------------------------------------------------------------------------
# Solid objects of the still life
# ------------------------------------------------------------------------------------------------------------


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


# ------------------------------------------------------------------------------------------------------------
# Textures
# ------------------------------------------------------------------------------------------------------------


def ramp(dark: Colour, light: Colour) -> list[Colour]:
    """Sixteen colours from dark to light."""
    return [tuple(round(a + (b - a) * i / 15) for a, b in zip(dark, light, strict=True)) for i in range(16)]


def average(shade: Callable[[Array, Array], Array], rows: int, columns: int) -> Array:
    """Average a function of (u, v) in [0, 1) over each pixel; the first row is at v = 0, as Mitsuba reads bitmaps."""
    v, u = (np.indices((4 * rows, 4 * columns)) + 0.5) / np.array([4 * rows, 4 * columns])[:, None, None]
    image = shade(u, v)
    return image.reshape(rows, 4, columns, 4, *image.shape[2:]).mean(axis=(1, 3))


def levels(shade: Callable[[Array, Array], Array], rows: int, columns: int) -> NDArray[np.uint8]:
    """Return the averages as 4-bit levels."""
    # The small offset keeps exact halves from rounding differently.
    return np.floor(np.clip(average(shade, rows, columns), 0, 1) * 15 + 0.500001).astype(np.uint8)


def waves(u: Array, v: Array) -> Array:
    """One period of the Japanese wave pattern: overlapping discs of concentric rings, in rows."""
    # Discs of radius 1/2, one apart; rows 1/4 apart, every other one shifted by 1/2.
    value = np.zeros_like(u)
    # Rows from the top down: each disc hides those of the row above it.
    for row, column in itertools.product(range(5, -3, -1), range(-1, 3)):
        r = np.hypot(u - (column + 0.5 * (row % 2)), v - 0.25 * row)
        value = np.where(r < 0.5, np.where((r * 10) % 2 < 1, 0.0, 1.0), value)
    return value


def wood(u: Array, v: Array) -> Array:
    """Planks along v, with grain made of a few sines, each plank its own."""
    plank = np.floor(u * 6)
    across = u * 6 - plank
    phase = 2.399 * plank + 0.7 * plank**2
    bend = 0.35 * np.sin(2 * math.pi * v * 2 + phase) + 0.18 * np.sin(2 * math.pi * v * 5 + 2.3 * phase)
    grain = across * 5 + bend + 1.5 * np.sin(phase)
    rings = 0.5 + 0.5 * np.sin(2 * math.pi * grain + 1.2 * np.sin(2 * math.pi * grain * 0.37 + phase))
    fine = 0.5 + 0.5 * np.sin(2 * math.pi * (grain * 4.3 + 3 * np.sin(2 * math.pi * v * 3 + phase)))
    tone = 0.55 + 0.2 * np.sin(1.9 * plank + 0.4)
    gap = (across < 0.018) | (across > 0.982)
    return np.where(gap, 0.0, tone + 0.28 * (rings - 0.5) + 0.1 * (fine - 0.5))


def die(u: Array, v: Array) -> Array:
    """Return the six faces of a die, 3 x 2; opposite faces add up to seven."""
    near, far, middle = 0.27, 0.73, 0.5
    centre, diagonal = [(middle, middle)], [(near, far), (far, near)]
    corners = [*diagonal, (near, near), (far, far)]
    faces = (
        [*corners, *centre],
        diagonal,
        [*corners, (near, middle), (far, middle)],
        centre,
        [*diagonal, *centre],
        corners,
    )
    value = np.ones_like(u)
    for k, face in enumerate(faces):
        for x, y in face:
            value[np.hypot(u * 3 - k % 3 - x, v * 2 - k // 3 - y) < 0.105] = 0.0
    return value


def stripes(u: Array, v: Array) -> Array:
    """Twisted stripes and two plain caps, for a glazed ball (u around, v from pole to pole)."""
    swirl = u * 8 + 1.4 * np.sin(2 * math.pi * (v - 0.5))
    return np.where((swirl % 1 < 0.5) | (v < 0.1) | (v > 0.9), 1.0, 0.0)


def tiles(u: Array, v: Array) -> Array:
    """Four stone tiles, two dark and two light, with veins and dark joints."""
    dark = (np.floor(2 * u) + np.floor(2 * v)) % 2
    x, y = 2 * math.pi * u, 2 * math.pi * v
    bend = np.sin(x + 1.7 * np.sin(2 * y) + 0.8 * np.sin(3 * x + y))
    veins = np.exp(-((bend + 0.6 * np.sin(2 * y - x + 1.1 * np.sin(2 * x))) ** 2) / 0.01)
    cloud = 0.06 * np.sin(3 * x + 2 * y + np.sin(4 * y)) + 0.04 * np.sin(5 * y - 4 * x)
    value = np.where(dark == 1, 0.24 + cloud + 0.3 * veins, 0.86 + cloud - 0.3 * veins)
    return np.where(np.minimum((2 * u) % 1, (2 * v) % 1) < 0.02, 0.05, value)


def _leaf(u: Array, v: Array) -> tuple[Array, Array]:
    """Return how far points are inside a leaf's outline, over its half-width, and how far from its veins."""
    side = np.abs(u - 0.5 - 0.04 * np.sin(5 * v))
    width = 0.47 * np.sin(math.pi * np.clip((v - 0.14) / 0.84, 0, 1) ** 0.72) ** 0.85
    width = width * (1 - 0.07 * ((11 * v - 2.5 * side) % 1))
    inside = np.where(v < 0.18, 0.016 - side, width - side)
    twigs = np.abs((9 * (v - 0.9 * side)) % 1 - 0.5) / 9
    return inside, np.minimum(side / 0.6, np.where(side < 0.9 * width, twigs, 1))


def leaf(u: Array, v: Array) -> Array:
    """Return a leaf with light veins."""
    _, vein = _leaf(u, 1 - v)
    return 0.3 + 0.12 * np.sin(9 * u + 7 * v) + 0.6 * np.exp(-((vein / 0.012) ** 2))


def leaf_mask(u: Array, v: Array) -> Array:
    """Return where the leaf is opaque: within its outline, but for two holes."""
    inside, _ = _leaf(u, 1 - v)
    holes = (np.hypot(u - 0.34, v - 0.42) > 0.055) & (np.hypot(u - 0.62, 0.8 * (v - 0.6)) > 0.04)
    return np.where((inside > 0) & holes, 1.0, 0.0)


def surroundings(u: Array, v: Array) -> Array:
    """Return radiances from all directions: a sky over dark hills, a window, a strip of light.

    Rows run from the zenith down and columns around, as Mitsuba's ``envmap`` reads them; what a camera that looks
    along +z sees is in the middle.
    """
    x = np.sin(2 * math.pi * u) * np.sin(math.pi * v)
    y, z = np.cos(math.pi * v), -np.cos(2 * math.pi * u) * np.sin(math.pi * v)

    def mix(a: Sequence[float], b: Sequence[float], t: Array) -> Array:
        return np.array(a) + (np.array(b) - np.array(a)) * np.clip(t, 0, 1)[..., None]

    image = mix((0.66, 0.7, 0.76), (0.2, 0.34, 0.62), 2 * y)
    around = 2 * math.pi * u
    # None straight ahead, where the sky is seen above the ground.
    hills = (0.14 + 0.05 * np.sin(5 * around) + 0.03 * np.sin(13 * around + 1)) * np.clip(0.8 - z, 0, 1)
    image = np.where((y < hills)[..., None], mix((0.1, 0.14, 0.06), (0.2, 0.26, 0.12), 7 * y), image)
    image = np.where((y < 0)[..., None], mix((0.3, 0.25, 0.2), (0.12, 0.1, 0.09), -3 * y), image)

    def panel(towards: Sequence[float], half: Point, panes: tuple[int, int], radiance: Sequence[float]) -> None:
        """Put a bright rectangle with bars between its panes before what is there."""
        middle = np.array(towards) / np.linalg.norm(towards)
        right = np.cross(middle, [0, 1, 0])
        right /= np.linalg.norm(right)
        up = np.cross(right, middle)
        depth = x * middle[0] + y * middle[1] + z * middle[2]
        a, b = (
            (x * axis[0] + y * axis[1] + z * axis[2]) / np.maximum(depth, 1e-3) / size
            for axis, size in ((right, half[0]), (up, half[1]))
        )
        inside = (depth > 0) & (np.abs(a) < 1) & (np.abs(b) < 1)
        for place, count in ((a, panes[0]), (b, panes[1])):
            part = ((place + 1) / 2 * count) % 1
            inside &= (part > 0.06) & (part < 0.94)
        image[inside] = radiance

    panel((0.75, 0.75, -0.6), (0.42, 0.55), (2, 3), (5.2, 5.4, 5.8))
    panel((-0.7, 0.8, 0.3), (0.12, 0.6), (1, 1), (6.0, 4.8, 3.4))
    return image


# ------------------------------------------------------------------------------------------------------------


def write_all(directory: Path) -> list[Path]:
    """Write every mesh and texture below a directory and return the paths."""
    meshes = {
        "eight": flat_mesh(letter_eight()),
        "f": flat_mesh(letter_f()),
        "hash": flat_mesh(letter_hash()),
        "star": flat_mesh(siemens_star(24, 0.1, 2.0, 6)),
        "bars": flat_mesh(chart_bars()),
        "edge": flat_mesh(slanted_square(3.0, 5.0)),
        "pawn": pawn(),
        "die": rounded_die(3.4, 0.42, 4),
        "knot": torus_knot(2.3, 0.42, 128, 20),
        "lambda": solid_lambda(4.2, 1.0),
    }
    textures = {
        "waves": (levels(waves, 256, 256), ramp((54, 88, 138), (240, 234, 216))),
        "wood": (levels(wood, 384, 384), ramp((72, 42, 26), (238, 194, 138))),
        "die": (levels(die, 192, 288), ramp((26, 20, 24), (240, 236, 226))),
        "stripes": (levels(stripes, 128, 256), ramp((164, 38, 34), (242, 230, 208))),
        "tiles": (levels(tiles, 256, 256), ramp((38, 34, 36), (236, 226, 208))),
        "leaf": (levels(leaf, 192, 128), ramp((30, 74, 22), (190, 214, 96))),
        "leaf_mask": (levels(leaf_mask, 192, 128), ramp((0, 0, 0), (255, 255, 255))),
    }
    folder = directory / "meshes"
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, mesh in meshes.items():
        paths.append(folder / f"{name}.ply")
        mesh.write_ply(paths[-1])
    for name, picture in textures.items():
        paths.append(directory / f"{name}.png")
        write_png(paths[-1], *picture)
    paths.append(directory / "surroundings.hdr")
    write_hdr(paths[-1], average(surroundings, 64, 128))
    return paths


def main() -> None:
    """Write the files and say what was written."""
    parser = argparse.ArgumentParser(description="Write the meshes and textures of the built-in scenes.")
    parser.add_argument("-o", "--output", type=Path, default=SCENES, help="the folder (default: scenes/)")
    for path in write_all(parser.parse_args().output):
        print(f"{path}  {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
