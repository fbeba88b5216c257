"""Thin elements of a back-propagation: what the rows of a field are multiplied by, and the lenses of pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..optics import rays
from ..optics.phase import parabola, phasor, soft_edge
from ..runtime.backend import array_module, backend
from ..runtime.fft import Field, as_field, pack, split
from ..system.microlenses import is_separable, transmission, transmission_along
from .conjugates import Zone
from .grids import AxisStep, Directions, Step
from .steps import Element

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


# -- thin elements -----------------------------------------------------------------------------------


class _Nothing:
    """No element: the field goes on as it is."""

    along_columns: Field | None = None

    def lit(self, rows: slice) -> list[slice]:
        return [rows]

    def through(self, rows: slice, samples: Field, out: Field) -> None:
        out[...] = samples


NOTHING: Element = _Nothing()


class _Axes:
    """A function of x times one of y."""

    def __init__(self, along_x: np.ndarray, along_y: np.ndarray) -> None:
        arrays = backend().arrays
        self._along_x, self.along_columns = arrays.asarray(along_x), arrays.asarray(along_y)
        self._lit = along_y != 0

    def lit(self, rows: slice) -> list[slice]:
        runs = np.flatnonzero(np.diff(self._lit[rows], prepend=False, append=False)).reshape(-1, 2)
        return [slice(rows.start + first, rows.start + end) for first, end in runs.tolist()]

    def through(self, rows: slice, samples: Field, out: Field) -> None:
        backend().arrays.multiply(samples, self._along_x, out=out)


class _Plane:
    """A function of Dr.Jit's x and y, evaluated at the source samples of a step, for the rows that come."""

    along_columns: Field | None = None

    def __init__(self, step: Step | Directions, function: Callable[[Any, Any], Any]) -> None:
        self._step, self._function = step, function

    def lit(self, rows: slice) -> list[slice]:
        return [rows]

    def through(self, rows: slice, samples: Field, out: Field) -> None:
        factor = _evaluate(self._step.x.source, self._step.y.source[rows], self._function)
        backend().arrays.multiply(samples, factor, out=out)


def to_object(step: Directions, zone: Zone) -> Element:
    """Return the main lens, less the path to the point of the object plane in the middle of a zone of the field."""
    light, pitch = zone.light, min(step.x.pitch, step.y.pitch)
    if not zone.is_cut:
        return _Plane(step, lambda x, y: phasor(light.path((x, y))))

    def lens(x: Any, y: Any) -> Any:
        return phasor(light.path((x, y))) * soft_edge(array_module().Float(light.inside((x, y)) / pitch))

    return _Plane(step, lens)


def microlenses(
    step: Step, camera: PlenopticCamera, wavelength: float, interleave: int = 1, subset: tuple[int, int] = (0, 0)
) -> Element:
    """Return the microlenses of a subset, as `converging` has it, in the source plane of a step; others are dark."""
    if is_separable(camera):

        def factor(along: AxisStep, axis: int) -> np.ndarray:
            index = np.asarray(camera.lattice.axis_cell(along.source, axis))
            lens = transmission_along(camera, wavelength, along.source, axis)
            return np.where(np.mod(index, interleave) == subset[axis], lens, 0)

        return _Axes(factor(step.x, 0), factor(step.y, 1))

    def lens(x: Any, y: Any) -> Any:
        light = transmission(camera, wavelength, x, y)
        return light if interleave == 1 else _of_subset(light, *camera.lattice.cell(x, y), interleave, subset)

    return _Plane(step, lens)


def converging(
    step: Step, camera: PlenopticCamera, wavelength: float, interleave: int, subset: tuple[int, int]
) -> Element:
    """Return what lets light converge to the centres of the lenses of a subset; the others are dark.

    Parameters
    ----------
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

        return _Axes(factor(step.x.source, 0), factor(step.y.source, 1))

    def phase(x: Any, y: Any) -> Any:
        i, j = camera.lattice.cell(_chief(x, camera), _chief(y, camera))
        cx, cy = camera.lattice.centre(i, j)
        light = phasor(parabola((x - cx) ** 2 + (y - cy) ** 2, camera.detector_distance, wavelength))
        return _of_subset(light, i, j, interleave, subset)

    return _Plane(step, phase)


def _of_subset(light: Any, i: Any, j: Any, interleave: int, subset: tuple[int, int]) -> Any:
    """Darken what belongs to lenses, by their indices, that are not of the subset."""
    i_mine, j_mine = (
        index - interleave * dr.floor((index + 0.5) / interleave) == remainder
        for index, remainder in zip((i, j), subset, strict=True)
    )
    return dr.select(i_mine & j_mine, light, 0)


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
    return as_field(packed, (len(y), len(x)))
