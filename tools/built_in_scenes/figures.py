"""Flat figures in picture coordinates: the letters, and the chart's.

Each is a list of convex, counter-clockwise polygons that never overlap, so that the area of its mesh is the area of the
figure.
"""

from __future__ import annotations

import itertools
import math

from .mesh import Piece, Point

LETTER_HEIGHT = 4.0


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
