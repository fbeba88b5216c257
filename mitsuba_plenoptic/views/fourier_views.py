r"""Light fields of the Fourier light-field microscope, in which the picture under each lens is a view.

The lens at c in the image of the stop receives the light that passed the stop at :math:`-c f_T / f_F`, and shows the
object upright in the camera frame at the scale :math:`z M / f_F`, about the lens's centre
(`mitsuba_plenoptic.lenses.telecentric`). A view has the pixels of the detector; interpolation is only by fractions of a
pixel. Views lie in the columns and rows of the array, however it is turned; each states its own direction.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from ..camera import PlenopticCamera
from ..design import lens_directions, objective_of
from ..errors import refuse_if
from ..prescription import Objective
from ..runtime import Array, Doubles, Floats, Integers, Shape, require_memory
from .coordinates import DIMS, labelled
from .grid import lenses_of_pixels
from .white import MINIMUM_WEIGHT, divide_by_white

_SAME = 1e-6
"""Fraction of a pitch by which columns of lenses may differ that are one, and of a pixel by which lengths may."""


@dataclass(frozen=True, eq=False)
class LensViews:
    """The lenses of a Fourier microscope whose pictures are views, on a grid of the array's rows and columns."""

    # Positions of the columns and rows on the array, in millimetres along its own axes, rising.
    across: Doubles
    down: Doubles
    # Of each lens: its row and column, (2, lenses), the middle of its picture on the detector in millimetres, and the
    # mean slope of its light in the object, (lenses, 2).
    place: Integers
    middle: Doubles
    slope: Doubles
    # Pixels of the pictures on either side of the one in the middle, along x and y.
    half: Shape
    # The lens of each pixel of the detector, -1 of none of these, (rows, columns).
    lens_of_pixel: Integers

    @classmethod
    def of(cls, camera: PlenopticCamera, lens: Objective) -> LensViews:
        """Return the lenses that lie in the image of the stop."""
        lattice = camera.lattice
        p = camera.pixel_size
        # A picture ends with the lens's cell, or with the field stop.
        ends = np.abs(lattice.cell_corners()).max(0) / p - 0.5
        if lens.field_stop is not None:
            ends = np.minimum(ends, lens.field_stop * camera.reduced_distance / lens.last_focal_length / p + 0.5)
        half = int(ends[0] + _SAME), int(ends[1] + _SAME)
        refuse_if(min(half) < 1, f"mla_pitch = {min(camera.mla_pitches):g}: a view needs three pixels of {p:g} or more")
        lenses = lens_directions(camera)
        lit = lenses.lit >= MINIMUM_WEIGHT
        refuse_if(not lit.any(), f"mla_offset = {camera.mla_offset}: no lens lies in the image of the stop")
        index, middle = lenses.index[lit].astype(np.float64), lenses.middle[lit]
        # The array's axes that are nearest to the detector's.
        turn = math.radians(camera.mla_rotation - 90 * round(camera.mla_rotation / 90))
        x, y = lattice.regular.centre(*index.T)
        tolerance = _SAME * min(camera.mla_pitches)
        across, column = _lines(math.cos(turn) * x + math.sin(turn) * y, tolerance)
        down, row = _lines(math.cos(turn) * y - math.sin(turn) * x, tolerance)
        lens_of_pixel = np.append(np.where(lit, np.cumsum(lit) - 1, -1), -1)[lenses.at(*lenses_of_pixels(camera))]
        return cls(across, down, np.stack([row, column]), middle, lenses.slope[lit], half, lens_of_pixel)

    def on_grid(self, values: Array) -> Floats:
        """Return values of the lenses, (lenses, ...), on the grid, (rows, columns, ...), 0 where there is no lens.

        There is none at every second position of a hexagonal array, nor beyond the image of the stop.
        """
        result = np.zeros((len(self.down), len(self.across), *values.shape[1:]), np.float32)
        result[tuple(self.place)] = values
        return result


