"""Positions of the micro-images on the detector; only this decoding module depends on the microlens lattice.

All decoding code asks here for the centres of micro-images, in pixels of the recorded image, and for the lenses to
which they belong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..array import Displacement, Lattice
from ..camera import PlenopticCamera, Use, require_support
from ..errors import MOST_PIXELS, put_checked, refuse_if, require_count, require_number, require_pair, require_warp
from ..optics import rays
from ..runtime import Array, Doubles, Integers, Numbers, Pair, Shape, Sizes, require_memory, turn


@dataclass(frozen=True)
class LensGrid:
    """Rows and columns of micro-image centres on a detector.

    Pixel coordinates are continuous: pixel k covers [k, k + 1), so that its centre is k + 1/2. A hexagonal lattice
    in either orientation is a grid whose every second row is shifted by half a spacing.

    Parameters
    ----------
    spacing : (float, float)
        Distance in pixels between neighbours of a row, and between rows.
    offset : (float, float)
        Column and row coordinate of the first centre of the first row, before any shift of that row.
    shape : (int, int)
        Rows and columns.
    rotation : float
        Angle in radians of the rows, about the point `offset`, positive from the column axis towards the row axis
        (clockwise as one looks at the picture).
    shifted_rows : {0, 1}, optional
        Which rows are shifted by half a spacing: the even or the odd ones. None: a rectangular grid.
    warp : tuple of 14 or 36 floats, optional
        Coefficients of a smooth displacement from these rows and columns in pixels, along columns, then along rows:
        those of `mla_warp`, over positions in pixels from `middle`.
    middle : (float, float)
        Column and row coordinate from which positions count in the warp: the camera's axis.
    """

    spacing: Pair
    offset: Pair
    shape: Shape
    rotation: float = 0.0
    shifted_rows: int | None = None
    warp: Numbers = ()
    middle: Pair = (0.0, 0.0)

    def __post_init__(self) -> None:
        place = partial(require_number, minimum=-1e9, maximum=1e9)
        spacing = partial(require_number, positive=True, minimum=1e-3, maximum=1e6)
        put_checked(
            self,
            spacing=partial(require_pair, meaning="(along a row, between rows)", rule=spacing),
            offset=partial(require_pair, meaning="(column, row)", rule=place),
            shape=partial(require_pair, meaning="(rows, columns)", rule=partial(require_count, maximum=MOST_PIXELS)),
            rotation=partial(require_number, minimum=-math.tau, maximum=math.tau),
            shifted_rows=partial(require_count, minimum=0, maximum=1),
            warp=require_warp,
            middle=partial(require_pair, meaning="(x, y)", rule=place),
        )

    @property
    def pitch(self) -> float:
        """Side of a square of the same area as one lens's cell, in pixels."""
        return math.sqrt(self.spacing[0] * self.spacing[1])

    @property
    def nearest_distance(self) -> float:
        """Distance in pixels between the closest neighbours."""
        across, down = self.spacing
        return min(across, down) if self.shifted_rows is None else min(across, math.hypot(across / 2, down), 2 * down)

    def centres(self) -> Array:
        """Return the column and row coordinates of all centres.

        Returns
        -------
        (rows, columns, 2) float64 array
        """
        require_memory(48.0 * self.shape[0] * self.shape[1], f"grid of {self.shape[0]} x {self.shape[1]} lenses")
        row, column = np.indices(self.shape, dtype=np.float64)
        if self.shifted_rows is not None:
            column += 0.5 * (row % 2 == self.shifted_rows)
        along = column * self.spacing[0]
        across = row * self.spacing[1]
        regular = self.offset + np.stack(turn(along, across, math.degrees(self.rotation)), axis=-1)
        if not self.warp:
            return regular
        moved = Displacement(self.warp).smooth(*np.moveaxis(regular - self.middle, -1, 0))
        return regular + np.stack(moved, axis=-1)

    def are_like(self, bins: LensGrid) -> bool:
        """Return whether these lenses stand for bins: as many, regular or displaced by a small part of a bin."""
        regular = replace(self, warp=(), middle=(0.0, 0.0))
        # 0.05: Displacement of lenses over the width of a bin up to which they are not interpolated.
        return regular == bins and np.abs(self.centres() - bins.centres()).max() < 0.05 * min(bins.spacing)

    def regular(self, places: Array) -> Array:
        """Return the positions (n, 2) from which the warp displaces to given ones."""
        if not self.warp:
            return places
        return self.middle + np.stack(Displacement(self.warp).regular(*(places - self.middle).T), axis=-1)


