"""Thin elements of a back-propagation: what they multiply a field by, along one axis or along both."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..optics import rays
from ..optics.microlenses import is_separable, lenses_at
from ..optics.sampling import in_millimetres
from ..runtime.backend import array_module, backend
from ..runtime.fft import Field, as_field, pack
from ..runtime.indexing import split
from .grids import AxisStep, Step
from .steps import Rows

def lens_phase(offset: np.ndarray, focal_length: float | np.ndarray, wavelength: float) -> np.ndarray:
    r"""Transmission of a thin parabolic lens, :math:`\exp(-i \pi x^2 / \lambda f)`.

    Parameters
    ----------
    offset : float64 array
        Distance from the lens's centre along one axis, in millimetres.
    focal_length : float or float64 array
        In millimetres; negative for a diverging lens.
    wavelength : float
        In nanometres.

    Returns
    -------
    complex64 array
        Times that of the other axis, it is the lens's transmission.
    """
    turns = offset**2 / (2 * in_millimetres(wavelength) * focal_length)
    return np.exp(-2j * math.pi * turns).astype(np.complex64)


# -- along one axis of an upright square lattice -----------------------------------------------------


def detector_lens(p: np.ndarray, camera: PlenopticCamera, axis: int) -> np.ndarray:
    """Index of the lens that each detector coordinate belongs to: the one of the chief ray. float64."""
    return np.asarray(camera.lattice.axis_cell(_chief(p, camera), axis))


def converging_phase(
    p: np.ndarray, index: np.ndarray, camera: PlenopticCamera, wavelength: float, axis: int
) -> np.ndarray:
    """Phase with which light at detector coordinates converges to the centres of their lenses; complex64."""
    return lens_phase(p - camera.lattice.axis_centre(index, axis), camera.detector_distance, wavelength)


def microlens_phase(m: np.ndarray, camera: PlenopticCamera, wavelength: float, axis: int) -> np.ndarray:
    """Transmission of the microlenses at coordinates of the MLA plane; complex64."""
    lattice = camera.lattice
    offset = m - lattice.axis_centre(lattice.axis_cell(m, axis), axis)
    phase = lens_phase(offset, camera.mla_focal_length, wavelength)
    return phase if lattice.fill == 1 else np.where(np.abs(offset) <= lattice.aperture_width / 2, phase, 0)


# -- on the rows of a field --------------------------------------------------------------------------


def through_axes(field: Rows, x_factor: np.ndarray, y_factor: np.ndarray) -> Rows:
    """Multiply a field by an element that is a function of x times one of y; rows where that is 0 are left out."""
    arrays = backend().arrays
    along_x, along_y = arrays.asarray(x_factor), arrays.asarray(y_factor)
    for rows, samples in field:
        for first, end in _runs(y_factor[rows] != 0):
            lit = slice(rows.start + first, rows.start + end)
            product = samples[first:end] * along_x
            product *= along_y[lit, None]
            yield lit, product


def through_microlenses(field: Rows, step: Step, camera: PlenopticCamera, wavelength: float) -> Rows:
    """Multiply a field at the destination of a step by the transmission of the microlenses."""
    x, y = step.x.destination, step.y.destination
    if is_separable(camera):
        along = (microlens_phase(m, camera, wavelength, axis) for axis, m in enumerate((x, y)))
        return through_axes(field, *along)
    return _through_plane(field, x, y, lambda x, y: lenses_at(camera, wavelength, x, y))


def converging(
    amplitude: Rows, step: Step, camera: PlenopticCamera, wavelength: float, interleave: int, subset: tuple[int, int]
) -> Rows:
    """Let light on the detector converge to the centres of the lenses of a subset; the other lenses are dark.

    Parameters
    ----------
    amplitude : rows of a float32 array
        At the source samples of the step.
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
        along = (
            _converging_axis(axis_step, camera, wavelength, axis, interleave, subset[axis])
            for axis, axis_step in enumerate((step.x, step.y))
        )
        return through_axes(amplitude, *along)
    lattice, types = camera.lattice, array_module()

    def phase(x: Any, y: Any) -> Any:
        i, j = lattice.cell(_chief(x, camera), _chief(y, camera))
        cx, cy = lattice.centre(i, j)
        turns = ((x - cx) ** 2 + (y - cy) ** 2) * (-0.5 / (in_millimetres(wavelength) * camera.detector_distance))
        sine, cosine = dr.sincos(types.Float(turns - dr.round(turns)) * (2 * math.pi))
        mine = types.Bool(True)
        for index, remainder in zip((i, j), subset, strict=True):
            mine &= index - interleave * dr.floor((index + 0.5) / interleave) == remainder
        return dr.select(mine, types.Complex2f(cosine, sine), 0)

    return _through_plane(amplitude, step.x.source, step.y.source, phase)


def _converging_axis(
    step: AxisStep, camera: PlenopticCamera, wavelength: float, axis: int, interleave: int, subset: int
) -> np.ndarray:
    """Phase along one axis with which light converges to the centres of its lenses; zero outside the subset."""
    index = detector_lens(step.source, camera, axis)
    phase = converging_phase(step.source, index, camera, wavelength, axis)
    return np.where(np.mod(index, interleave) == subset, phase, 0)


def _through_plane(field: Rows, x: np.ndarray, y: np.ndarray, function: Callable[[Any, Any], Any]) -> Rows:
    """Multiply a field by a function of Dr.Jit's x and y, made for the rows that come."""
    for rows, samples in field:
        transmission = _evaluate(x, y[rows], function)
        transmission *= samples
        yield rows, transmission


def _chief(p: Any, camera: PlenopticCamera) -> Any:
    return rays.chief_point(p, camera.mla_distance, camera.detector_distance)


def _runs(lit: np.ndarray) -> list[tuple[int, int]]:
    """First and past-the-last index of each run of what is true."""
    return np.flatnonzero(np.diff(lit, prepend=False, append=False)).reshape(-1, 2).tolist()


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
