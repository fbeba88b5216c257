r"""Light fields of the Fourier light-field microscope, in which the picture under each lens is a view.

The lens at c in the image of the stop receives the light that passed the stop at :math:`-c f_T / f_F`, and shows the
object upright in the camera frame at the scale :math:`z M / f_F`, about the lens's centre
(`mitsuba_plenoptic.lenses.telecentric`). A view has the pixels of the detector; interpolation is only by fractions of a
pixel.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np
import xarray as xr

from ..camera import PlenopticCamera
from ..errors import refuse_if
from ..lenses import main_lens
from ..prescription import Objective
from ..runtime import Doubles, Floats, Integers, require_memory
from .coordinates import DIMS, labelled
from .white import MINIMUM_WEIGHT, divide_by_white, recorded_white

_SAMPLES = 64
"""Positions along a lens at which the stop is looked up."""

_SAME = 1e-6
"""Fraction of a pitch by which columns of lenses may differ that are one."""


@dataclass(frozen=True, eq=False)
class LensViews:
    """The lenses of a Fourier microscope whose pictures are views, on a grid of rows and columns."""

    # Positions of the columns and rows on the array in millimetres, rising; (columns,).
    across: Doubles
    down: Doubles
    # Fraction of a lens there that sees the stop open, and what it records of an even object, over what all the stop
    # lets through evenly; 0 where there is no lens, as at every second position of a hexagonal array, or where it lies
    # beyond the image of the stop; both (rows, columns).
    fraction: Floats
    light: Floats
    # Pixels of their pictures on either side of the one in the middle, along x and y.
    half: tuple[int, int]

    @classmethod
    def of(cls, camera: PlenopticCamera, lens: Objective) -> LensViews:
        """Return the lenses that lie in the image of the stop."""
        lattice = camera.lattice
        p = camera.pixel_size
        refuse_if(
            abs(math.sin(math.radians(2 * camera.mla_rotation))) > _SAME,
            f"mla_rotation = {camera.mla_rotation:g}: views of a Fourier microscope lie in columns and rows, those "
            "of the detector; turn the array by a whole number of right angles",
        )
        # Width and height of a rectangle about each lens's centre that overlaps no other lens's rectangle.
        room = float(lattice.pitches[0]), float(lattice.row_distance)
        upright = abs(math.sin(math.radians(camera.mla_rotation))) < 0.5
        half = tuple(math.floor(width / (2 * p) - 0.5 + _SAME) for width in (room if upright else room[::-1]))
        refuse_if(min(half) < 1, f"mla_pitch = {min(camera.mla_pitches):g}: a view needs three pixels of {p:g} or more")
        reach = lens.blur_diameter(0) / 2 + lattice.cell_reach
        lenses = lattice.lenses_within((-reach, -reach), (reach, reach))
        x, y = (np.asarray(values, np.float64) for values in lattice.centre(*lenses.T.astype(np.float64)))
        fraction, light = _in_stop(camera, lens, x, y)
        light *= camera.lenslet(*lenses.T).gain
        lit = fraction >= MINIMUM_WEIGHT
        refuse_if(not lit.any(), f"mla_offset = {camera.mla_offset}: no lens lies in the image of the stop")
        tolerance = _SAME * min(camera.mla_pitches)
        across, column = _lines(x[lit], tolerance)
        down, row = _lines(y[lit], tolerance)
        tables = np.zeros((2, len(down), len(across)), np.float32)
        tables[:, row, column] = fraction[lit], light[lit]
        return cls(across, down, tables[0], tables[1], (half[0], half[1]))


def decode_views(image: Floats, camera: PlenopticCamera, lens: Objective, white: Floats | None) -> xr.DataArray:
    """Return a capture of a Fourier microscope as a light field; see `decode`.

    Shapes: `image` (rows, columns, channels), `white` (rows, columns, 1).
    """
    views = LensViews.of(camera, lens)
    rows = 2 * views.half[1] + 1
    columns = 2 * views.half[0] + 1
    shape = (*views.fraction.shape, rows, columns)
    require_memory(
        4.0 * math.prod(shape) * (2 * image.shape[2] + 4), f"light field of {shape[1]} x {shape[0]} views of its lenses"
    )
    values = _sampled(image, camera, views)
    there = _sampled(np.ones((*camera.shape, 1), np.float32), camera, views)[..., 0]
    weight, divisor = (there * of_lens[:, :, None, None] for of_lens in (views.fraction, views.light))
    if white is not None:
        lens_number = np.arange(views.fraction.size).reshape(views.fraction.shape)
        away = np.hypot(views.across, views.down[:, None])
        lenses = (np.broadcast_to(lens_number[..., None, None], shape), np.broadcast_to(away[..., None, None], shape))
        recorded = _sampled(white, camera, views)
        divisor = recorded_white(recorded, recorded.shape, [camera], divisor, lenses)[..., 0]
    divide_by_white(values, divisor, weight)
    scale = -lens.tube_focal_length / lens.last_focal_length
    coordinates: dict[str, object] = {"weight": (DIMS, weight), "white": (DIMS, divisor)}
    for name, positions, axis in (("u", views.across, "x"), ("v", views.down, "y")):
        coordinates[name] = (name, scale * positions, {"units": "mm", "long_name": f"{axis} on the stop"})
    for name, half, axis in (("s", views.half[0], "x"), ("t", views.half[1], "y")):
        steps = np.arange(half, -half - 1, -1) * camera.bin_size(0)
        coordinates[name] = (name, steps, {"units": "mm", "long_name": f"{axis} in the native object plane"})
    attributes = {"camera": json.dumps(camera.to_dict())}
    return labelled(values if image.shape[2] == 3 else values[..., 0], coordinates, attributes)


def _in_stop(camera: PlenopticCamera, lens: Objective, x: Doubles, y: Doubles) -> Floats:
    """Return the open fraction of lens apertures, and the light they receive relative to a uniformly lit stop."""
    lattice = camera.lattice
    stop = main_lens(camera)
    reach = lattice.cell_reach
    offset = (np.arange(_SAMPLES) + 0.5) * (2 * reach / _SAMPLES) - reach
    dx, dy = (values.ravel() for values in np.meshgrid(offset, offset))
    inside = np.asarray(lattice.in_aperture(dx, dy), bool)
    dx = dx[inside]
    dy = dy[inside]
    growth = -lens.tube_focal_length / lens.last_focal_length
    # The mean power over the stop is 1.
    mean = stop.passed_power / (math.pi * stop.pupil.radius**2)
    seen = np.empty((2, len(x)), np.float32)
    for index, (cx, cy) in enumerate(zip(x.tolist(), y.tolist(), strict=True)):
        pupil = (cx + dx) * growth, (cy + dy) * growth
        is_open = stop.inside(pupil) >= 0
        power = np.where(is_open, stop.amplitude(pupil, (0.0, 0.0, 0.0)) ** 2, 0)
        seen[:, index] = is_open.mean(), power.mean() / mean
    return seen


def _lines(positions: Doubles, tolerance: float) -> tuple[Doubles, Integers]:
    """Return the distinct positions in rising order, and the index of each position among them."""
    order = np.argsort(positions)
    line_of = np.cumsum(np.diff(positions[order], prepend=-np.inf) > tolerance) - 1
    result = np.empty(len(positions), np.int64)
    result[order] = line_of
    lines = np.array([positions[order][line_of == line].mean() for line in range(int(line_of[-1]) + 1)])
    return lines, result


def _sampled(image: Floats, camera: PlenopticCamera, views: LensViews) -> Floats:
    """Return the pictures upright, (v, u, rows, columns, channels), interpolated linearly; 0 beyond the image."""
    channels = image.shape[2]
    half = views.half
    result = np.zeros((*views.fraction.shape, 2 * half[1] + 1, 2 * half[0] + 1, channels), np.float32)
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0))).astype(np.float32, copy=False)
    for row, column in np.argwhere(views.fraction > 0).tolist():
        picked: Floats = padded
        for axis, centre in ((0, views.down[row]), (1, views.across[column])):
            position = centre / camera.pixel_size + camera.resolution[1 - axis] / 2 - camera.crop_offset[1 - axis] - 0.5
            low = math.floor(position)
            fraction = np.float32(position - low)
            index = low + np.arange(-half[1 - axis], half[1 - axis] + 2) + 1
            lines = np.take(picked, index.clip(0, padded.shape[axis] - 1), axis)
            first, second = (np.take(lines, np.arange(len(index) - 1) + step, axis) for step in (0, 1))
            picked = np.asarray((1 - fraction) * first + fraction * second, np.float32)
        # Pixels rise with x and y, the coordinates of a light field fall.
        result[row, column] = picked[::-1, ::-1]
    return result