def bin_grid(camera: PlenopticCamera) -> LensGrid:
    """Return the detector positions of a light field's bins, which are square and upright.

    The bins are those of a reconstruction, `PlenopticCamera.bin_count`; for a crop window, those with a micro-image
    centred in it. On an upright square lattice with a corner on the axis they are the lenses.
    """
    require_support(camera, Use.LENS_CENTRES)
    camera.require_resolved()
    start = []
    count = []
    spacing = camera.micro_image_pitch / camera.pixel_size
    for axis, bins in enumerate(camera.bin_count):
        pixel = _pixel(camera, (np.arange(bins) - bins / 2 + 0.5) * camera.row_pitch, axis)
        if camera.crop_size[axis] != camera.resolution[axis]:
            pixel = pixel[(pixel >= 0) & (pixel <= camera.crop_size[axis])]
        refuse_if(not pixel.size, f"crop_size = {camera.crop_size}: no micro-image is centred in the recorded window")
        start.append(float(pixel[0]))
        count.append(pixel.size)
    return LensGrid((spacing, spacing), (start[0], start[1]), (count[1], count[0]))


def lens_grid(camera: PlenopticCamera) -> LensGrid:
    """Return the micro-image centres of a camera's lenses on its recorded image.

    They are chief-ray images of the lens centres: at c (b + z) / b on the detector, not at c. For a lattice in another
    position than the default, the grid has all lenses whose micro-image is centred in the image, in whole rows and
    columns, as `estimate_lens_grid` finds them.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        If no micro-image is centred in the recorded window.
    """
    require_support(camera, Use.LENS_CENTRES)
    lattice = camera.lattice.regular
    if lattice.axis_aligned and lattice.aspect == 1 and lattice.offset == (0, 0):
        return _warped(bin_grid(camera), camera)
    refuse_if(
        not len(micro_image_centres(camera, 0)),
        f"crop_size = {camera.crop_size}: no micro-image is centred in the recorded window",
    )
    scale = rays.chief_detector_point(camera, 1 / camera.pixel_size)
    vectors, shifted = lattice_rows(np.array(lattice.basis) * scale)
    x, y = lattice.centre(0.0, 0.0)
    origin = np.array([_pixel(camera, x, 0), _pixel(camera, y, 1)])
    return _warped(covering_grid(camera.shape, origin, vectors, shifted), camera)


def _warped(grid: LensGrid, camera: PlenopticCamera) -> LensGrid:
    """Return the grid of a regular, upright array with the displacement of the camera's lenses."""
    if not (of_array := camera.chief_warp):
        return grid
    # From millimetres on the array to pixels.
    size = camera.pixel_size / camera.image_growth
    warp = [
        coefficient * size ** (sum(powers) - 1)
        for coefficient, powers in zip(of_array, Displacement(of_array).powers * 2, strict=True)
    ]
    x, y = np.array(camera.resolution) / 2 - camera.crop_offset
    return replace(grid, warp=tuple(warp), middle=(float(x), float(y)))


def micro_image_centres(camera: PlenopticCamera, margin: float) -> Array:
    """Return the centres of all micro-images on a camera's recorded image, and up to `margin` pixels beyond.

    The result has the shape (lenses, 2).
    """
    require_support(camera, Use.LENS_CENTRES)
    camera.require_resolved()
    x, y = (rays.chief_point(camera, camera.pixel_coordinates(axis)[[0, -1]]) for axis in (0, 1))
    around = (margin + 1) * camera.pixel_size
    index = camera.lattice.lenses_within((x[0] - around, y[0] - around), (x[1] + around, y[1] + around))
    centre = camera.lattice.centre(*index.T.astype(np.float64))
    centres = np.stack([_pixel(camera, centre[axis], axis) for axis in (0, 1)], axis=-1)
    return centres[((centres >= -margin) & (centres <= np.array(camera.crop_size) + margin)).all(1)]


def lens_indices(camera: PlenopticCamera, centres: Array) -> Pair:
    """Return the lattice indices of the lenses of micro-image centres (..., 2), columns and rows."""
    return camera.lattice.cell(*array_places(camera, centres))


def array_places(camera: PlenopticCamera, centres: Array) -> Doubles:
    """Return the places in mm on the array of the lenses of micro-image centres (..., 2), x and y."""
    p = (centres + camera.crop_offset - np.array(camera.resolution) / 2) * camera.pixel_size
    position = np.moveaxis(rays.chief_point(camera, p), -1, 0)
    nearer, _ = camera.tilted_growth(camera.array_height(*position))
    return position * nearer


def lens_types(camera: PlenopticCamera, centres: Array) -> Array:
    """Return the lens type of each micro-image: the index of its focal length.

    The centres, (..., 2) columns and rows on the recorded image, are computed or estimated ones.
    """
    if len(camera.mla_focal_lengths) == 1:
        return np.zeros(centres.shape[:-1], dtype=np.int64)
    return camera.lattice.lens_type(*lens_indices(camera, centres)).astype(np.int64)


