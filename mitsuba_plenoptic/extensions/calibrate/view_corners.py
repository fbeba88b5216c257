r"""Corners of a checkerboard in the views of an unfocused plenoptic camera, from its raw pictures.

A view is what one pixel of each micro-image sees, always at one place beside the lens's centre. The nearest pixel is
taken as it was recorded, without interpolation: it lies some part :math:`\delta` of a pixel beside that place, where
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
from ...runtime import Array, Pair, Shape, Triple
from .boards import Picture, located
from .detect import divided_picture
from .observations import DOUBTFUL_COLUMN, VIEW_COLUMNS, Board, Table, find_lens_index
from .view_start import central_view

_MIDDLE = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
"""Views about the pupil's middle."""


@dataclass(frozen=True)
class Lenses:
    """Lenses of a picture, at places (n, 2) in pixels on a regular grid, and the picture's pixels beside them."""

    picture: Picture
    places: Array
    # The places, to search in.
    tree: cKDTree
    # Distance of neighbours along the rows in pixels.
    pitch: float

    def view(self, arm: Array) -> Triple:
        """Return values and weights (n,) of pixels at a place beside the lenses, and how far off it they are."""
        wanted = self.places + arm
        pixel = np.rint(wanted).astype(int)
        within = pixel.clip(0, np.array(self.picture.image.shape[::-1]) - 1)
        x, y = within.T
        return self.picture.image[y, x], self.picture.weight[y, x] * (pixel == within).all(1), pixel - wanted


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
    white, centres, frame, name
        As for `detect_corners`.
    board : Board
        The board, of which parts suffice: corners are then counted from the first that is seen.
    camera : PlenopticCamera
        Provides the kind of lattice.

    Returns
    -------
    Table
        Columns x and y: where the view shows the corner, as the place in pixels that the centre of a lens's micro-image
        has there on a regular grid; u and v, the view's pixel there; cluster and frame.
    """
    # Micro-images that a rim clips would make the others' part of the pupil smaller.
    sure = centres.keep(centres[DOUBTFUL_COLUMN] == 0) if DOUBTFUL_COLUMN in centres.columns else centres
    picture = divided_picture(image, white, sure, name)
    index, grid = find_lens_index(centres, camera.lattice.stagger == 2, (np.array(picture.image.shape[::-1]) - 1) / 2)
    places = grid[0] + index.unit(centres["k"], centres["l"]) @ grid[1:]
    lenses = Lenses(picture, places, cKDTree(places), np.hypot(*grid[1]))
    middle = lenses.view(_MIDDLE[0])[0]
    rims = [lenses.view(int(picture.even) * arm) for arm in _MIDDLE[1:]]
    means = [value @ weight / (middle @ weight) for value, weight, _ in rims]
    refuse_if(
        max(means) > 1.3 * min(means),
        f"{name}: its micro-images lie beside those of the white picture, which is of another camera, zoom or focus",
    )
    corner, position = find_grid(lenses, board)
    of, arm, position = _in_all_views(lenses, corner, position)
    columns = *position.T, *(position + arm).T, corner[of] @ [1, board.columns], np.full(len(of), frame)
    return Table(name, dict(zip(VIEW_COLUMNS, columns, strict=True)))


def find_grid(lenses: Lenses, board: Board) -> Pair:
    """Return the columns and rows on their board of corners seen in the central view, (n, 2), and their places.

    Columns run to the right and rows down, as seen from the front of the board.
    """
    value, weight = np.transpose([lenses.view(arm)[:2] for arm in _MIDDLE], (1, 0, 2))
    y, x = (np.arange(0, size, lenses.pitch) for size in lenses.picture.image.shape)
    near = lenses.tree.query(np.stack(np.meshgrid(x, y), axis=-1), k=3)[1]
    shade, light = (values.sum(0)[near].sum(2) for values in (value * weight, weight))
    # Widths in lenses over which the view is smoothed.
    found = [_saddles(shade, light, width, board.columns * board.rows) for width in (1.0, 1.8, 3.0)]
    grids = [_grown(*saddles) for saddles in found]
    best = int(np.argmax([_fullness(grid) for grid in grids]))
    corner = np.array(list(grids[best])).reshape(-1, 2)
    position = found[best][0][list(grids[best].values())] * lenses.pitch
    return _counted(corner, position, board, lenses.picture.name)


def _saddles(value: Array, weight: Array, width: float, expected: int) -> Pair:
    """Return strong saddle points of a picture, (n, 2) columns and rows, and directions of rising slopes."""
    light = gaussian_filter(weight, width)
    smooth = gaussian_filter(value, width) / np.maximum(light, 1e-9)
    by_y, by_x = np.gradient(smooth)
    (yy, xy), (_, xx) = (np.gradient(slope) for slope in (by_y, by_x))
    strength = (xy * xy - xx * yy) * (light > 0.5 * np.median(light[light > 0]))
    peak = (strength == maximum_filter(strength, 2 * int(np.ceil(width)) + 1)) & (strength > 0)
    y, x = np.nonzero(peak)
    strong = strength[y, x]
    # Along edges and in noise there are weaker ones.
    order = np.argsort(-strong)
    order = order[strong[order] > 0.15 / (expected // 2) * strong[order[: expected // 2]].sum()]
    y, x = y[order], x[order]
    position = np.column_stack([x, y])
    angle = np.arctan2(2 * xy, xx - yy)[y, x] / 2
    # Light on either side, along the rising slopes and the falling ones. The corner of a single square has three alike.
    around = angle + np.pi / 2 * np.arange(4)[:, None]
    sides = position + (1.5 + 1.5 * width) * np.stack([np.cos(around), np.sin(around)], axis=-1)
    light = map_coordinates(smooth, sides[:, :, ::-1].transpose(2, 0, 1), order=1, mode="nearest")
    good = np.abs(light[:2] - light[2:]).max(0) < 0.4 * (light[0] + light[2] - light[1] - light[3]) / 2
    return position[good], angle[good]


def _grown(position: Array, angle: Array) -> dict[Shape, int]:
    """Return the largest grid of saddle points: their numbers by column and row.

    From one corner to the next, dark and light change: rising slopes are at right angles.
    """
    best: dict[Shape, int] = {}
    if len(position) < 9:
        return best
    tree = cKDTree(position)
    near = tree.query(position, k=9)[1][:, 1:]
    tried = np.zeros(len(position), bool)
    for seed in range(len(position)):
        around = near[seed][np.cos(2 * (angle[seed] - angle[near[seed]])) < -0.3]
        if tried[seed] or not len(around):
            continue
        steps = position[around] - position[seed]
        aside = np.abs(steps @ [-steps[0, 1], steps[0, 0]])
        other = np.flatnonzero(aside > 0.5 * np.hypot(*steps[0]) * np.hypot(*steps.T))
        if not len(other):
            continue
        grid = {(0, 0): seed}
        queue = deque([((0, 0), steps[[0, other[0]]])])
        while queue:
            at, axes = queue.popleft()
            here = grid[at]
            for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
                there = (at[0] + sign * (1 - axis), at[1] + sign * axis)
                step = sign * axes[axis]
                distance, next_one = tree.query(position[here] + step)
                crossed = np.cos(2 * (angle[here] - angle[next_one])) < -0.3
                if there in grid or next_one in grid.values() or distance > 0.3 * np.hypot(*step) or not crossed:
                    continue
                grid[there] = next_one
                turned = axes.copy()
                turned[axis] = sign * (position[next_one] - position[here])
                queue.append((there, turned))
        tried[list(grid.values())] = True
        if _fullness(grid) > _fullness(best):
            best = grid
    return best


def _fullness(grid: dict[Shape, int]) -> float:
    """Return how many corners a grid has, times the part of its columns and rows that is filled."""
    return len(grid) ** 2 / np.prod(np.ptp(list(grid), axis=0) + 1) if grid else 0.0


def _counted(corner: Array, position: Array, board: Board, name: str) -> Pair:
    """Return corners counted from the board's first, and their places, without lines of which little is seen."""
    size = np.array([board.columns, board.rows])
    stated = f"{name}: no checkerboard of {board.columns}x{board.rows} inner corners is seen in it"
    fits: list = []
    while len(corner) and not any(fits):
        corner = corner - corner.min(0)
        extent = corner.max(0) + 1
        fits = [(extent <= size).all(), (extent[::-1] <= size).all()]
        if not any(fits):
            lines = [corner[:, axis] == end for axis in (0, 1) for end in (0, extent[axis] - 1)]
            least = min(lines, key=np.count_nonzero)
            refuse_if(
                least.sum() > 0.5 * extent.min(),
                f"{stated}, but one of {extent.max()}x{extent.min()}: --board counts inner corners",
            )
            corner, position = corner[~least], position[~least]
    refuse_if(
        len(corner) < max(9, 0.2 * size.prod()) or np.ptp(corner, axis=0).min() < 2,
        f"{stated}; the largest grid of corners in it has {len(corner)}",
    )
    along, across = _steps(corner, position)
    if not fits[0] or (fits[1] and abs(across[0]) > abs(along[0])):
        corner, along, across = corner[:, ::-1], across, along
    right = np.copysign(1, along[0])
    corner = corner * [right, np.copysign(1, right * np.linalg.det([along, across]))]
    return (corner - corner.min(0)).astype(int), position


