r"""The field of one scene point through the whole camera, computed in full: the reference for the other methods.

Behind the main lens, at the pupil point P, a point source at X has the field

.. math:: U(P) = \frac{g}{|P - X|^2} \exp\left(i k \left(|P - X| + \Phi(P)\right)\right)

(the first Rayleigh-Sommerfeld solution of a point source, and the phase of the lens: Goodman, "Introduction to Fourier
Optics", sections 3.5 and 5.1; `lenses.thin` states :math:`\Phi` for both models of a thin lens). The field propagates
to the MLA by its angular spectrum, through the microlenses by :math:`\exp(-i \pi |m - c|^2 / \lambda f_2)` in each
cell, and to the detector by its angular spectrum.

Sampling: while the half widths of pupil and destination together fit the window, no band limit but the evanescent one
is needed (Matsushima and Shimobaba 2009, "Band-limited angular spectrum method"). The pitch represents the steepest
rays. The intensity has twice the field's bandwidth, so the grid is doubled before squaring; a pixel's integral is the
intensity's spectrum times the sinc of the pixel.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..fields.microlenses import has_response, recorded_amplitude, transmission
from ..fields.optical_system import OpticalSystem, is_paraxial
from ..lenses.closed_lens import ClosedLens
from ..optics import guards
from ..optics.waves import advance, direction_cosine, in_millimetres, power
from ..runtime import BatchMap, Box, Cost, Job, Part, PartialSum, active_backend, check_memory, fft
from .arrival import (
    FieldGrids,
    SampledField,
    at_mla,
    blocks,
    field_grids,
    interpolate,
    pupil_field,
    stop_image_arrival,
    telecentric_arrival,
)
from .pupil_weights import PupilWeights

_FINER = 6
"""Samples of an irregular array along an axis in a sample of the field; they limit the accuracy of its edges."""


@dataclass(frozen=True)
class PointFields:
    """Fields of one scene point in the planes of the camera.

    Attributes
    ----------
    pupil : SampledField
        The field behind the pupil.
    mla : SampledField
        The field before the microlens array.
    detector : SampledField
        The field on the detector.
    """

    pupil: SampledField
    mla: SampledField
    detector: SampledField


def full_field(
    system: OpticalSystem,
    position: NDArray[np.float64],
    *,
    pupil_weights: PupilWeights | None = None,
    microlenses: bool = True,
    refinement: float = 1.0,
    growth: float = 1.0,
    grids: FieldGrids | None = None,
    incident: SampledField | None = None,
) -> NDArray[np.float32]:
    """Return one scene point's intensity integrated over each recorded pixel.

    `refinement` and `growth` are factors on the sampling density and on the window's margins, to test convergence.
    `grids` may be taken from a nearly equal camera, so that differences contain no effect of the grids. `incident` is a
    field on the pupil of a thin lens or a collimator that replaces a far point's light, with its own aperture. It may
    be the light of many far points, for which an ideal thin lens is a parabola in paraxial propagation to the array.
    """
    grids = grids or field_grids(system, position, refinement, growth)
    paraxial = incident is not None and is_paraxial(system.camera)
    _, mla = _arrival(system, position, grids, pupil_weights, incident, paraxial)
    # Microlenses are thin phases of direction cosines, whatever the main lens is.
    spectrum = detector_spectrum(system, grids, mla.samples, microlenses)
    del mla
    dr.flush_malloc_cache()
    return active_backend().to_host(pixel_integrals(system.camera, spectrum, grids))


def point_fields(
    system: OpticalSystem,
    position: NDArray[np.float64],
    *,
    pupil_weights: PupilWeights | None = None,
    microlenses: bool = True,
) -> PointFields:
    """Return one scene point's field at every plane, propagated as by `full_field`."""
    grids = field_grids(system, position, 1.0, 1.0)
    pupil, mla = _arrival(system, position, grids, pupil_weights)
    spectrum = detector_spectrum(system, grids, mla.samples.copy(), microlenses)
    with fft.resting_drjit():
        detector = fft.fft2(spectrum, inverse=True)
    planes = (pupil, mla, SampledField(detector, mla.origin, mla.pitch))
    return PointFields(*(SampledField(active_backend().to_host(p.samples), p.origin, p.pitch) for p in planes))


