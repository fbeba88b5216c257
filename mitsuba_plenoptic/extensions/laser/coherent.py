"""The complex field of many mutually coherent points in the planes of the camera, and the adjoint.

The field on the pupil is a sum over layers of distance (see `pupil_sums`). It propagates through the camera like a
single point's field (see `points.full_field`): by its angular spectrum to the array, through the microlenses by their
diffraction orders, and by its angular spectrum to the detector. All steps are linear; the adjoint applies their
adjoints in opposite order, with conjugated transfer functions and transmissions.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...errors import refuse_if
from ...fields.optical_system import OpticalSystem
from ...lenses.main_lens import MainLens
from ...optics.waves import advance
from ...points.arrival import FieldGrids, SampledField, at_mla, blocks, grids_around
from ...points.full_field import detector_spectrum, pass_brightness, pass_microlenses, pass_pixels, pixel_integrals
from ...points.sampling import Footprint, footprint
from ...runtime import active_backend, check_memory, fft
from .carriers import PupilGrid
from .nonuniform import POINT_BYTES, embedded, taken
from .pupil_sums import Layer, carrier_type, layers

_TOGETHER = 2**14
"""Number of points whose rays are traced together."""


class CoherentFields:
    """Fields of scene points (n, 3) of a camera with a thin main lens, each of unit power through the pupil.

    The phase of a point's amplitude is the phase of the point's field at the centre of the pupil.
    """

    def __init__(self, system: OpticalSystem, points: NDArray[np.float64]) -> None:
        refuse_if(not len(points), "points: coherent fields need at least one")
        lens: Any = system.waves_of(points)
        self.system, self._lens, self._points = system, lens, points
        what = f"coherent field of {len(points)} points"
        self.grids = grids_around(system, lens, _footprint(lens, points), points, what)
        self._pupil = PupilGrid(lens, self.grids.wide_origin, self._pupil_pitch)
        self._parts = layers(system, lens, points)
        kinds = [carrier_type(lens, points[part], self._pupil) for part in self._parts]
        # An upper bound of the memory of a layer's field, without that of each point.
        sums = max(kind.memory(lens, points[part], self._pupil) for kind, part in zip(kinds, self._parts, strict=True))
        check_memory(POINT_BYTES * len(points) + sums + 8.0 * self.grids.wide_pupil**2, what)

    def at(self, amplitudes: NDArray[np.complex64], plane: str) -> SampledField:
        """Return the field of points with these amplitudes in one of the planes, on the backend's device."""
        grid, arrays = self._pupil, active_backend().arrays
        inner = arrays.zeros((grid.count, grid.count), np.complex64)
        for part, layer in self._layers:
            layer.add(arrays.asarray(amplitudes[part]), inner)
        field = arrays.zeros(self.shape("pupil"), np.complex64)
        field[grid.rows, grid.columns] = inner
        pupil = SampledField(field, self.grids.wide_origin, self._pupil_pitch)
        if plane == "pupil":
            return pupil
        array = at_mla(self.system.camera, self.system.wavelength, self.grids, pupil)
        if plane == "array":
            return array
        spectrum = detector_spectrum(self.system, self.grids, array.samples, microlenses=True)
        with fft.resting_drjit():
            return SampledField(fft.fft2(spectrum, inverse=True), array.origin, array.pitch)

    def intensity(self, amplitudes: NDArray[np.complex64]) -> NDArray[np.float32]:
        """Return the intensity of the field on the detector, integrated over each recorded pixel."""
        array = self.at(amplitudes, "array")
        spectrum = detector_spectrum(self.system, self.grids, array.samples, microlenses=True)
        del array
        dr.flush_malloc_cache()
        return active_backend().to_host(pixel_integrals(self.system.camera, spectrum, self.grids))

    def adjoint(self, samples: Any, plane: str) -> NDArray[np.complex64]:
        """Return the inner product of each point's field with samples of one of the planes."""
        camera, grids = self.system.camera, self.grids
        field: fft.Field = active_backend().arrays.array(samples, np.complex64)
        if plane == "detector":
            # Back to the array, and through the microlenses.
            with fft.resting_drjit():
                spectrum = fft.fft2(field)
            wavelength = camera.medium_wavelength(self.system.wavelength)
            spectrum = advance(spectrum, grids.pitch, -camera.space_behind[0], wavelength)
            pass_pixels(camera, wavelength, grids, spectrum)
            with fft.resting_drjit():
                field = fft.fft2(spectrum, inverse=True).conj()
            pass_microlenses(self.system, grids, field)
            pass_brightness(self.system, grids, field)
            field = field.conj()
        if plane != "pupil":
            # Back from the array to the pupil.
            with fft.resting_drjit():
                spectrum = _whole_spectrum(_whole_spectrum(field, grids, axis=1), grids, axis=0)
            spectrum = advance(spectrum, self._pupil_pitch, -camera.pupil_distance, self.system.wavelength)
            with fft.resting_drjit():
                field = fft.fft2(spectrum, inverse=True)
        field = active_backend().arrays.ascontiguousarray(field[self._pupil.rows, self._pupil.columns])
        result = np.empty(len(self._points), np.complex64)
        for part, layer in self._layers:
            result[part] = active_backend().to_host(layer.adjoint(field))
        return result

    def shape(self, plane: str) -> tuple[int, int]:
        """Return the rows and columns of the samples in a plane."""
        columns, rows = (self.grids.wide_pupil,) * 2 if plane == "pupil" else self.grids.count
        return rows, columns

    @property
    def transforms(self) -> int:
        """Number of transforms of the pupil that a field takes, in all layers together."""
        return sum(layer.rank for _, layer in self._layers)

    @property
    def _pupil_pitch(self) -> float:
        return self.grids.pitch * self.grids.wide_mla / self.grids.wide_pupil

    @cached_property
    def _layers(self) -> list[tuple[NDArray[np.int64], Layer]]:
        return [(part, Layer(self.system, self._lens, self._points[part], self._pupil)) for part in self._parts]


def _footprint(lens: MainLens, points: NDArray[np.float64]) -> Footprint:
    """Return the footprints of points, computed for a limited number of points at a time."""
    parts = [footprint(lens, points[first : first + _TOGETHER]) for first in range(0, len(points), _TOGETHER)]
    names = [field.name for field in dataclasses.fields(Footprint)]
    return Footprint(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _whole_spectrum(field: fft.Field, grids: FieldGrids, axis: int) -> fft.Field:
    """Return the wide window's spectrum along one axis, from the detector's window: adjoint of `onto_window`."""
    arrays, count = active_backend().arrays, grids.wide_pupil
    negative, parts = count // 2, []
    for block in blocks(field.shape[1 - axis]):
        part = field[block] if axis == 1 else field[:, block]
        spectrum = fft.fft(embedded(part, grids.offset[1 - axis], grids.wide_mla, axis), axis=axis)
        kept = taken(spectrum, 0, count - negative, axis), taken(spectrum, -negative, negative, axis)
        parts.append(arrays.concatenate(kept, axis))
    return arrays.ascontiguousarray(arrays.concatenate(parts, 1 - axis))
