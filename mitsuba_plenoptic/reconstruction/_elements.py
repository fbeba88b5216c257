"""Thin elements of a back-propagation: what they multiply a field by, along one axis or along both."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..optics import rays
from ..optics.microlenses import transmission, transmission_along
from ..optics.phase import in_millimetres
from ..runtime.backend import array_module
from ..runtime.fft import Field, as_field, pack
from ..runtime.indexing import split

Transmission = Callable[[np.ndarray, np.ndarray], Field]
"""From coordinates along x, (columns,), and along y, (rows,), to a complex64 array (rows, columns)."""


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
    return transmission_along(camera, wavelength, m, axis)


# -- along both axes of any lattice ------------------------------------------------------------------


class FieldThrough:
    """Rows of a field times an element that is no product of a function of x and one of y, made when asked for.

    Parameters
    ----------
    field : float32 or complex64 array (rows, columns)
        The field.
    x, y : float64 arrays
        Coordinates of its columns and rows.
    element : callable
        The transmission.
    """

    def __init__(self, field: np.ndarray, x: np.ndarray, y: np.ndarray, element: Transmission) -> None:
        self._field, self._x, self._y, self._element = field, x, y, element

    def __getitem__(self, rows: slice) -> Field:
        transmission = self._element(self._x, self._y[rows])
        transmission *= self._field[rows]
        return transmission


def microlenses(camera: PlenopticCamera, wavelength: float) -> Transmission:
    """Transmission of the microlenses in the MLA plane."""

    def element(x: np.ndarray, y: np.ndarray) -> Field:
        return _evaluate(x, y, lambda x, y: transmission(camera, wavelength, x, y))

    return element


def converging(camera: PlenopticCamera, wavelength: float, interleave: int, subset: tuple[int, int]) -> Transmission:
    """Phase, on the detector, of light that converges to the centres of the lenses of a subset; zero elsewhere.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    interleave : int
        Period of the subset in both indices of the lattice.
    subset : (int, int)
        The subset: the remainders of both indices.
    """
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

    return lambda x, y: _evaluate(x, y, phase)


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