def _arrival(
    system: OpticalSystem,
    position: NDArray[np.float64],
    grids: FieldGrids,
    weights: PupilWeights | None = None,
    incident: SampledField | None = None,
    paraxial: bool = False,
) -> tuple[SampledField, SampledField]:
    """Return the field behind the pupil, and the field before the MLA."""
    lens = system.lens
    if not lens.pupil.finite:
        closed, wavelength = cast(ClosedLens, lens), system.wavelength
        if lens.pupil.swap is not None:
            return stop_image_arrival(closed, position, wavelength, grids, weights, incident)
        return telecentric_arrival(closed, position, wavelength, grids, weights, system.camera.vignetting)
    pupil = pupil_field(system, position, grids, weights, incident)
    return pupil, at_mla(system.camera, system.wavelength, grids, pupil, paraxial)


def detector_spectrum(system: OpticalSystem, grids: FieldGrids, samples: fft.Field, microlenses: bool) -> fft.Field:
    """Return the spectrum, on the detector, of the field that reaches the MLA, whose memory is reused."""
    if microlenses and system.microlenses.axes:
        pass_brightness(system, grids, samples)
        before = _passed_power(system, grids, samples)
        pass_microlenses(system, grids, samples)
        if before > 0:
            guards.check(guards.MICROLENS, 1 - power(samples) / before)
    with fft.resting_drjit():
        spectrum = fft.fft2(samples)
    camera, wavelength = system.camera, system.camera.medium_wavelength(system.wavelength)
    spectrum = advance(spectrum, grids.pitch, camera.space_behind[0], wavelength)
    pass_pixels(camera, wavelength, grids, spectrum)
    return spectrum


def pass_pixels(camera: PlenopticCamera, wavelength: float, grids: FieldGrids, spectrum: fft.Field) -> None:
    """Multiply a spectrum on the detector, in place, by the root of what pixels record of each direction."""
    if not has_response(camera):
        return
    types, (columns, rows) = active_backend().types, grids.count
    for block in blocks(rows):
        row, column = fft.rows_and_columns(types, block.stop - block.start, columns)
        sx = direction_cosine(types, column, columns, grids.pitch, wavelength)
        sy = direction_cosine(types, row + dr.opaque(types.UInt32, block.start), rows, grids.pitch, wavelength)
        amplitude = active_backend().from_drjit(recorded_amplitude(camera, sx, sy))
        spectrum[block] *= amplitude.reshape(spectrum[block].shape)


def pass_brightness(system: OpticalSystem, grids: FieldGrids, samples: fft.Field) -> None:
    """Multiply a field before the array, in place, by the square root of the brightness of the lenses it meets."""
    table, lattice = system.camera.mla_transmissions, system.lattice
    if table is not None:
        for block, x, y in _places(grids):
            amplitude = dr.sqrt(table.at(lattice, *lattice.cell(x, y)))
            samples[block] *= active_backend().from_drjit(amplitude).reshape(samples[block].shape).astype(np.float32)


def pass_microlenses(system: OpticalSystem, grids: FieldGrids, samples: fft.Field) -> None:
    """Multiply a field directly before the array, in place, by the transmission of the microlenses."""
    if any(map(any, (system.camera.mla_jitter, system.camera.mla_figure_error))):
        samples *= _irregular(system, grids)
        return
    for factor in system.microlenses.factors(grids.bend):
        if len(factor.axes) == 2:
            for block, x, y in _places(grids):
                samples[block] *= fft.as_field(fft.pack(factor.at(x, y)), samples[block].shape)
            continue
        (axis,) = factor.axes
        count, start = grids.count[axis], grids.wide_origin[axis] + grids.offset[axis] * grids.pitch
        position = active_backend().types.Float64(dr.arange(active_backend().types.UInt32, count)) * grids.pitch + start
        line = fft.as_field(fft.pack(factor.at(position)), (count,))
        samples *= line if axis == 0 else line[:, None]


