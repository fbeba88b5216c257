"""The complex field of many mutually coherent points in the planes of the camera, and the adjoint.

The field on the pupil is a sum over layers of distance (see `pupil_sums`). It propagates through the camera by the
same chain as a single point's field (see `points.full_fields`), and so does the adjoint back.
"""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import refuse_if
from ...fields import Chain, OpticalSystem, retained_workspace
from ...lenses import MainLens
from ...points import Arrival, Footprint, SampledField, footprint, grids_around, intensity, to_array, to_detector
from ...runtime import Doubles, Field, Floats, Integers, Shape, active_backend, check_memory, fft
from .carriers import PupilGrid
from .nonuniform import POINT_BYTES
from .pupil_sums import Layer, carrier_type, layers

_TOGETHER = 2**14
"""Number of points whose rays are traced together."""


class CoherentFields:
    """Fields of scene points (n, 3) of a camera with a thin main lens, each of unit power through the pupil.

    The phase of a point's amplitude is the phase of the point's field at the centre of the pupil.
    """

    def __init__(self, system: OpticalSystem, points: Doubles):
        refuse_if(not len(points), "points: coherent fields need at least one")
        lens: Any = system.waves_of(points)
        self.system = system
        self._lens = lens
        self._points = points
        label = f"coherent field of {len(points)} points"
        self.grids = grids_around(system, lens, _footprint(lens, points), points, label)
        self._pupil = PupilGrid(lens, self.grids.wide_origin, self.grids.pupil_pitch)
        self._parts = layers(system, lens, points)
        kinds = [carrier_type(lens, points[block], self._pupil) for block in self._parts]
        # An upper bound of the memory of a layer's field, without that of each point.
        sums = max(
            kind.memory(lens, points[block], self._pupil) for kind, block in zip(kinds, self._parts, strict=True)
        )
        check_memory(POINT_BYTES * len(points) + sums + 8.0 * self.grids.wide_pupil**2, label)

    def at(self, amplitudes: NDArray[np.complex64], plane: str) -> SampledField:
        """Return the field of points with these amplitudes in one of the planes, on the backend's device."""
        grid = self._pupil
        arrays = active_backend().arrays
        inner = self._inner(amplitudes)
        if plane == "pupil":
            field = arrays.zeros(self.shape("pupil"), np.complex64)
            field[grid.rows, grid.columns] = inner
            return SampledField(field, self.grids.wide_origin, self.grids.pupil_pitch)
        chain = self._to(plane)
        with retained_workspace(chain.steps) as workspace, fft.resting_drjit():
            light = workspace.blocks(inner, grid.rows.start)
            field = workspace.whole(chain.forward(light, workspace), self.shape(plane))
        return SampledField(field, self.grids.origin, self.grids.pitch)

    def intensity(self, amplitudes: NDArray[np.complex64]) -> Floats:
        """Return the intensity of the field on the detector, integrated over each recorded pixel."""
        light = Arrival(self._inner(amplitudes), self._pupil.rows.start, tuple(self._to("array").links))
        return intensity(self.system, self.grids, light)

    def adjoint(self, samples: Any, plane: str) -> NDArray[np.complex64]:
        """Return the inner product of each point's field with samples of one of the planes."""
        arrays = active_backend().arrays
        grid = self._pupil
        field = arrays.asarray(samples, np.complex64)
        if plane == "pupil":
            field = arrays.ascontiguousarray(field[grid.rows, grid.columns])
        else:
            chain = self._to(plane, grid.rows)
            with retained_workspace(chain.steps) as workspace, fft.resting_drjit():
                field = workspace.whole(chain.adjoint(workspace.blocks(field), workspace), (grid.count, grid.count))
        result = np.empty(len(self._points), np.complex64)
        for block, layer in self._layers:
            result[block] = active_backend().to_host(layer.adjoint(field))
        return result

    def _inner(self, amplitudes: NDArray[np.complex64]) -> Field:
        """Return the field on those samples that contain the pupil."""
        arrays = active_backend().arrays
        count = self._pupil.count
        inner = arrays.zeros((count, count), np.complex64)
        for block, layer in self._layers:
            layer.add(arrays.asarray(amplitudes[block]), inner)
        return inner

    def _to(self, plane: str, rows: slice = slice(None)) -> Chain:
        """Return the way from the columns of the pupil, in some rows of the wide window, to another plane."""
        step = self.grids.to_array(self._pupil.columns, rows)
        on = to_detector(self.system, self.grids).links if plane == "detector" else ()
        return Chain([to_array(self.system.camera, self.system.wavelength, step), *on])

    def shape(self, plane: str) -> Shape:
        """Return the rows and columns of the samples in a plane."""
        return (self.grids.wide_pupil,) * 2 if plane == "pupil" else self.grids.shape

    @property
    def transforms(self) -> int:
        """Number of transforms of the pupil that a field takes, in all layers together."""
        return sum(layer.rank for _, layer in self._layers)

    @cached_property
    def _layers(self) -> list[tuple[Integers, Layer]]:
        return [(block, Layer(self.system, self._lens, self._points[block], self._pupil)) for block in self._parts]


def _footprint(lens: MainLens, points: Doubles) -> Footprint:
    """Return the footprints of points, computed for a limited number of points at a time."""
    parts = [footprint(lens, points[first : first + _TOGETHER]) for first in range(0, len(points), _TOGETHER)]
    return Footprint(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))
