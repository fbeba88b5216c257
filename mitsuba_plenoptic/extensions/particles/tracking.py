"""Particles found in volumes, refined by least squares on the capture, and tracked to the next frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from ...camera import PlenopticCamera
from ...errors import refuse_if, require_count, require_number, require_numbers, require_wavelength, suggest_keywords
from ...io import Capture
from ...runtime import MILLIMETRES, POINTS, Doubles, Progress, as_array
from ..inverse.stored import StoredOperator
from .voxels import elongation, require_points, values_of

_STEP = 0.02
"""Lateral step of derivatives, over the width of a lens imaged to the particle; along the axis by the elongation."""

_LARGEST_STEP = 0.5
"""Lateral motion in a step of least squares at most, over the same width."""

_DAMPING = 0.03
_MOST_DAMPING = 10.0
"""Damping of the first step, over the mean derivative, and that above which no step is tried any more."""

_BUDGET = 8.0
"""GiB that point spreads may take."""


def locate_particles(
    volume: xr.DataArray, *, threshold: float = 0.1, apart: Sequence[int] = (3, 3, 3)
) -> tuple[Doubles, Doubles]:
    """Return positions (n, 3) in mm and the light (n,) of the local maxima of a volume.

    Parameters
    ----------
    volume : xarray.DataArray (z, y, x)
        The volume.
    threshold : float
        Least value of a maximum, over the largest one.
    apart : (int, int, int)
        Voxels, along z, y and x, of the boxes in which a maximum is the largest value. The position is the centroid of
        the box, and the light its sum.

    Raises
    ------
    InputError
        If the volume is empty.
    """
    values = np.maximum(values_of(volume)[0], 0)
    refuse_if(not values.any(), "volume: it is empty")
    box = tuple(int(n) // 2 * 2 + 1 for n in require_numbers("apart", apart, count=3, minimum=1))
    threshold = require_number("threshold", threshold, minimum=0, maximum=1)
    # Of equal values that lie side by side, the last one counts.
    ranked = values * (1 + np.linspace(0, 1e-9, values.size).reshape(values.shape))
    peaks = np.argwhere((ranked == maximum_filter(ranked, box)) & (values >= threshold * values.max()))
    half = [n // 2 for n in box]
    padded = np.pad(values, [(n, n) for n in half])
    positions = np.empty((len(peaks), 3))
    light = np.empty(len(peaks))
    axes = [volume[name].values for name in "zyx"]
    for index, peak in enumerate(peaks):
        around = padded[tuple(slice(n, n + width) for n, width in zip(peak, box, strict=True))]
        light[index] = around.sum()
        for axis, (name, places) in enumerate(zip("zyx", axes, strict=True)):
            spacing = places[1] - places[0] if len(places) > 1 else 0.0
            profile = around.sum(axis=tuple(i for i in range(3) if i != axis))
            offset = profile @ (np.arange(box[axis]) - half[axis]) / profile.sum()
            positions[index, "xyz".index(name)] = places[peak[axis]] + offset * spacing
    return positions, light


@suggest_keywords
def refine_particles(
    capture: Capture,
    positions: Doubles,
    light: Doubles,
    *,
    wavelength: float | None = None,
    iterations: int = 4,
    bins: Sequence[int] = (4, 2, 1),
    progress: Progress | None = None,
) -> tuple[Doubles, Doubles]:
    """Return positions and light of particles that explain a capture by waves best, in the sense of least squares.

    Levenberg and Marquardt's steps from given positions, with derivatives by central differences of point spreads.
    Point spreads have fringes, in which steps get stuck, so that the first ones explain sums of several pixels.
    Particles count as points that light the pupil evenly, each with a point spread of its own.

    Parameters
    ----------
    capture : Capture
        The image.
    positions : float64 array (n, 3)
        Positions to start from, in mm.
    light : float64 array (n,)
        Light of the particles to start from.
    wavelength : float, optional
        In nanometres. Default: that of the capture.
    iterations : int
        Number of steps for each of `bins`.
    bins : sequence of int
        Pixels along an axis that are added, in turn.
    progress : callable, optional
        Called with the numbers of steps done and of all.

    Returns
    -------
    positions : float64 array (n, 3)
    light : float64 array (n,)

    Raises
    ------
    InputError
        If there is no particle, or the point spreads take more than 8 GiB.
    """
    iterations = require_count("iterations", iterations)
    positions = require_points("positions", positions)
    count = len(positions)
    wavelength = require_wavelength(capture.wavelength if wavelength is None else wavelength)
    refuse_if(not count, "positions: there is none to start from")
    refuse_if(np.shape(light) != (count,), f"light of shape {np.shape(light)}: there are {count} positions")
    positions = as_array("positions", positions, np.float64, POINTS, units=MILLIMETRES)
    light = as_array("light", light, np.float64, POINTS)
    camera = capture.camera
    damping = _DAMPING
    levels = [level for level in bins for _ in range(iterations)]
    for step, level in enumerate(levels):
        if progress:
            progress(step, len(levels))
        lens = np.array([camera.bin_size(g) for g in positions[:, 2]])
        scale = np.stack([lens, lens, lens * [elongation(camera, g) for g in positions[:, 2]]], -1)
        # The sparse matrix that adds side x side pixels of an image.
        side = require_count("bins", level)
        rows, columns = np.indices(camera.shape) // side
        index = (rows * (-(-camera.shape[1] // side)) + columns).ravel()
        summed = scipy.sparse.csr_array((np.ones(len(index)), (index, np.arange(len(index)))))
        image = summed @ np.asarray(capture.image, np.float64).ravel()
        unmoved, slopes = _slopes(camera, positions, scale, wavelength)
        jacobian = scipy.sparse.hstack([summed @ unmoved, *(summed @ slope * light for slope in slopes)], format="csc")
        error = image - summed @ (unmoved @ light)
        while True:
            change = scipy.sparse.linalg.lsqr(
                jacobian, error, damp=damping * float(np.sqrt(jacobian.power(2).sum() / (4 * count)))
            )[0].reshape(4, count)
            moved = positions + scale * np.clip(change[1:].T, -_LARGEST_STEP, _LARGEST_STEP)
            lit = np.maximum(light + change[0], 0)
            spreads = StoredOperator(camera, moved, wavelength=wavelength, accuracy=0, budget=_BUDGET).to_sparse()
            better = np.linalg.norm(image - summed @ (spreads @ lit)) < np.linalg.norm(error)
            damping = max(damping / 3, 1e-4) if better else damping * 4
            if better:
                positions = moved
                light = lit
            if better or damping > _MOST_DAMPING:
                damping = min(damping, 1.0)
                break
    if progress:
        progress(len(levels), len(levels))
    return positions, light


def _slopes(camera: PlenopticCamera, positions: Doubles, scale: Doubles, wavelength: float) -> tuple[Any, list[Any]]:
    """Return the point spreads (pixels, n), and their derivatives along x, y and z for motions in units of `scale`."""
    moves = _STEP * scale[:, None] * np.eye(3)
    places = [positions, *(positions + sign * moves[:, axis] for axis in range(3) for sign in (1, -1))]
    spreads = StoredOperator(
        camera, np.concatenate(places), wavelength=wavelength, accuracy=0, budget=_BUDGET
    ).to_sparse()
    unmoved, *sides = (spreads[:, motion * len(positions) : (motion + 1) * len(positions)] for motion in range(7))
    return unmoved, [(sides[2 * axis] - sides[2 * axis + 1]) / (2 * _STEP) for axis in range(3)]


def match_particles(
    first: Doubles, second: Doubles, predicted: Doubles, reach: Sequence[float]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of particles of two frames that are the same ones.

    Parameters
    ----------
    first, second : float64 array (n, 3), (m, 3)
        Positions in both frames.
    predicted : float64 array (n, 3)
        Displacement by which a particle of the first frame is looked for in the second one, such as that of
        `correlate_volumes`.
    reach : (float, float, float)
        Semi-axes of the ellipsoid, in mm, in which the nearest particle is taken, if none of the first frame is nearer
        to that one.
    """
    semi_axes = np.array(require_numbers("reach", reach, count=3, minimum=1e-9))
    first = require_points("first", first)
    second = require_points("second", second)
    expected = (first + require_points("predicted", predicted)) / semi_axes
    there = second / semi_axes
    if not len(first) or not len(second):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    away, nearest = cKDTree(there).query(expected)
    back = cKDTree(expected).query(there)[1]
    index = np.flatnonzero((away <= 1) & (back[nearest] == np.arange(len(first))))
    return index, nearest[index]
