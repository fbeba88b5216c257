"""Where the micro-images lie on the detector: the one place that knows the microlens lattice.

Everything that decodes a capture asks here for the centres of the micro-images, in the pixels of the recorded
image, and for the lenses they belong to. Whatever the lattice is, only this module changes with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import lattice, rays
from ..camera import MOST_PIXELS, PlenopticCamera
from ..errors import InputError, require_count, require_number, require_pair
from ..limits import require_memory


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

    Raises
    ------
    InputError
        If a number is not finite, a spacing is not from 1e-3 to 1e6 pixels, an offset is beyond 1e9 pixels, a
        rotation is beyond a full turn, or a count is not a whole number from 1 to 1048576.
    """

    spacing: tuple[float, float]
    offset: tuple[float, float]
    shape: tuple[int, int]
    rotation: float = 0.0
    shifted_rows: int | None = None

    def __post_init__(self) -> None:
        def put(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        x_and_y = "(along a row, between rows)"
        put("spacing", tuple(_spacing(value) for value in require_pair("spacing", self.spacing, x_and_y)))
        put("offset", tuple(_offset(value) for value in require_pair("offset", self.offset, "(column, row)")))
        put("shape", tuple(_count(value) for value in require_pair("shape", self.shape, "(rows, columns)")))
        put("rotation", require_number("rotation", self.rotation, minimum=-math.tau, maximum=math.tau))
        if self.shifted_rows is not None:
            put("shifted_rows", require_count("shifted_rows", self.shifted_rows, minimum=0, maximum=1))

    @property
    def pitch(self) -> float:
        """Side of a square of the same area as one lens's cell, in pixels."""
        return math.sqrt(self.spacing[0] * self.spacing[1])

    @property
    def nearest_distance(self) -> float:
        """Distance in pixels between the closest neighbours."""
        across, down = self.spacing
        return min(across, down) if self.shifted_rows is None else min(across, math.hypot(across / 2, down), 2 * down)

    def centres(self) -> np.ndarray:
        """Column and row coordinates of all centres.

        Returns
        -------
        (rows, columns, 2) float64 array
        """
        require_memory(48.0 * self.shape[0] * self.shape[1], f"grid of {self.shape[0]} x {self.shape[1]} lenses")
        row, column = np.indices(self.shape, dtype=np.float64)
        if self.shifted_rows is not None:
            column += 0.5 * (row % 2 == self.shifted_rows)
        along, across = column * self.spacing[0], row * self.spacing[1]
        cosine, sine = math.cos(self.rotation), math.sin(self.rotation)
        return np.stack(
            [self.offset[0] + cosine * along - sine * across, self.offset[1] + sine * along + cosine * across],
            axis=-1,
        )


def _spacing(value: Any) -> float:
    return require_number("spacing", require_number("spacing", value, positive=True), minimum=1e-3, maximum=1e6)


def _offset(value: Any) -> float:
    return require_number("offset", value, minimum=-1e9, maximum=1e9)


def _count(value: Any) -> int:
    return require_count("shape", value, maximum=MOST_PIXELS)


def bin_grid(camera: PlenopticCamera) -> LensGrid:
    """Give the centres on the detector of the bins that a light field of this camera has: one a lens, upright.

    The bins are those of a reconstruction, `PlenopticCamera.lens_count`; where the camera records a crop window,
    those whose micro-image is centred in it.

    Raises
    ------
    InputError
        If no micro-image is centred in the recorded window, or a lens is less than a pixel wide.
    """
    camera.require_resolved()
    start, count = [], []
    spacing = camera.micro_image_pitch / camera.pixel_size
    for axis, lenses in enumerate(camera.lens_count):
        index = np.arange(lenses) - lenses // 2
        centre = lattice.cell_centre(index.astype(np.float64), camera.mla_pitch)
        p = rays.chief_detector_point(centre, camera.mla_distance, camera.detector_distance)
        pixel = p / camera.pixel_size + camera.resolution[axis] / 2 - camera.crop_offset[axis]
        if camera.crop_size[axis] != camera.resolution[axis]:
            pixel = pixel[(pixel >= 0) & (pixel <= camera.crop_size[axis])]
        if not pixel.size:
            raise InputError(f"crop_size = {camera.crop_size}: no micro-image is centred in the recorded window")
        start.append(float(pixel[0]))
        count.append(pixel.size)
    return LensGrid((spacing, spacing), (start[0], start[1]), (count[1], count[0]))


def lens_grid(camera: PlenopticCamera) -> LensGrid:
    """Give the micro-image centres of a camera's lenses on its recorded image.

    They are chief-ray images of the lens centres: at c (b + z) / b on the detector, not at c.
    """
    # One lens a bin: the square lattice is that of the bins.
    return bin_grid(camera)
