r"""Power in the bins of one object plane as a function of a capture, by full fields, with its derivatives.

The field is linear in the amplitudes of the pixels, the square roots of what they have recorded; the power is the
square of its modulus. So with the field u at the directions of the object plane, and its change du, a bin changes by
the sum of :math:`2 \mathrm{Re}(u^* du)` over it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics import guards
from ..optics.free_space import advance
from ..optics.power import power
from ..runtime.backend import backend
from ..runtime.fft import Field, fft, resting_drjit
from ..runtime.limits import require_memory
from ..system.optical_system import OpticalSystem
from .bins import BinSums
from .conjugates import ThinConjugates
from .elements import converging, microlenses, to_object
from .grids import AxisDirections, AxisStep, Directions, Step, Strip
from .planning import field_memory, plan, require_feasible
from .steps import Element, lowest


class Spectrum:
    """A thin element, and the transform to the lowest frequencies.

    Parameters
    ----------
    element : Element
        What the field passes first.
    step : Step or Directions
        Sampling.
    """

    def __init__(self, element: Element, step: Step | Directions) -> None:
        arrays = backend().arrays
        shape = (step.y.count, step.x.count)
        self._step, self._arrays = step, arrays
        self._factor = arrays.zeros(shape, np.complex64)
        for lit in element.lit(slice(0, step.y.count)):
            ones = arrays.ones((lit.stop - lit.start, step.x.count), np.complex64)
            element.through(lit, ones, self._factor[lit])
        if element.along_columns is not None:
            self._factor *= element.along_columns[:, None]

    def forward(self, field: Field) -> Field:
        """Return the spectrum, (frequencies along x, along y), of a field (rows, columns)."""
        step = self._step
        part = _to_lowest(field * self._factor, step.x)
        return _to_lowest(self._arrays.ascontiguousarray(part.T), step.y)

    def adjoint(self, spectrum: Field) -> Field:
        """Apply the adjoint of `forward`."""
        step = self._step
        part = _from_lowest(spectrum, step.y)[:, : step.y.count]
        part = _from_lowest(self._arrays.ascontiguousarray(part.T), step.x)[:, : step.x.count]
        return part * self._factor.conj()


class Passage:
    """A thin element, and free space to the next plane.

    Parameters
    ----------
    element : Element
        What the field passes first.
    step : Step
        Sampling.
    distance : float
        To the next plane, in millimetres.
    wavelength : float
        In nanometres.
    """

    def __init__(self, element: Element, step: Step, distance: float, wavelength: float) -> None:
        self._spectrum, self._step, self._arrays = Spectrum(element, step), step, backend().arrays
        self._distance, self._wavelength = distance, wavelength

    def forward(self, field: Field) -> Field:
        """Return the field (rows, columns) at the destination samples of one at the source samples."""
        x, y = self._step.x, self._step.y
        part = self._advance(self._spectrum.forward(field), 1)
        part = self._arrays.ascontiguousarray(_fft(part, inverse=True)[:, : y.wanted].T)
        return _fft(part, inverse=True)[:, : x.wanted]

    def adjoint(self, field: Field) -> Field:
        """Apply the adjoint of `forward`."""
        x, y, arrays = self._step.x, self._step.y, self._arrays
        rows = arrays.zeros((y.wanted, x.kept), np.complex64)
        rows[:, : x.wanted] = field
        columns = arrays.zeros((x.kept, y.kept), np.complex64)
        columns[:, : y.wanted] = _unscaled(rows).T
        return self._spectrum.adjoint(self._advance(_unscaled(columns), -1))

    def _advance(self, spectrum: Field, sign: int) -> Field:
        x, y = self._step.x, self._step.y
        shift = (sign * (x.start - x.first), sign * (y.start - y.first))
        return advance(spectrum, (x.new_pitch, y.new_pitch), sign * self._distance, self._wavelength, shift=shift)


def _to_lowest(field: Field, axis: AxisStep | AxisDirections) -> Field:
    """Transform rows, filled up with zeros, and keep the lowest frequencies."""
    padded = backend().arrays.zeros((len(field), axis.padded), np.complex64)
    padded[:, : axis.count] = field
    padded = _fft(padded)
    low, high = lowest(axis.padded, axis.kept)
    return backend().arrays.concatenate([padded[:, low], padded[:, high]], 1)


def _from_lowest(spectrum: Field, axis: AxisStep | AxisDirections) -> Field:
    """Apply the adjoint of `_to_lowest`, but for leaving samples out."""
    low, high = lowest(axis.padded, axis.kept)
    padded = backend().arrays.zeros((len(spectrum), axis.padded), np.complex64)
    padded[:, low], padded[:, high] = spectrum[:, : low.stop], spectrum[:, low.stop :]
    return fft(padded, axis=1, inverse=True, norm="backward")


def _fft(field: Field, *, inverse: bool = False) -> Field:
    """Transform rows; forward transforms are divided by the length, inverse ones are not."""
    return fft(field, axis=1, inverse=inverse, norm="forward")


def _unscaled(field: Field) -> Field:
    """Apply the adjoint of the inverse transform of rows."""
    return fft(field, axis=1, norm="backward")


class AmplitudeFields:
    """From the amplitudes of the pixels to the fields of subsets of lenses at the directions of an object plane.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, whose lenses are thin parabolic phase elements.
    distance : float
        Of the object plane, in millimetres.
    wavelength : float
        In nanometres.
    interleave : int
        Period of the subsets along both axes; 1 is one field of all lenses.
    oversample : int
        Bins per lens along each axis, which the sampling must hold.

    Attributes
    ----------
    step : Directions
        Sampling of the directions.

    Raises
    ------
    InputError
        If the fields need too much memory or work.
    """

    def __init__(
        self, camera: PlenopticCamera, distance: float, wavelength: float, interleave: int, oversample: int
    ) -> None:
        (left, top), (columns, rows) = camera.crop_offset, camera.crop_size
        grids = plan(camera, wavelength, [distance], ((left, left + columns), (top, top + rows)), oversample)
        require_feasible(grids)
        (self.step,), self._subsamples = grids.to_objects, grids.subsamples
        on_mla = sum(math.prod(strip.to_mla.shape) for strip in grids.strips)
        fields = 2 + interleave**2  # what every subset's lenses let through is kept, too
        kept = 8.0 * (
            fields * on_mla + 2 * rows * columns * grids.subsamples**2 + 4 * self.step.x.kept * self.step.y.kept
        )
        require_memory(grids.memory + kept, "derivatives of a wave reconstruction", limit=field_memory())
        self._strips = [_StripFields(strip, camera, wavelength, interleave) for strip in grids.strips]
        across = grids.main_lens
        inside = np.hypot(across.x.destination, across.y.destination[:, None]) <= camera.aperture_radius
        self._sample_area = across.sample_area / camera.pixel_size**2
        self._pupil = backend().arrays.asarray(inside)
        (whole,) = ThinConjugates(OpticalSystem(camera, wavelength)).zones(distance)
        self._to_object = Spectrum(to_object(self.step, whole), self.step)
        self._subsets = range(interleave**2)

    def forward(self, amplitude: NDArray[np.float32], *, judged: bool = False) -> list[Field]:
        """Return the field of every subset, (directions along x, along y).

        Parameters
        ----------
        amplitude : float32 array (rows, columns)
            Of the pixels.
        judged : bool
            Whether guards are told of the light that misses the pupil.
        """
        arrays, n = backend().arrays, self._subsamples
        samples = arrays.asarray(amplitude).repeat(n, 0).repeat(n, 1)
        on_mla = [strip.to_mla.forward(samples[strip.rows(n)]) for strip in self._strips]
        fields, passed = [], 0.0
        for subset in self._subsets:
            pairs = self._pairs(on_mla)
            at_pupil = self._pupil * sum(strip.to_pupil[subset].forward(field) for strip, field in pairs)
            passed += power(at_pupil)
            fields.append(self._to_object.forward(at_pupil))
        sent = float((amplitude.astype(np.float64) ** 2).sum())
        if judged and sent:
            guards.judge(guards.PUPIL, 1 - passed * self._sample_area / sent)
        return fields

    def adjoint(self, fields: list[Field]) -> NDArray[np.float64]:
        """Apply the real part of the adjoint of `forward`, to amplitudes."""
        n, on_mla = self._subsamples, [0.0 for _ in self._strips]
        for subset, field in zip(self._subsets, fields, strict=True):
            at_pupil = self._pupil * self._to_object.adjoint(field)
            on_mla = [own + strip.to_pupil[subset].adjoint(at_pupil) for strip, own in self._pairs(on_mla)]
        samples = np.concatenate(
            [backend().to_host(strip.to_mla.adjoint(field)).real for strip, field in self._pairs(on_mla)]
        )
        rows, columns = (size // n for size in samples.shape)
        return np.asarray(samples.reshape(rows, n, columns, n).sum((1, 3), dtype=np.float64))

    def _pairs(self, fields: list[Any]) -> zip[tuple[_StripFields, Any]]:
        return zip(self._strips, fields, strict=True)


class _StripFields:
    """The way of the light of some rows of the detector up to the main lens."""

    def __init__(self, strip: Strip, camera: PlenopticCamera, wavelength: float, interleave: int) -> None:
        self._rows, onto, on = strip.rows, strip.to_mla, strip.to_main_lens
        # All lenses light the array at once, and a subset is what its lenses let through: see `full_fields`.
        light = converging(onto, camera, wavelength, 1, (0, 0))
        self.to_mla = Passage(light, onto, camera.detector_distance, wavelength)
        self.to_pupil = [
            Passage(microlenses(on, camera, wavelength, interleave, subset), on, camera.mla_distance, wavelength)
            for subset in np.ndindex(interleave, interleave)
        ]

    def rows(self, subsamples: int) -> slice:
        """Return which rows of samples they are."""
        return slice(self._rows.start * subsamples, self._rows.stop * subsamples)


@dataclass
class Linearised:
    """The power in bins of one image, and its derivatives there.

    Attributes
    ----------
    fields : AmplitudeFields
        The way.
    bins : BinSums
        The sums.
    image : float32 array (rows, columns)
        Not negative. Where it is zero the square root has no derivative, and 0 is taken.
    judged : bool
        Whether guards are told of the light that is lost.
    """

    fields: AmplitudeFields
    bins: BinSums
    image: NDArray[np.float32]
    judged: bool

    def __post_init__(self) -> None:
        amplitude = np.sqrt(self.image)
        self._slope = np.divide(0.5, amplitude, out=np.zeros_like(amplitude), where=amplitude > 0)
        with resting_drjit():
            self._at = [backend().to_host(field) for field in self.fields.forward(amplitude, judged=self.judged)]
        self.power = self.bins.at(np.asarray(sum(np.abs(field.astype(np.complex128)) ** 2 for field in self._at)))

    def tangent(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the change of the bins with that of the image."""
        with resting_drjit():
            moved = self.fields.forward((self._slope * change).astype(np.float32))
        both = zip(self._at, map(backend().to_host, moved), strict=True)
        change = sum(2 * (field.conj() * other).real.astype(np.float64) for field, other in both)
        return self.bins.tangent(np.asarray(change))

    def back(self, bins: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the gradient with respect to the bins back to the image."""
        arrays, given = backend().arrays, self.bins.back(bins)
        with resting_drjit():
            fields = [arrays.asarray((2 * given * field).astype(np.complex64)) for field in self._at]
            return self._slope * self.fields.adjoint(fields)
