"""Fit of a camera's array to places of micro-images: pitches, rotation, offset, and a smooth warp of the lenses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from ...array import WARP_POWERS, Displacement
from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...runtime import exponents, monomials
from ...views import LensGrid


@dataclass(frozen=True)
class ArrayFit:
    """Regular lattice and warp that fit places of micro-images.

    Attributes
    ----------
    pitches : (float, float)
        Pitches in millimetres, as `mla_pitch` takes them.
    rotation : float
        Rotation in degrees.
    offset : (float, float)
        The camera's `mla_offset` in millimetres.
    warp : (14,) array
        Coefficients of `mla_warp`, in mm^-1 and mm^-2.
    nearest : (2,) array
        Index of the lens nearest to the axis, which is the camera's lens (0, 0).
    """

    pitches: tuple[float, float]
    rotation: float
    offset: tuple[float, float]
    warp: np.ndarray
    nearest: np.ndarray

    def lattice_parameters(self) -> dict[str, object]:
        """Return the camera's parameters of the regular lattice."""
        return {"mla_pitch": self.pitches, "mla_rotation": self.rotation, "mla_offset": self.offset}


def lattice_index(grid: LensGrid, lens: np.ndarray) -> np.ndarray:
    """Return steps (n, 2) along and across the rows of a grid's lenses k, l, half steps where rows are shifted."""
    index = lens.astype(np.float64)
    if grid.shifted_rows is not None:
        index[:, 0] += 0.5 * (lens[:, 1] % 2 == grid.shifted_rows)
    return index


def require_alike(grid: LensGrid, camera: PlenopticCamera) -> None:
    """Refuse a picture whose lattice is not the camera's."""
    hexagonal = not camera.lattice.rectangular
    refuse_if(
        hexagonal != (grid.shifted_rows is not None),
        f"mla_lattice = {camera.mla_lattice}: the picture shows rows that are "
        f"{'not ' if hexagonal else ''}shifted by half a pitch",
    )
    lattice = camera.lattice
    scale = camera.image_growth / camera.pixel_size
    nominal = lattice.nearest_distance * scale
    measured = grid.nearest_distance
    refuse_if(
        abs(measured / nominal - 1) > 0.03,
        f"camera: its micro-images are {nominal:.4g} pixels apart, in the picture {measured:.4g}: mla_pitch or the "
        "size of pixels is wrong",
    )


def fit_array(pixels: np.ndarray, index: np.ndarray, camera: PlenopticCamera, degree: int = 3) -> ArrayFit:
    """Fit the array to places (n, 2) in pixels, where the first pixel's centre is 0, of lenses with indices (n, 2).

    The warp has the degree at most, and a lower one for few lenses; of degree 1 there is none.
    """
    scale = camera.pixel_size / camera.image_growth
    at_axis = (np.array(camera.resolution) / 2 - camera.crop_offset) - 0.5
    target = (pixels - at_axis) * scale
    nearest = index[np.hypot(*target.T).argmin()]
    steps = index - nearest
    matrix = np.column_stack([np.ones(len(steps)), steps])
    middle, along, across = np.linalg.lstsq(matrix, target)[0]
    angle_of_rows = math.atan2(along[1], along[0])
    degree = min(degree, 3 if len(pixels) >= 200 else 2 if len(pixels) >= 60 else 1)
    terms = exponents(degree, lowest=2)
    # Coefficients of a warp in pixels at the farthest lens, so that all numbers are of one size.
    reach = np.abs(target).max()

    def displaced(numbers: np.ndarray) -> np.ndarray:
        pitch, row, angle, x0, y0 = numbers[:5]
        c = math.cos(angle)
        s = math.sin(angle)
        u = steps[:, 0] * pitch
        v = steps[:, 1] * row
        x = x0 + c * u - s * v
        y = y0 + s * u + c * v
        powers = np.stack(monomials(x / reach, y / reach, terms), axis=-1) if terms else np.zeros((1, 0))
        warp = (powers @ numbers[5:].reshape(2, -1).T) * scale
        return np.stack([x, y], axis=-1) + warp

    start = [
        math.hypot(*along),
        float(-along[1] * across[0] + along[0] * across[1]) / math.hypot(*along),
        angle_of_rows,
        *middle,
    ]
    solution = scipy.optimize.least_squares(
        lambda numbers: ((displaced(numbers) - target) / scale).ravel(),
        np.array([*start, *np.zeros(2 * len(terms))]),
        x_scale=np.array([1e-3 * scale] * 2 + [1e-4, scale, scale] + [0.1] * (2 * len(terms))),
        loss="soft_l1",
        f_scale=0.2,
    ).x
    pitch, row, angle, x0, y0 = solution[:5]
    warp = np.zeros((2, len(WARP_POWERS)))
    for column, (i, j) in enumerate(terms):
        warp[:, column] = solution[5:].reshape(2, -1)[:, column] * scale / reach ** (i + j)
    aspect = camera.lattice.row_distance / camera.mla_pitches[1]
    pitches = float(pitch), float(row / aspect)
    plain = camera.replace(mla_pitch=pitches, mla_rotation=math.degrees(angle), mla_offset=(0.0, 0.0))
    first = plain.lattice.centre(0.0, 0.0)
    return ArrayFit(pitches, math.degrees(angle), (float(x0 - first[0]), float(y0 - first[1])), warp.ravel(), nearest)


def places(fit: ArrayFit, index: np.ndarray, camera: PlenopticCamera) -> np.ndarray:
    """Return the places (n, 2) in pixels of the micro-images of lenses with indices (n, 2), see `lattice_index`."""
    fitted = camera.replace(mla_pitch=fit.pitches, mla_rotation=fit.rotation, mla_offset=fit.offset)
    lattice = fitted.lattice
    u, v = (index - fit.nearest).T * np.array([[lattice.pitches[0]], [lattice.row_distance]])
    x, y = (first + step for first, step in zip(lattice.centre(0.0, 0.0), lattice.from_frame(u, v), strict=True))
    warped = np.stack([x, y], axis=-1) + np.stack(Displacement(tuple(fit.warp.tolist())).smooth(x, y), axis=-1)
    at_axis = (np.array(camera.resolution) / 2 - camera.crop_offset) - 0.5
    return np.asarray(warped * camera.image_growth / camera.pixel_size + at_axis)