def _steps(corner: Array, position: Array) -> Array:
    """Return the mean steps along a board's rows and columns."""
    return np.linalg.lstsq(np.column_stack([np.ones(len(corner)), corner]), position)[0][1:]


def _in_all_views(lenses: Lenses, corner: Array, position: Array) -> Triple:
    """Return corners located in views: index of the corner, the view's pixel beside lenses, and position, (n, 2)."""
    pitch, even = lenses.pitch, lenses.picture.even - 0.5
    steps = _steps(corner, position)
    # Of windows in pitches.
    reach = (0.45 * np.hypot(*steps.T).min() / pitch).clip(2.3, 6.0)
    angles = np.tile(np.arctan2(*steps.T[::-1]), (len(position), 1))
    middle = lenses.view(_MIDDLE[0])[1]
    arms = np.indices((41, 41)).reshape(2, -1).T - 20
    radius = np.hypot(*arms.T)
    disparity = np.zeros(len(position))
    table = np.zeros((0, 5))
    # From view to view outwards; then all, as the disparity is known.
    for inner, outer in ((-1.0, 0.5), (0.5, 1.2), (1.2, 2.3), (-1.0, even)):
        found = [table] if inner > 0 else []
        for arm in arms[(radius > inner) & (radius <= outer)]:
            value, weight, off = lenses.view(arm)
            # Of the part of the pupil that a pixel sees, the main lens's rim cuts off little.
            weight = weight * (weight > 0.85 * middle)
            start = position + disparity[:, None] * arm
            near = lenses.tree.query(start, k=int(4 * (reach + 0.5) ** 2))[1]
            shown_at = (lenses.places[near] - disparity[:, None, None] * off[near]) / pitch
            apart = np.hypot(*(shown_at - start[:, None] / pitch).transpose(2, 0, 1))
            w = weight[near] * (reach + 0.5 - apart).clip(0, 1)
            at, error, _ = located(shown_at, value[near], w, start / pitch, angles)
            good = np.flatnonzero(error < 0.3)
            found.append(np.column_stack([good, np.tile(arm, (len(good), 1)), at[good] * pitch]))
        table = np.concatenate(found)
        refuse_if(not len(table), f"{lenses.picture.name}: a board is seen in it, but none of its corners sharply")
        seen, central, good = central_view(table[:, 0].astype(int), table[:, 1:3], table[:, 3:])
        table = table[good]
        disparity[:] = np.median(central[:, 2])
        position[seen], disparity[seen] = central[:, :2], central[:, 2]
    return table[:, 0].astype(int), table[:, 1:3], table[:, 3:]
