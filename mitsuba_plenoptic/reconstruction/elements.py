"""Thin elements of a back-propagation: what the rows of a field are multiplied by, and the lenses of pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..optics import rays
from ..optics.main_lens import MainLens
from ..optics.microlenses import is_separable, transmission, transmission_along
from ..optics.phase import parabola, phasor
from ..runtime.backend import array_module, backend
from ..runtime.fft import Field, as_field, pack
from ..runtime.indexing import split
from .grids import Directions, Step
from .steps import Rows

# -- along one axis of an upright square lattice -----------------------------------------------------


def detector_lens(p: np.ndarray, camera: PlenopticCamera, axis: int) -> np.ndarray:
    """Index of the lens that each detector coordinate belongs to: the one of the chief ray. float64."""
    return np.asarray(camera.lattice.axis_cell(_chief(p, camera), axis))


def converging_phase(
    p: np.ndarray, index: np.ndarray, camera: PlenopticCamera, wavelength: float, axis: int
) -> np.ndarray:
    """Phase with which light at detector coordinates converges to the centres of their lenses; complex64."""
    offset = p - camera.lattice.axis_centre(index, axis)
    return phasor(parabola(offset**2, camera.detector_distance, wavelength))


# -- on the rows of a field --------------------------------------------------------------------------


def through_axes(field: Rows, x_factor: np.ndarray, y_factor: np.ndarray) -> Rows:
    """Multiply a field by a function of x times one of y; rows where that is 0 are left out."""
    arrays = backend().arrays
    along_x, along_y = arrays.asarray(x_factor), arrays.asarray(y_factor)
    for rows, samples in field:
        runs = np.flatnonzero(np.diff(y_factor[rows] != 0, prepend=False, append=False)).reshape(-1, 2)
        for first, end in runs.tolist():
            lit = slice(rows.start + first, rows.start + end)
            product = samples[first:end] * along_x
            product *= along_y[lit, None]
            yield lit, product


def to_object(field: Rows, step: Directions, main: MainLens, distance: float, wavelength: float) -> Rows:
    """Take a field at the main lens through it, and take out the path to the object plane's point on the axis."""
    return _through_plane(field, step, lambda x, y: phasor(main.path((x, y), (0.0, 0.0, distance), wavelength)))


def through_microlenses(field: Rows, step: Step, camera: PlenopticCamera, wavelength: float) -> Rows:
    """Take a field at the source of a step through the microlenses."""
    if is_separable(camera):
        factors = (
            transmission_along(camera, wavelength, along.source, axis) for axis, along in enumerate((step.x, step.y))
        )
        return through_axes(field, *factors)
    return _through_plane(field, step, lambda x, y: transmission(camera, wavelength, x, y))


def converging(
    amplitude: Rows, step: Step, camera: PlenopticCamera, wavelength: float, interleave: int, subset: tuple[int, int]
) -> Rows:
    """Let light at the source of a step converge to the centres of the lenses of a subset; the others are dark.

    Parameters
    ----------
    amplitude : rows of a float32 array
        On the detector.
    step : Step
        From the detector to the MLA.
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    interleave : int
        Period of the subset in both indices of the lattice.
    subset : (int, int)
        The subset: the remainders of both indices.
    """
    if is_separable(camera):

        def factor(p: np.ndarray, axis: int) -> np.ndarray:
            index = detector_lens(p, camera, axis)
            phase = converging_phase(p, index, camera, wavelength, axis)
            return np.where(np.mod(index, interleave) == subset[axis], phase, 0)

        return through_axes(amplitude, factor(step.x.source, 0), factor(step.y.source, 1))

    def phase(x: Any, y: Any) -> Any:
        i, j = camera.lattice.cell(_chief(x, camera), _chief(y, camera))
        cx, cy = camera.lattice.centre(i, j)
        light = phasor(parabola((x - cx) ** 2 + (y - cy) ** 2, camera.detector_distance, wavelength))
        i_mine, j_mine = (
            index - interleave * dr.floor((index + 0.5) / interleave) == remainder
            for index, remainder in zip((i, j), subset, strict=True)
        )
        return dr.select(i_mine & j_mine, light, 0)

    return _through_plane(amplitude, step, phase)


def _through_plane(field: Rows, step: Step | Directions, function: Callable[[Any, Any], Any]) -> Rows:
    """Multiply a field by a function of Dr.Jit's x and y, evaluated for the rows that come."""
    for rows, samples in field:
        factor = _evaluate(step.x.source, step.y.source[rows], function)
        factor *= samples
        yield rows, factor


def _chief(p: Any, camera: PlenopticCamera) -> Any:
    return rays.chief_point(p, camera.mla_distance, camera.detector_distance)


def _evaluate(x: np.ndarray, y: np.ndarray, function: Callable[[Any, Any], Any]) -> Field:
    """Evaluate a function of two Dr.Jit arrays at all pairs of coordinates."""
    types = array_module()
    index = dr.arange(types.UInt32, len(x) * len(y))
    _, row, column = split(types, index, len(y), len(x))
    packed = pack(
        function(
            dr.gather(types.Float64, types.Float64(np.ascontiguousarray(x)), column),
            dr.gather(types.Float64, types.Float64(np.ascontiguousarray(y)), row),
        )
    )
    # what Dr.Jit computed is its own to write to
    return as_field(packed, (len(y), len(x))).copy()
