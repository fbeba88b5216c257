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
from ..optics.power import power
from ..runtime.backend import backend
from ..runtime.fft import Field, resting_drjit
from ..runtime.limits import require_memory
from .bin_sums import BinSums
from .conjugates import ThinConjugates
from .elements import converging, microlenses, to_object
from .grids import Strip
from .passages import Passage, Spectrum
from .planning import field_memory, plan, require_feasible


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
        (whole,) = ThinConjugates(camera, wavelength).zones(distance)
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