def _irregular(system: OpticalSystem, grids: FieldGrids) -> fft.Field:
    """Return the transmission of an irregular array, without the directions that the grid would alias."""
    types, (columns, rows) = active_backend().types, grids.count
    pitch, shape = grids.pitch / _FINER, (_FINER * rows, _FINER * columns)
    check_memory(40.0 * math.prod(shape), f"irregular array of {columns} x {rows} samples")
    left, top = (start + offset * grids.pitch for start, offset in zip(grids.wide_origin, grids.offset, strict=True))
    row, column = fft.rows_and_columns(types, *shape)
    x, y = types.Float64(column) * pitch + left, types.Float64(row) * pitch + top
    fine = fft.as_field(fft.pack(transmission(system.camera, system.wavelength, x, y)), shape)
    lam = in_millimetres(system.wavelength)
    with fft.resting_drjit():
        spectrum = fft.fft2(fine)
        down, across = (
            active_backend().arrays.asarray(np.rint(np.fft.fftfreq(size) * size).astype(int))
            for size in (rows, columns)
        )
        cosines = [np.fft.fftfreq(size, grids.pitch) * lam for size in (rows, columns)]
        spectrum = spectrum[down[:, None], across] * active_backend().arrays.asarray(
            np.hypot(cosines[0][:, None], cosines[1]) <= grids.bend
        )
        return fft.fft2(active_backend().arrays.ascontiguousarray(spectrum), inverse=True) / np.float32(_FINER**2)


def _passed_power(system: OpticalSystem, grids: FieldGrids, samples: fft.Field) -> float:
    """Return the power, in units of a sample, of the part of a field within the microlenses' apertures."""
    if system.lattice.fills:
        return power(samples)
    total, cosine = 0.0, in_millimetres(system.wavelength) / (2 * grids.pitch)
    for block, x, y in _places(grids):
        passed = active_backend().from_drjit(system.microlenses.open_fraction(cosine, x, y))
        intensity = active_backend().arrays.abs(samples[block]).reshape(-1) ** 2
        total += float((intensity * passed).sum(dtype=np.float64))
    return total


def _places(grids: FieldGrids) -> Iterator[tuple[slice, Any, Any]]:
    """Yield blocks of rows of the detector's window, with x and y of their samples."""
    types = active_backend().types
    left, top = (start + offset * grids.pitch for start, offset in zip(grids.wide_origin, grids.offset, strict=True))
    columns = grids.count[0]
    for block in blocks(grids.count[1]):
        row, column = fft.rows_and_columns(types, block.stop - block.start, columns)
        x = types.Float64(column) * grids.pitch + dr.opaque(types.Float64, left)
        y = types.Float64(row) * grids.pitch + dr.opaque(types.Float64, top + block.start * grids.pitch)
        yield block, x, y


def pixel_integrals(camera: PlenopticCamera, spectrum: fft.Field, grids: FieldGrids) -> NDArray[np.float32]:
    """Return the intensity integrated over each recorded pixel, exactly for the band-limited field."""
    arrays = active_backend().arrays
    height, width = camera.shape
    with fft.resting_drjit():
        partial = interpolate(spectrum, 2 * spectrum.shape[0], axis=0)
        rows = arrays.empty((partial.shape[0], width), np.float32)
        for block in blocks(partial.shape[0]):
            parts = interpolate(partial[block], 2 * partial.shape[1], axis=1).view(np.float32)
            arrays.multiply(parts, parts, out=parts)
            rows[block] = _along_pixels(parts[:, 0::2] + parts[:, 1::2], grids, width)
        del partial
        psf = arrays.empty((height, width), np.float32)
        for block in blocks(width):
            psf[:, block] = _along_pixels(arrays.ascontiguousarray(rows[:, block].T), grids, height).T
    return psf


def _along_pixels(intensity: NDArray[np.float32], grids: FieldGrids, count: int) -> NDArray[np.float32]:
    """Return rows of the doubled grid integrated over the recorded pixels: their spectrum times the pixel's sinc."""
    size, per_pixel = intensity.shape[1], 2 * grids.per_pixel
    spectrum = fft.rfft(intensity, axis=1)
    pixel = np.sinc(np.fft.rfftfreq(size) * per_pixel) * per_pixel * grids.pitch / 2
    spectrum *= active_backend().arrays.asarray(pixel.astype(np.float32))
    integrals = fft.irfft(spectrum, size, axis=1)
    first = grids.margin * per_pixel + grids.per_pixel
    return integrals[:, first::per_pixel][:, :count]