def lenses_of_pixels(camera: PlenopticCamera) -> Integers:
    """Return the lattice indices i and j of the lens of each recorded pixel's chief ray, (2, rows, columns)."""
    x, y = (camera.pixel_coordinates(axis) for axis in (0, 1))
    index = np.empty((2, *camera.shape), np.int32)
    height = max(1, 2**20 // len(x))
    for rows in (slice(first, first + height) for first in range(0, len(y), height)):
        for indices, values in zip(index, rays.chief_lenses(camera, *np.meshgrid(x, y[rows])), strict=True):
            indices[rows] = np.rint(values)
    return index.astype(np.int64)


def lens_numbers(camera: PlenopticCamera) -> Integers:
    """Return a number for the lens of each recorded pixel's chief ray, (rows, columns)."""
    i, j = lenses_of_pixels(camera)
    return (i - i.min()) * (np.ptp(j) + 1) + j - j.min()


def lattice_rows(vectors: Array, tolerance: float = 1e-9, like: Lattice | None = None) -> tuple[Array, bool]:
    """Return steps along and across the rows from two lattice vectors; rows are chosen nearest to horizontal.

    Given a lattice, those are chosen that are most `like` the lattice's, in direction and in distance over pitch.

    Rows and columns are at right angles. Let a and b be the two shortest vectors. A rectangular lattice has rows along
    a and columns along b. A hexagonal lattice, stretched or not, has rows along a + b and columns along a - b, or rows
    along a; every second row is shifted. Three such pairs exist without stretching.

    Shapes: `vectors` (2, 2); the result (2, 2).
    """
    a, b = reduced(vectors)
    # Step along a row, and twice that from row to row; of a rectangular lattice, steps of one.
    crossings = [(a, b), (a + b, a - b), (a, 2 * b + a), (b, 2 * a + b)]
    errors = [abs(p @ q) / (math.hypot(*p) * math.hypot(*q)) for p, q in crossings]
    most = min(errors) + tolerance
    shifted = errors[0] > most
    pairs = [pair for pair, error in zip(crossings, errors, strict=True) if error <= most]
    candidates = [rows for pair in (pairs if shifted else pairs[:1]) for rows in (pair, pair[::-1])]
    row = (1.0, 0.0) if like is None else like.from_frame(1.0, 0.0)

    def unlike(pair: Pair) -> float:
        pitch, apart = (math.hypot(*step) for step in pair)
        turned = abs(row[0] * pair[0][1] - row[1] * pair[0][0]) / pitch
        return turned if like is None else turned + abs(math.log(apart / pitch * np.divide(*like.period())))

    along, across = min(candidates, key=unlike)
    unit = along / math.hypot(*along) * (1 if along @ row > 0 else -1)
    normal = np.array([-unit[1], unit[0]])
    return np.array([unit * math.hypot(*along), normal * (math.hypot(*across) / (2 if shifted else 1))]), shifted


def reduced(vectors: Array) -> Array:
    """Return the two shortest vectors of the lattice that two vectors span, at no less than 90 degrees (Lagrange)."""
    a, b = vectors
    while True:
        if a @ a > b @ b:
            a, b = b, a
        # Of a hexagonal lattice the projection is a half, except for rounding, and either of two vectors will do.
        projection = (a @ b) / (a @ a)
        if abs(projection) <= 0.5 + 1e-9:
            return np.array([a, b if projection <= 0 else -b])
        b = b - round(projection) * a


def covering_grid(shape: Sizes, origin: Array, vectors: Array, shifted: bool) -> LensGrid:
    """Return the grid of a lattice's lenses, counted from the first row and column needed for an image.

    Shapes: `shape` (int, int), `origin` (2,).
    """
    corners = np.array(list(np.ndindex(2, 2))) * np.array(shape[1::-1], np.float64)
    index = np.linalg.solve(vectors.T, (corners - origin).T).T
    # A shifted row may begin half a step earlier.
    slack = np.array([0.5 if shifted else 0.0, 0.0])
    low = np.ceil(index.min(0) - slack).astype(int)
    high = np.floor(index.max(0)).astype(int)
    first = origin + low @ vectors
    return LensGrid(
        spacing=(math.hypot(*vectors[0]), math.hypot(*vectors[1])),
        offset=(float(first[0]), float(first[1])),
        shape=(int(high[1] - low[1]) + 1, int(high[0] - low[0]) + 1),
        rotation=math.atan2(vectors[0, 1], vectors[0, 0]),
        shifted_rows=int(1 - low[1] % 2) if shifted else None,
    )


def _pixel(camera: PlenopticCamera, centre: Any, axis: int) -> Any:
    """Return the coordinate of a lens's micro-image on the recorded image, in pixels."""
    p = rays.chief_detector_point(camera, centre)
    return p / camera.pixel_size + camera.resolution[axis] / 2 - camera.crop_offset[axis]
