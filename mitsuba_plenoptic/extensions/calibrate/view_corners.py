r"""Corners of a checkerboard in the views of an unfocused plenoptic camera, from its raw pictures.

A view is what one pixel of each micro-image sees, always at the same place a beside the lens's centre. The nearest pixel
is taken as it was recorded, without interpolation: it lies some part :math:`\delta` of a pixel beside that place, where
the scene is seen displaced by :math:`d \delta`, with d the disparity of the board. So each pixel counts once, noise is
independent from view to view, and mosaics of colour filters need no more than equal brightness of their colours.

The board is found in the central view: saddle points, which are joined to a grid from neighbour to neighbour, so that
parts of a board suffice. A plane's disparity is linear over the view, and found from view to view.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter
from scipy.spatial import cKDTree

from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...runtime import Array
from .adjustment import both_axes, deviation, robust_lines
from .boards import Picture, located
from .calibration_result import group_means
from .detect import divided_picture
from .observations import DOUBTFUL_COLUMN, VIEW_COLUMNS, Board, LensIndex, Table, find_lens_index

# Light of a pixel, in parts of that in the middle of its micro-image, from which on the main lens's rim cuts off little.
_OPEN = 0.85

# A corner's window reaches over this part of a square, and over so many lenses at most.
_WINDOW = 0.45
_MOST_LENSES = 6.0

_SHARPNESSES = (1.0, 1.8, 3.0)
"""Widths in lenses over which a view is smoothed to find a board."""


@dataclass(frozen=True)
class LensArray:
    """Lenses over a picture, in rows and columns that hold them all, and the picture's pixels beside their centres."""

    picture: Picture
    index: LensIndex
    # Place in pixels of the lens (0, 0), and steps along and across the rows, (3, 2).
    grid: Array
    # Indices of the first lens and numbers of lenses along and across the rows.
    first: tuple[int, int]
    shape: tuple[int, int]

    @classmethod
    def over(cls, picture: Picture, centres: Table, hexagonal: bool) -> "LensArray":
        """Return the lenses of a table of centres."""
        index, grid = find_lens_index(centres, hexagonal, (np.array(picture.image.shape[::-1]) - 1) / 2)
        k, l = centres["k"], centres["l"]  # noqa: E741
        return cls(picture, index, grid, (int(k.min()), int(l.min())), (int(np.ptp(l)) + 1, int(np.ptp(k)) + 1))

    @property
    def ratio(self) -> float:
        """Distance of rows over that of lenses along them."""
        return float(np.divide(*np.hypot(*self.grid[:0:-1].T)))

    def positions(self) -> Array:
        """Return the positions of lenses (rows, columns, 2), along the row with its offset, and across."""
        l, k = np.indices(self.shape)  # noqa: E741
        l, k = l + self.first[1], k + self.first[0]  # noqa: E741
        return np.stack([k + self.index.odd_rows * (l % 2), l], axis=-1)

    def pixels(self, position: Array) -> Array:
        """Return the places in pixels of positions (..., 2) among lenses."""
        return self.grid[0] + self.index.between(*np.moveaxis(position, -1, 0)) @ self.grid[1:]

    def view(self, arm: Array) -> tuple[Array, Array, Array]:
        """Return values and weights (rows, columns) at a place beside lenses, and the pixels' distances from it."""
        wanted = self.pixels(self.positions()) + arm
        pixel = np.rint(wanted).astype(int)
        x, y = np.moveaxis(pixel, -1, 0)
        rows, columns = self.picture.image.shape
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        x, y = x.clip(0, columns - 1), y.clip(0, rows - 1)
        return self.picture.image[y, x], self.picture.weight[y, x] * inside, pixel - wanted


def detect_view_corners(
    image: Array,
    white: Array,
    centres: Table,
    board: Board,
    camera: PlenopticCamera,
    *,
    frame: int = 0,
    name: str = "picture",
) -> Table:
    """Return the corners of a board in a raw picture of an unfocused camera, in each of its views.

    Parameters
    ----------
    image : (rows, columns[, channels]) array
        Raw picture, with values proportional to light; it may be a mosaic of colour filters.
    white : (rows, columns[, channels]) array
        Picture of something evenly white, by the same camera.
    centres : Table
        Centres of micro-images, as `read_centres` and `Centres.table` give them.
    board : Board
        The board, of which parts suffice: corners are then counted from the first that is seen.
    camera : PlenopticCamera
        Provides the kind of lattice.
    frame : int
        Number of the picture.
    name : str
        Name of the picture in messages.

    Returns
    -------
    Table
        Columns i and j of the position among lenses at which a view shows the corner, u and v of the view's pixel
        there, cluster and frame.
    """
    # Micro-images that a rim clips would make the others' part of the pupil smaller.
    sure = centres.keep(centres[DOUBTFUL_COLUMN] == 0) if DOUBTFUL_COLUMN in centres.columns else centres
    picture = divided_picture(image, white, sure, name)
    lenses = LensArray.over(picture, centres, camera.lattice.stagger == 2)
    corner, position = find_grid(lenses, board)
    of, arm, found = _in_all_views(lenses, corner, position)
    pixel = lenses.pixels(found) + arm
    number = corner[of] @ [1, board.columns]
    return Table(name, dict(zip(VIEW_COLUMNS, (*found.T, *pixel.T, number, np.full(len(of), frame)), strict=True)))


