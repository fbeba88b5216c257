"""Fit of a camera's array to places of micro-images: pitches, rotation, offset, and a smooth warp of the lenses."""

import math
from dataclasses import dataclass

import numpy as np

from ...array import WARP_POWERS, Displacement
from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...runtime import Array, Pair, exponents, monomials
from ...views import LensGrid

_NOISE = 0.2
"""Distance in pixels from which on a place has less weight."""


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
    warp : (14,) or (36,) array
        Coefficients of `mla_warp`, of third or fifth degree, in powers of 1/mm.
    nearest : (2,) array
        Index of the lens nearest to the axis, which is the camera's lens (0, 0).
    """

    pitches: Pair
    rotation: float
    offset: Pair
    warp: Array
    nearest: Array

    def lattice_parameters(self) -> dict[str, object]:
        """Return the camera's parameters of the regular lattice."""
        return {"mla_pitch": self.pitches, "mla_rotation": self.rotation, "mla_offset": self.offset}


def lattice_index(grid: LensGrid, lens: Array) -> Array:
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
    nominal = camera.lattice.nearest_distance * camera.image_growth / camera.pixel_size
    measured = grid.nearest_distance
    refuse_if(
        abs(measured / nominal - 1) > 0.03,
        f"camera: its micro-images are {nominal:.4g} pixels apart, in the picture {measured:.4g}: mla_pitch or the "
        "size of pixels is wrong",
    )


def fit_array(pixels: Array, index: Array, camera: PlenopticCamera) -> ArrayFit:
    """Fit the array to places (n, 2) in pixels, where the first pixel's centre is 0, of lenses with indices (n, 2).

    The warp has the lowest degree up to 5, as far as lenses suffice, that places lenses no worse than another
    does, within three standard errors, where each third of them is withheld in turn; of degree 1 there is none.
    """
    scale = camera.pixel_size / camera.image_growth
    target = pixels - (np.array(camera.resolution) - 1) / 2
    # Coefficients of a warp are pixels at the farthest lens.
    reach = np.abs(target).max()
    nearest = index[np.hypot(*target.T).argmin()]
    steps = index - nearest
    middle, along, across = np.linalg.lstsq(np.column_stack([np.ones(len(steps)), steps]), target)[0]
    pitch = math.hypot(*along)
    row = np.linalg.det([along, across]) / pitch
    start = [pitch, row, math.atan2(along[1], along[0]), *middle]

    def placed(numbers: Array) -> Pair:
        """Return places (n, 2), and their derivatives by the numbers, but for the small gradient of the warp."""
        pitch, row, angle = numbers[:3]
        axes = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        from_first = steps * [pitch, row] @ axes
        regular = numbers[3:5] + from_first
        warp = numbers[5:].reshape(2, -1)
        x, y = regular.T / reach
        terms = np.reshape(monomials(x, y, WARP_POWERS[: warp.shape[1]]), (-1, len(steps))).T
        slopes = np.zeros((*regular.shape, len(numbers)))
        slopes[:, :, :2] = steps[:, None] * axes.T
        slopes[:, :, 2] = from_first[:, ::-1] * [-1, 1]
        slopes[:, :, 3:5] = np.eye(2)
        for axis, columns in enumerate(np.split(slopes[:, :, 5:], 2, axis=-1)):
            columns[:, axis] = terms
        return regular + terms @ warp.T, slopes

    def fitted(degree: int, lenses: Array) -> Array:
        """Return pitch, distance of rows, angle, place of the nearest lens, and warp, by weighted least squares."""
        numbers = np.array([*start, *np.zeros(2 * len(exponents(degree, lowest=2)))])
        for _ in range(8):
            place, slopes = placed(numbers)
            off = (target - place)[lenses].ravel()
            slopes = slopes[lenses].reshape(len(off), -1)
            weighted = slopes.T / np.sqrt(1 + (off / _NOISE) ** 2)
            numbers += np.linalg.lstsq(weighted @ slopes, weighted @ off)[0]
        return numbers

    third = np.random.default_rng(0).integers(3, size=len(pixels))
    losses = []
    for candidate in range(1, 6):
        # Lenses that each term of a warp needs.
        if len(pixels) >= 20 * len(exponents(candidate, lowest=2)):
            off = np.empty_like(target)
            for withheld in (third == part for part in range(3)):
                off[withheld] = (target - placed(fitted(candidate, ~withheld))[0])[withheld]
            losses.append(np.sqrt(1 + (off / _NOISE) ** 2).sum(1))
    # Differences from the best, lens by lens: the noise of places is in both.
    more = np.array(losses) - min(losses, key=np.mean)
    worse = more.mean(1) > 3.0 * more.std(1) / math.sqrt(len(pixels))
    degree = 1 + int(np.argmin(worse))
    numbers = fitted(degree, np.ones(len(pixels), bool))
    pitch, row, angle, x0, y0 = numbers[:5] * [scale, scale, 1, scale, scale]
    powers = exponents(degree, lowest=2)
    # In millimetres, with zeros up to the third or the fifth degree.
    warp = np.zeros((2, len(exponents(3 if degree <= 3 else 5, lowest=2))))
    warp[:, : len(powers)] = numbers[5:].reshape(2, -1) * scale / [(reach * scale) ** (i + j) for i, j in powers]
    pitches = float(pitch), float(row / camera.lattice.row_ratio)
    plain = camera.replace(mla_pitch=pitches, mla_rotation=math.degrees(angle), mla_offset=(0.0, 0.0))
    first = plain.lattice.centre(0.0, 0.0)
    return ArrayFit(pitches, math.degrees(angle), (float(x0 - first[0]), float(y0 - first[1])), warp.ravel(), nearest)


def places(fit: ArrayFit, index: Array, camera: PlenopticCamera) -> Array:
    """Return the places (n, 2) in pixels of the micro-images of lenses with indices (n, 2), see `lattice_index`."""
    lattice = camera.replace(**fit.lattice_parameters()).lattice
    u, v = ((index - fit.nearest) * [lattice.pitches[0], lattice.row_distance]).T
    regular = np.transpose(lattice.from_frame(u, v)) + lattice.centre(0.0, 0.0)
    warped = regular + np.transpose(Displacement(tuple(fit.warp.tolist())).smooth(*regular.T))
    return warped * camera.image_growth / camera.pixel_size + (np.array(camera.resolution) - 1) / 2
