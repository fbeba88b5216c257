"""Corners of a checkerboard in raw pictures of a focused plenoptic camera, as `calibrate` takes them.

OpenCV finds the board in a view of the whole scene (`boards`). Each corner is then searched in all micro-images that
should show it, and located in each to a fraction of a pixel (`find_saddles`); located corners improve the expected
positions of the others.
"""

from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ...camera import PlenopticCamera, Use, require_support
from ...errors import refuse_if
from ...runtime import Array, Triple, as_pixels, require_memory
from ...views import lens_types, pixels_around
from .blur import CutBlur
from .board_model import centres_of
from .boards import Picture, find_board, find_saddles
from .observations import CORNER_COLUMNS, DOUBTFUL_COLUMN, VIEW_COLUMNS, Board, LensIndex, Table, write_table


def detect_corners(
    image: Array,
    white: Array,
    centres: Table,
    board: Board,
    *,
    camera: PlenopticCamera | None = None,
    frame: int = 0,
    name: str = "picture",
) -> Table:
    """Return the corners of a board in a raw picture, in every micro-image that shows one.

    Parameters
    ----------
    image : (rows, columns[, channels]) array
        Raw picture, with values proportional to light.
    white : (rows, columns[, channels]) array
        Picture of something evenly white, by the same camera.
    centres : Table
        Centres of micro-images, as `read_centres` and `Centres.table` give them; `camera_centres` of a known camera.
        Lenses with doubtful centres are not looked at.
    board : Board
        The board, all of which must be in the picture; the size of squares does not matter.
    camera : PlenopticCamera, optional
        The camera, if it is known: blur that the main lens's pupil cuts off then displaces no corner (`CutBlur`).
    frame : int
        Number of the picture.
    name : str
        Name of the picture in messages.

    Returns
    -------
    Table
        As `read_corners` gives it. Corners are counted to the right and then down as seen: a board turned upside down
        is counted from its other end.

    Raises
    ------
    InputError
        If OpenCV is missing, the picture and the white picture do not match, or no board is seen.
    """
    if camera is not None:
        camera.require_array("detect_corners")
    if DOUBTFUL_COLUMN in centres.columns:
        centres = centres.keep(centres[DOUBTFUL_COLUMN] == 0)
    picture = divided_picture(image, white, centres, name)
    corner, lens, position = _refined(picture, *find_board(picture, board), camera)
    refuse_if(
        not len(corner),
        f"{name}: a board of {board.columns}x{board.rows} is seen in it, but none of its corners sharply",
    )
    columns = centres["k"][lens], centres["l"][lens], *position.T, corner, np.full(len(corner), frame)
    return Table(name, dict(zip(CORNER_COLUMNS, columns, strict=True)))