def find_grid(lenses: LensArray, board: Board) -> tuple[Array, Array]:
    """Return the columns and rows on their board of corners seen in the central view, (n, 2), and their positions.

    Columns run to the right and rows down, as seen from the front of the board.
    """
    arms = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    views = [lenses.view(arm) for arm in arms[np.abs(arms).sum(1) < 2]]
    weight = sum(view[1] for view in views)
    value = sum(view[0] * view[1] for view in views)
    # Rows that begin half a pitch aside come to the others' columns.
    for side in (value, weight):
        odd = (np.arange(len(side)) + lenses.first[1]) % 2 == 1
        if lenses.index.odd_rows:
            side[odd] = (side[odd] + np.roll(side[odd], 1 if lenses.index.odd_rows > 0 else -1, axis=1)) / 2
    best: dict[tuple[int, int], int] = {}
    places = np.zeros((0, 2))
    for width in _SHARPNESSES:
        place, angle = _saddles(value, weight, width, board.columns * board.rows)
        grown = _grown(place * [1, lenses.ratio], angle)
        if _fullness(grown) > _fullness(best):
            best, places = grown, place
    corner = np.array(list(best)).reshape(-1, 2)
    position = places[list(best.values())] + lenses.first
    corner, position = _counted(corner, position, lenses, board)
    return corner, position


