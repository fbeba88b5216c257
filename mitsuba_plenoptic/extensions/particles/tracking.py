"""Particles found in volumes, refined by least squares on the capture, and tracked to the next frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy
import xarray as xr
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from ...errors import refuse_if, require_count, require_number, require_numbers, require_wavelength, suggest_keywords
from ...io import Capture
from ...runtime import POINTS, Doubles, Integers, Progress, as_array, counted
from ..inverse.stored import StoredOperator
from .seeding import Window, as_points
from .voxels import elongation, values_of

_STEP = 0.02
"""Lateral step of derivatives, over the width of a lens imaged to the particle; along the axis by the elongation."""

_LARGEST_STEP = 0.5
"""Lateral motion in a step of least squares at most, over the same width."""


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
    """
    values = np.maximum(values_of(volume)[0], 0)
    refuse_if(not values.any(), "volume: it is empty")
    box = np.array([int(n) // 2 * 2 + 1 for n in require_numbers("apart", apart, count=3, minimum=1)])
    threshold = require_number("threshold", threshold, minimum=0, maximum=1)
    # Of equal values that lie side by side, the last one counts.
    ranked = values * (1 + np.linspace(0, 1e-9, values.size).reshape(values.shape))
    peaks = np.argwhere((ranked == maximum_filter(ranked, box)) & (values >= threshold * values.max()))
    padded = np.pad(values, [(n // 2, n // 2) for n in box])
    around = np.lib.stride_tricks.sliding_window_view(padded, box)[tuple(peaks.T)]
    light = around.sum((1, 2, 3))
    positions = np.empty((len(peaks), 3))
    for axis, name in enumerate("zyx"):
        profile = around.sum(tuple(other for other in (1, 2, 3) if other != axis + 1))
        index = peaks[:, axis] + profile @ (np.arange(box[axis]) - box[axis] // 2) / light
        positions[:, 2 - axis] = np.interp(index, np.arange(values.shape[axis]), volume[name].values)
    return positions, light


@suggest_keywords
def refine_particles(
    capture: Capture,
    positions: Doubles,
    light: Doubles,
    *,
    wavelength: float | None = None,
    window: Window | None = None,
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
    positions, light : float64 array (n, 3), (n,)
        Positions in mm and light to start from.
    wavelength : float, optional
        In vacuum, in nanometres. Default: that of the capture.
    window : Window, optional
        The window between camera and particles. Default: that of the capture, if it is one of `ParticleImages`.
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
    """
    iterations = require_count("iterations", iterations)
    positions = as_points("positions", positions)
    count = len(positions)
    wavelength = require_wavelength(capture.wavelength if wavelength is None else wavelength)
    refuse_if(not count, "positions: there is none to start from")
    light = as_array("light", light, POINTS, shape=(count,))
    camera = capture.camera
    window = window or Window(**capture.metadata.get("particles", {}).get("window", {}))
    positions = window.apparent(positions, camera, wavelength)

    def spreads(places: Doubles) -> Any:
        # GiB that point spreads may take.
        return StoredOperator(camera, places, wavelength=wavelength, accuracy=0, budget=8.0).to_sparse()

    # Over the mean derivative; above 10 no step is tried any more.
    damping = 0.03
    sides = [require_count("bins", side) for side in bins for _ in range(iterations)]
    for side in counted(sides, progress):
        # The matrix that adds side x side pixels of an image.
        rows, columns = np.indices(camera.shape) // side
        index = (rows * (columns.max() + 1) + columns).ravel()
        summed = scipy.sparse.csr_array((np.ones(len(index)), (index, np.arange(len(index)))))
        image = summed @ np.asarray(capture.image, np.float64).ravel()
        # Point spreads, and their derivatives along x, y and z for motions in units of `scale`.
        lens = np.array([camera.bin_size(g) for g in positions[:, 2]])
        scale = np.stack([lens, lens, lens * [elongation(camera, g) for g in positions[:, 2]]], -1)
        moves = _STEP * scale * np.eye(3)[:, None]
        places = [positions, *(positions + moves), *(positions - moves)]
        binned = summed @ spreads(np.concatenate(places))
        unmoved, *moved = (binned[:, first : first + count] for first in range(0, 7 * count, count))
        slopes = [(more - less) / (2 * _STEP) * light for more, less in zip(moved[:3], moved[3:], strict=True)]
        jacobian = scipy.sparse.hstack([unmoved, *slopes], format="csc")
        error = image - unmoved @ light
        typical = float(np.sqrt(jacobian.power(2).sum() / (4 * count)))
        while damping <= 10.0:
            change = scipy.sparse.linalg.lsqr(jacobian, error, damp=damping * typical)[0].reshape(4, count)
            there = positions + scale * np.clip(change[1:].T, -_LARGEST_STEP, _LARGEST_STEP)
            lit = np.maximum(light + change[0], 0)
            if np.linalg.norm(image - summed @ (spreads(there) @ lit)) < np.linalg.norm(error):
                positions, light = there, lit
                damping = max(damping / 3, 1e-4)
                break
            damping *= 4
        damping = min(damping, 1.0)
    # Back into the fluid.
    positions[:, 2] += np.maximum(positions[:, 2] - window.distance, 0) * (1 / window.ratio(camera) - 1)
    return positions, light


def match_particles(
    first: Doubles, second: Doubles, predicted: Doubles, reach: Sequence[float]
) -> tuple[Integers, Integers]:
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
    first = as_points("first", first)
    second = as_points("second", second)
    expected = (first + as_points("predicted", predicted)) / semi_axes
    there = second / semi_axes
    if not len(first) or not len(second):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    away, nearest = cKDTree(there).query(expected)
    back = cKDTree(expected).query(there)[1]
    index = np.flatnonzero((away <= 1) & (back[nearest] == np.arange(len(first))))
    return index, nearest[index]