@dataclass(frozen=True)
class _FullField:
    """The full field of one point, as a batch."""

    system: OpticalSystem
    position: NDArray[np.float64]
    factors: NDArray[np.float32]  # of the channels
    pupil_weights: PupilWeights | None

    @property
    def samples(self) -> int:
        """Number of samples on the detector."""
        return math.prod(self.system.camera.shape)

    def prepare(self) -> Callable[[], Part]:
        """Return a function that computes the whole batch."""
        psf = full_field(self.system, self.position, pupil_weights=self.pupil_weights)
        part = Part(recorded_pixels(self.system.camera), self.factors[:, None, None] * psf)
        return lambda: part


def recorded_pixels(camera: PlenopticCamera) -> Box:
    """Return the recorded pixels as a box within the detector's pixels."""
    return Box(*camera.crop_offset, *camera.crop_size)


class FullFieldPlan:
    """Captures of points by full fields, with the parameters of `PatchPlan`; `accuracy` is not used."""

    def __init__(
        self,
        system: OpticalSystem,
        points: NDArray[np.float64],
        pupil_weights: PupilWeights | None,
        accuracy: float,
    ) -> None:
        self._system, self._camera, self._points, self._pupil_weights = system, system.camera, points, pupil_weights

    def sum(self, weights: NDArray[np.float64]) -> FullFieldSum:
        """Return the sum, not yet computed, of the point spreads with given weights, (n, channels)."""
        return FullFieldSum(self, weights)

    def batch(self, point: int, factors: NDArray[np.float32]) -> _FullField:
        """Return the batch of one point's spread."""
        weights = self._pupil_weights and self._pupil_weights.take(np.array([point]))
        return _FullField(self._system, self._points[point], factors, weights)

    @property
    def box(self) -> Box:
        """Box of the recorded pixels."""
        return recorded_pixels(self._camera)

    def gather(self, image: NDArray[np.float32], job: Job, done: int, total: int) -> NDArray[np.float64]:
        """Return each point spread's inner product with an image; see `PatchPlan.gather`."""
        one, count = np.ones(1, np.float32), len(self._points)
        batches = (self.batch(point, one) for point in range(count))
        spreads = (part.sums[0] for part in job.each(batches, [1] * count, done, total))
        return np.array([np.tensordot(psf, image, 2) for psf in spreads], np.float64).reshape(-1, image.shape[2])

    def check_memory(self, batch_map: BatchMap, channels: int = 1) -> float:
        """Return the bytes of the image; refuse too many. The memory of fields is checked point by point."""
        memory = 8.0 * channels * math.prod(self._camera.shape)
        check_memory(memory, f"image of {self._camera.shape[1]} x {self._camera.shape[0]} pixels")
        return memory

    def cost(self, batch_map: BatchMap) -> Cost:
        """Return the estimated cost of a sum, from its first point."""
        count, memory = len(self._points), self.check_memory(batch_map)
        start = time.perf_counter()
        if count:
            self.batch(0, np.ones(1, np.float32)).prepare()()
        return Cost(count, count, (time.perf_counter() - start) * count, memory)


class FullFieldSum:
    """A sum of full fields, with the interface of `runtime.batches.LongSum`."""

    def __init__(self, plan: FullFieldPlan, weights: NDArray[np.float64]) -> None:
        self._plan, self._weights = plan, weights.astype(np.float32)
        self._lit = np.flatnonzero(weights.any(1))
        self.arrays: Any = np
        self.box, self.channels = plan.box, weights.shape[1]
        self.items = np.ones(len(self._lit), np.int64)

    def batches(self, first: int) -> Iterator[_FullField]:
        """Yield one batch for each point."""
        return (self._plan.batch(int(point), self._weights[point]) for point in self._lit[first:])

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Return the total with its channels in the last axis."""
        return np.ascontiguousarray(total.sums.transpose(1, 2, 0))