def _saddles(value: Array, weight: Array, width: float, expected: int) -> tuple[Array, Array]:
    """Return strong saddle points of a picture, (n, 2) columns and rows, and directions of rising slopes."""
    light = gaussian_filter(weight, width)
    smooth = gaussian_filter(value, width) / np.maximum(light, 1e-9)
    by_y, by_x = np.gradient(smooth)
    (yy, xy), (_, xx) = (np.gradient(slope) for slope in (by_y, by_x))
    strength = (xy * xy - xx * yy) * (light > 0.5 * np.median(light[light > 0]))
    peak = (strength == maximum_filter(strength, 2 * int(np.ceil(width)) + 1)) & (strength > 0)
    peak[[0, -1]] = peak[:, [0, -1]] = False
    y, x = np.nonzero(peak)
    strong = strength[y, x]
    # Along edges and in noise there are weaker ones.
    least = 0.15 * np.median(np.sort(strong)[-expected // 2 :]) if len(strong) else 0.0
    order = np.argsort(-strong)[: np.count_nonzero(strong > least)]
    y, x = y[order], x[order]
    # From the middle of the pixel to where the slope vanishes.
    bend = np.array([[xx, xy], [xy, yy]])[:, :, y, x].transpose(2, 0, 1)
    step = np.linalg.solve(bend, -np.stack([by_x, by_y], axis=-1)[y, x][:, :, None])[:, :, 0].clip(-1, 1)
    place = np.column_stack([x, y]) + step
    angle = np.arctan2(2 * xy, xx - yy)[y, x] / 2
    # Light on either side, along the rising slopes and the falling ones. The corner of a single square has three alike.
    around = angle + np.pi / 2 * np.arange(4)[:, None]
    sides = place + (1.5 + 1.5 * width) * np.stack([np.cos(around), np.sin(around)], axis=-1)
    light = map_coordinates(smooth, sides[:, :, ::-1].transpose(2, 0, 1), order=1, mode="nearest")
    good = np.abs(light[:2] - light[2:]).max(0) < 0.4 * (light[0] + light[2] - light[1] - light[3]) / 2
    return place[good], angle[good]


def _grown(place: Array, angle: Array) -> dict[tuple[int, int], int]:
    """Return the largest grid of saddle points: their numbers by column and row.

    From one corner to the next, dark and light change: rising slopes are at right angles.
    """
    best: dict[tuple[int, int], int] = {}
    if len(place) < 9:
        return best
    tree = cKDTree(place)
    near = tree.query(place, k=9)[1]

    def crossed(one: int, others: Array) -> Array:
        return np.cos(2 * (angle[one] - angle[others])) < -0.3

    tried = np.zeros(len(place), bool)
    for seed in range(min(len(place), 200)):
        if tried[seed]:
            continue
        around = near[seed, 1:][crossed(seed, near[seed, 1:])]
        if not len(around):
            continue
        along = place[around[0]] - place[seed]
        sideways = np.abs(along @ [[0, 1], [-1, 0]] @ (place[around] - place[seed]).T)
        aside = around[sideways > 0.5 * np.hypot(*along) * np.hypot(*(place[around] - place[seed]).T)]
        if not len(aside):
            continue
        steps = {(0, 0): (along, place[aside[0]] - place[seed])}
        grid = {(0, 0): seed}
        used = {seed}
        queue = deque([(0, 0)])
        while queue:
            at = queue.popleft()
            here = grid[at]
            for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
                there = (at[0] + sign, at[1]) if axis == 0 else (at[0], at[1] + sign)
                if there in grid:
                    continue
                step = sign * steps[at][axis]
                distance, other = tree.query(place[here] + step)
                if other in used or distance > 0.3 * np.hypot(*step) or not crossed(here, other):
                    continue
                grid[there] = int(other)
                used.add(int(other))
                new = list(steps[at])
                new[axis] = sign * (place[other] - place[here])
                steps[there] = (new[0], new[1])
                queue.append(there)
        tried[list(used)] = True
        if _fullness(grid) > _fullness(best):
            best = grid
    return best


def _fullness(grid: dict[tuple[int, int], int]) -> float:
    """Return how many corners a grid has, times the part of its columns and rows that is filled."""
    return len(grid) ** 2 / float(np.prod(np.ptp(list(grid), axis=0) + 1)) if grid else 0.0


def _counted(corner: Array, position: Array, lenses: LensArray, board: Board) -> tuple[Array, Array]:
    """Return corners counted from the board's first, and those that are no line of its edges left out."""
    size = np.array([board.columns, board.rows])
    stated = f"no checkerboard of {board.columns}x{board.rows} inner corners is seen in it"
    while len(corner):
        corner = corner - corner.min(0)
        extent = corner.max(0) + 1
        fits = (extent <= size).all(), (extent[::-1] <= size).all()
        if any(fits):
            break
        # Lines at the rim of which little is seen are none of the board.
        lines = [(axis, end) for axis in (0, 1) for end in (0, extent[axis] - 1)]
        counts = [np.sum(corner[:, axis] == end) / extent[1 - axis] for axis, end in lines]
        axis, end = lines[int(np.argmin(counts))]
        refuse_if(
            min(counts) > 0.5,
            f"{lenses.picture.name}: {stated}, but one of {extent.max()}x{extent.min()}: --board counts inner corners",
        )
        keep = corner[:, axis] != end
        corner, position = corner[keep], position[keep]
    refuse_if(
        len(corner) < max(9, 0.2 * size.prod()) or min(np.ptp(corner, axis=0)) < 2,
        f"{lenses.picture.name}: {stated}; the largest grid of corners in it has {len(corner)}",
    )
    pixel = lenses.pixels(position)
    matrix = np.column_stack([np.ones(len(corner)), corner])
    _, along, across = np.linalg.lstsq(matrix, pixel)[0]
    if not fits[0] or (fits[1] and abs(across[0]) > abs(along[0])):
        corner, along, across = corner[:, ::-1], across, along
    for axis, backward in ((0, along[0] < 0), (1, np.linalg.det([along * (-1 if along[0] < 0 else 1), across]) < 0)):
        if backward:
            corner = corner * np.where(np.arange(2) == axis, -1, 1)
    return corner - corner.min(0), position


def _in_all_views(lenses: LensArray, corner: Array, position: Array) -> tuple[Array, Array, Array]:
    """Return corners located in views: index of the corner, the view's place beside lenses, and position, (n, 2)."""
    picture = lenses.picture
    to_lenses = np.linalg.inv(lenses.grid[1:]) * [1, lenses.index.row_sign]
    stretch = np.array([1.0, lenses.ratio])
    columns, rows = _steps(corner, position * stretch)
    reach = (_WINDOW * np.minimum(np.hypot(*columns.T), np.hypot(*rows.T))).clip(1.5, _MOST_LENSES)
    angles = np.stack([np.arctan2(step[:, 1], step[:, 0]) for step in (columns, rows)], axis=-1)
    middle = lenses.view(np.zeros(2))[1]
    half = int(picture.even) + 1
    arms = np.stack(np.meshgrid(*[np.arange(-half, half + 1)] * 2), axis=-1).reshape(-1, 2)
    radius = np.hypot(*arms.T)
    scale = np.abs(lenses.pixels(position)).max()

    def disparity(at: Array) -> Array:
        return np.column_stack([np.ones(len(at)), lenses.pixels(at) / scale]) @ slope

    slope = np.zeros(3)
    found: list[Array] = []
    for inner, outer in ((-1.0, 0.5), (0.5, 1.2), (1.2, 2.3), (0.5, 2.3), (-1.0, picture.even - 0.5)):
        if inner < 1:
            found = []
        for arm in arms[(radius > inner) & (radius <= min(outer, picture.even - 0.5))]:
            start = position + disparity(position)[:, None] * (arm @ to_lenses)
            at, error, contrast, fitted = _in_view(lenses, arm, start, angles, reach, disparity(position), middle)
            if outer < 1:
                angles = fitted
            good = error < 0.3
            if good.any():
                good &= contrast > 0.4 * np.median(contrast[good])
            good &= np.hypot(*((at - start) * stretch).T) < reach
            found.append(np.column_stack([np.flatnonzero(good), np.tile(arm, (good.sum(), 1)), at[good]]))
        table = np.concatenate(found)
        of, arm, at = table[:, 0].astype(int), table[:, 1:3], table[:, 3:]
        if len(found) > 2:
            count, mean = group_means(np.column_stack([arm, at]), of)
            moved = np.column_stack([arm, at]) - mean[of]
            line = np.column_stack([np.ones(len(at)), lenses.pixels(position[of]) / scale])
            matrix = (moved[:, :2] @ to_lenses)[:, :, None] * line[:, None]
            slope, _, good = robust_lines(matrix, moved[:, 2:])
            of, arm, at = of[good], arm[good], at[good]
        central = at - disparity(position[of])[:, None] * (arm @ to_lenses)
        seen, group = np.unique(of, return_inverse=True)
        position[seen] = group_means(central, group)[1]
    miss = np.hypot(*((central - position[of]) * stretch).T)
    agrees = miss < max(0.3, 6 * deviation(miss))
    return of[agrees], arm[agrees], at[agrees]


def _steps(corner: Array, place: Array) -> tuple[Array, Array]:
    """Return the steps (n, 2) from corner to corner along the board's rows and columns, about each corner."""
    x, y = (corner - corner.mean(0)).T
    ones = np.ones(len(x))
    matrix = both_axes(np.column_stack([ones, x, y, x * x, x * y, y * y]))
    of_x, of_y = robust_lines(matrix, place)[0].reshape(2, 6)
    zero = 0 * x
    by_column, by_row = (
        np.column_stack([zero, ones, zero, 2 * x, y, zero]),
        np.column_stack([zero, zero, ones, zero, x, 2 * y]),
    )
    return tuple(np.column_stack([by @ of_x, by @ of_y]) for by in (by_column, by_row))


def _in_view(
    lenses: LensArray, arm: Array, start: Array, angles: Array, reach: Array, disparity: Array, middle: Array
) -> tuple[Array, Array, Array, Array]:
    """Return corners in one view: positions among lenses, their deviations and contrasts, and angles of their edges."""
    value, weight, off = lenses.view(arm)
    weight = weight * (weight > _OPEN * middle)
    half = int(np.ceil(reach.max())) + 1
    l = np.rint(start[:, 1]).astype(int)[:, None] + np.repeat(np.arange(-half, half + 1), 2 * half + 1)  # noqa: E741
    offset = lenses.index.odd_rows * (l % 2)
    k = np.rint(start[:, :1] - offset).astype(int) + np.tile(np.arange(-half, half + 1), 2 * half + 1)
    row, column = l - lenses.first[1], k - lenses.first[0]
    inside = (row >= 0) & (row < len(value)) & (column >= 0) & (column < value.shape[1])
    row, column = row.clip(0, len(value) - 1), column.clip(0, value.shape[1] - 1)
    to_lenses = np.linalg.inv(lenses.grid[1:]) * [1, lenses.index.row_sign]
    shown_at = np.stack([k + offset, l], axis=-1) - disparity[:, None, None] * (off[row, column] @ to_lenses)
    stretch = np.array([1.0, lenses.ratio])
    shown_at = shown_at * stretch
    start = start * stretch
    w = weight[row, column] * inside
    w = w * (reach[:, None] + 0.5 - np.hypot(*np.moveaxis(shown_at - start[:, None], 2, 0))).clip(0, 1)
    position, deviation_of, contrast, fitted = located(shown_at, value[row, column], w, start, angles)
    return position / stretch, deviation_of, contrast, fitted