def camera_centres(camera: PlenopticCamera, index: LensIndex | None = None) -> Table:
    """Return the centres of a known camera's micro-images on its recorded picture, as `read_centres` does.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, tilted or not.
    index : LensIndex, optional
        Indexing of lenses in the table. Default: that of the camera's lattice.
    """
    require_support(camera, Use.LENS_CENTRES)
    camera.require_resolved()
    size = np.array(camera.crop_size)
    index = index or LensIndex(0.5 if camera.lattice.stagger == 2 else 0.0, 1, (0, 0))
    # Where the picture's corners would be among the lenses, were the array not tilted.
    first, *ends = centres_of(camera, np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size
    reach = np.abs(np.linalg.solve((ends - first).T, (corners - first).T)).max(1)
    across, up = np.ceil(reach + 0.02 * reach + 2).astype(int)
    require_memory(500.0 * (2 * across + 1) * (2 * up + 1), f"{across * up * 4} lenses")
    k0, l0 = index.first
    l, k = np.mgrid[l0 - up : l0 + up + 1, k0 - across : k0 + across + 1].reshape(2, -1)  # noqa: E741
    pixel = centres_of(camera, index.unit(k, l))
    inside = np.flatnonzero(((pixel > -0.5) & (pixel < size - 0.5)).all(1))
    u, v = pixel.T
    return Table("camera", {"k": k, "l": l, "u": u, "v": v}).keep(inside)


def divided_picture(image: Array, white: Array, centres: Table, name: str) -> Picture:
    """Return a raw picture divided by the white one, with its micro-images."""
    values, light = (even_colours(_grey(label, picture)) for label, picture in ((name, image), ("white", white)))
    refuse_if(
        values.shape != light.shape,
        f"{name}: it has {values.shape[1]} x {values.shape[0]} pixels, and the white picture {light.shape[1]} x "
        f"{light.shape[0]}",
    )
    middle = centres.pixel
    distance, _ = cKDTree(middle).query(middle, k=2)
    nearest = float(np.median(distance[:, 1])) / 2
    pixel = np.round(middle).astype(int)
    inside = ((pixel >= 0) & (pixel < light.shape[::-1])).all(1)
    column, row = pixel[inside].T
    refuse_if(
        inside.sum() < 16, f"{name}: {inside.sum()} of {centres.name} lie in it: 16 micro-images are needed at least"
    )
    full = float(np.median(light[row, column]))
    refuse_if(not full > 0, "white: it is dark in the middle of its micro-images")
    weight = (light / full).clip(max=1)
    weight[weight < 0.25] = 0
    divided = values / np.where(weight > 0, light / full, 1)
    # Micro-images may be smaller than their distance allows, on all of the picture that they cover.
    low = middle[inside].min(0).astype(int)
    high = middle[inside].max(0).astype(int) + 1
    lit = (weight[low[1] : high[1], low[0] : high[0]] > 0).mean() * np.prod(high - low) / inside.sum()
    radius = min(nearest, float(np.sqrt(lit / np.pi)))
    even = evenly_lit(light, middle[inside], radius)
    return Picture(name, divided, weight, middle[inside], radius, even if even > 0.6 * radius else radius)


def even_colours(image: Array) -> Array:
    """Return a mosaic of colour filters in which these are equally bright; other pictures remain as they are."""
    means = np.array([[image[j::2, i::2].mean() for i in (0, 1)] for j in (0, 1)])
    if not np.ptp(means) > 0.02 * means.mean():
        return image
    rows, columns = (np.arange(size) % 2 for size in image.shape)
    return image * (means.mean() / means)[rows[:, None], columns]


def evenly_lit(light: Array, centre: Array, radius: float) -> float:
    """Return the radius in pixels within which micro-images are, on average, as bright as in their middle."""
    half = int(radius) + 1
    uncut = centre[((centre > half) & (centre < np.array(light.shape)[::-1] - half - 1)).all(1)]
    x, y, values = pixels_around(light, np.round(uncut), half)
    middle = values[:, half - 1 : half + 2, half - 1 : half + 2].mean((1, 2), keepdims=True)
    lit = middle[:, 0, 0] > 0
    # Rings of half a pixel, as far as all of them is seen.
    distance = np.hypot((x - uncut[:, :1])[:, None], (y - uncut[:, 1:])[:, :, None])
    ring = (2 * distance[lit]).astype(int).ravel()
    ratio = np.bincount(ring, (values[lit] / middle[lit]).ravel()) / np.maximum(np.bincount(ring), 1)
    dark = np.flatnonzero(ratio[: 2 * half] < 0.97)
    return min(radius, dark[0] / 2) if dark.size else radius


def _grey(name: str, image: Array) -> Array:
    values = as_pixels(name, image, np.float64)
    refuse_if(values.ndim not in (2, 3), f"{name} of shape {values.shape}: it must be an image")
    return values if values.ndim == 2 else values.mean(axis=2)


def _refined(picture: Picture, first_disparity: float, corners: Array, camera: PlenopticCamera | None) -> Triple:
    """Return corners located through lenses: indices of corner and lens, and positions in pixels."""
    cut = None
    if camera is not None:
        cut = partial(_displaced, CutBlur(camera), lens_types(camera, picture.centre + 0.5))
    # Directions in radians of the board's columns and rows at each corner.
    steps = np.gradient(corners, axis=1), np.gradient(corners, axis=0)
    angles = np.stack([np.arctan2(step[..., 1], step[..., 0]).ravel() for step in steps], axis=-1)
    position = corners.reshape(-1, 2)
    disparity = np.full(len(position), first_disparity)
    for _ in range(3):
        corner, lens, expected = _expected(picture, position, disparity)
        # A micro-image shows the directions as they are, or turned by half a turn.
        saddles = find_saddles(
            picture.image,
            picture.weight,
            expected,
            angles[corner],
            picture.centre[lens],
            radius=picture.radius,
            even=picture.even,
            displacement=cut and partial(cut, lens, disparity[corner]),
        )
        good = saddles.deviation < 0.5
        if good.any():
            good &= saddles.contrast > 0.3 * np.median(saddles.contrast[good])
        corner = corner[good]
        lens = lens[good]
        located = saddles.position[good]
        agreed = _improved(picture, corner, lens, located, position, disparity)
    return corner[agreed], lens[agreed], located[agreed]


def _displaced(cut: CutBlur, lens_type: Array, lens: Array, disparity: Array, rows: Array, arm: Array) -> Array:
    """Return displacements from pixels to the positions that these pixels show, for rows of candidates."""
    kind = lens_type[lens[rows]]
    return cut.displaced(kind, cut.defocus(kind, disparity[rows]), arm)


def _expected(picture: Picture, position: Array, disparity: Array) -> Triple:
    """Return indices of corner and lens for each pair that should be visible, and the expected position in pixels."""
    reach = (picture.radius - 3.0) / np.abs(disparity)
    lenses = cKDTree(picture.centre).query_ball_point(position, reach)
    corner = np.repeat(np.arange(len(position)), [len(some) for some in lenses])
    lens = np.concatenate(lenses).astype(int)
    centre = picture.centre[lens]
    return corner, lens, centre + disparity[corner, None] * (centre - position[corner])


def _improved(picture: Picture, corner: Array, lens: Array, located: Array, position: Array, disparity: Array) -> Array:
    """Recompute positions and disparities of corners; return a mask of the observations that agree with both."""
    agrees = np.zeros(len(located), dtype=bool)
    for index in range(len(position)):
        rows = np.flatnonzero(corner == index)
        centre = picture.centre[lens[rows]]
        chosen = np.ones(len(rows), dtype=bool)
        for _ in range(3):
            if chosen.sum() < 3:
                break
            # p - C = sigma C - sigma Q is linear in sigma and sigma Q.
            around = centre[chosen]
            moved = (located[rows] - centre)[chosen]
            about = around.mean(0)
            shift = moved.mean(0)
            spread = ((around - about) ** 2).sum()
            if not spread > 0:
                break
            slope = ((around - about) * (moved - shift)).sum() / spread
            if not 0.5 < slope / disparity[index] < 2:
                break
            miss = np.hypot(*(shift + slope * (centre - about) - (located[rows] - centre)).T)
            chosen = miss < max(0.3, 6.0 * np.median(miss[chosen]) / 1.17741)
        else:
            disparity[index] = slope
            position[index] = about - shift / slope
            agrees[rows[chosen]] = True
    return agrees


def write_corners(path: str | Path, corners: Table) -> None:
    """Write corners as a CSV file for `calibrate`."""
    names = VIEW_COLUMNS if corners.in_views else CORNER_COLUMNS
    write_table(path, Table("corners", {name: corners[name] for name in names}))