def decode_views(image: Floats, camera: PlenopticCamera, white: Any, seen: Any) -> xr.DataArray:
    """Return a capture of a Fourier microscope as a light field; see `decode`.

    Shapes: `image` (rows, columns, channels), `white` and `seen`, what it reads and sees of even light, (rows, columns,
    1).
    """
    lens = objective_of(camera)
    views = LensViews.of(camera, lens)
    shape = len(views.down), len(views.across), 2 * views.half[1] + 1, 2 * views.half[0] + 1
    require_memory(
        4.0 * math.prod(shape) * (2 * image.shape[2] + 4), f"light field of {shape[1]} x {shape[0]} views of its lenses"
    )
    unit = np.ones((*camera.shape, 1), np.float32)
    values, divisor, weight, alone = (
        views.on_grid(_sampled(pixels, camera, views)) for pixels in (image, white, seen, unit)
    )
    divisor, weight = divisor[..., 0], weight[..., 0].clip(0, 1)
    # 0.9: Part of the pixels between which a sample is interpolated that must be its own lens's.
    divide_by_white(values, divisor, weight, alone[..., 0] >= 0.9)
    scale = -lens.tube_focal_length / lens.last_focal_length
    coordinates: dict[str, object] = {"weight": (DIMS, weight), "white": (DIMS, divisor)}
    for name, positions, axis in (("u", views.across, "x"), ("v", views.down, "y")):
        coordinates[name] = (name, scale * positions, {"units": "mm", "long_name": f"{axis} on the stop"})
    for name, half, axis in (("s", views.half[0], "x"), ("t", views.half[1], "y")):
        steps = np.arange(half, -half - 1, -1) * camera.bin_size(0)
        coordinates[name] = (name, steps, {"units": "mm", "long_name": f"{axis} in the native object plane"})
    for index, axis in enumerate("xy"):
        coordinates[f"slope_{axis}"] = (("v", "u"), views.on_grid(views.slope[:, index]).astype(np.float64))
    attributes = {"camera": json.dumps(camera.to_dict())}
    return labelled(values if image.shape[2] == 3 else values[..., 0], coordinates, attributes)


def _lines(positions: Doubles, tolerance: float) -> tuple[Doubles, Integers]:
    """Return the distinct positions in rising order, and the index of each position among them."""
    order = np.argsort(positions)
    line_of = np.cumsum(np.diff(positions[order], prepend=-np.inf) > tolerance) - 1
    result = np.empty(len(positions), np.int64)
    result[order] = line_of
    lines = np.array([positions[order][line_of == line].mean() for line in range(int(line_of[-1]) + 1)])
    return lines, result


def _sampled(image: Floats, camera: PlenopticCamera, views: LensViews) -> Floats:
    """Return the pictures upright, (lenses, rows, columns, channels), interpolated linearly between pixels.

    Those of other lenses, and beyond the image, count as 0.
    """
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0))).astype(np.float32, copy=False)
    lens_of_pixel = np.pad(views.lens_of_pixel, 1, constant_values=-1)
    pictures = []
    for lens_index, middle in enumerate(views.middle):
        lines, fractions = [], []
        for axis in (1, 0):
            shift = camera.resolution[axis] / 2 - camera.crop_offset[axis] - 0.5
            position = middle[axis] / camera.pixel_size + shift
            low = math.floor(position)
            fractions.append(np.float32(position - low))
            index = low + np.arange(-views.half[axis], views.half[axis] + 2) + 1
            lines.append(index.clip(0, camera.crop_size[axis] + 1))
        there = np.ix_(*lines)
        picked = padded[there] * (lens_of_pixel[there] == lens_index)[..., None]
        down, across = fractions
        picked = (1 - down) * picked[:-1] + down * picked[1:]
        picked = (1 - across) * picked[:, :-1] + across * picked[:, 1:]
        # Pixels rise with x and y, the coordinates of a light field fall.
        pictures.append(picked[::-1, ::-1])
    return np.stack(pictures)
