r"""The field of one scene point through the whole camera, without shortcuts: the reference of the other routes.

Behind the main lens, at the pupil point P, a point source at X has the field

.. math:: U(P) = \frac{g}{|P - X|^2} \exp\left(i k \left(|P - X| - \frac{P^2}{2 f_1}\right)\right)

(the first Rayleigh-Sommerfeld solution of a point source and a thin parabolic lens: Goodman, "Introduction to
Fourier Optics", sections 3.5 and 5.1). It goes to the MLA by its angular spectrum, through the microlenses by
:math:`\exp(-i \pi |m - c|^2 / \lambda f_2)` in each cell, and to the detector by its angular spectrum.

Sampling: while the half widths of pupil and destination together fit the window, no band limit but the
evanescent one is needed (Matsushima and Shimobaba 2009, "Band-limited angular spectrum method"). The pitch holds
the steepest rays. The intensity has twice the field's bandwidth, so the grid is doubled before squaring; a
pixel's integral is the intensity's spectrum times the sinc of the pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import guards
from ..optics.free_space import advance
from ..optics.microlens_orders import axis_transmission, open_fraction, plane_transmission
from ..optics.microlenses import is_separable
from ..optics.phase import in_millimetres, phasor, soft_edge
from ..optics.power import band_edge_fraction, fraction, power, rim
from ..runtime.backend import backend
from ..runtime.fft import Field, as_field, fft, fft2, irfft, pack, resting_drjit, rfft
from ..runtime.indexing import quotient
from .full_field_grids import BLOCK, FieldGrids, field_grids, lens_of_point
from .pupil_weights import PupilWeights


@dataclass(frozen=True)
class SampledField:
    r"""A complex field on a square grid in a plane of the camera.

    Attributes
    ----------
    samples : complex64 array (rows, columns)
        Scaled so that the sum of squared moduli times the squared pitch is the fraction of the power through
        the pupil. Without the carrier :math:`\exp(i k d)` of the path from the main lens.
    origin : (float, float)
        Camera-frame x and y of the first sample, in millimetres.
    pitch : float
        Distance between samples in millimetres.
    """

    samples: Field
    origin: tuple[float, float]
    pitch: float

    @property
    def power(self) -> float:
        """Fraction of the power through the pupil that is on the grid."""
        return float(np.sum(np.abs(self.samples) ** 2, dtype=np.float64)) * self.pitch**2


@dataclass(frozen=True)
class PointFields:
    """Fields of one scene point in the planes of the camera: behind the pupil, before the MLA, on the detector."""

    pupil: SampledField
    mla: SampledField
    detector: SampledField


def full_field(
    camera: PlenopticCamera,
    position: NDArray[np.float64],
    wavelength: float,
    *,
    pupil_weights: PupilWeights | None = None,
    microlenses: bool = True,
    refinement: float = 1.0,
    growth: float = 1.0,
    grids: FieldGrids | None = None,
) -> NDArray[np.float32]:
    """Integrate one scene point's intensity over the recorded pixels.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    position : float64 array (3,)
        Scene point (X, Y, g) in the camera frame, checked.
    wavelength : float
        Wavelength in nanometres, checked.
    pupil_weights : PupilWeights, optional
        Relative power over the pupil, of this one point.
    microlenses : bool
        Whether the microlenses are there.
    refinement, growth : float
        Factors on the sampling density and on the window's margins, to test convergence.
    grids : FieldGrids, optional
        Those of a camera that hardly differs, by which differences between the two are free of their grids'.

    Returns
    -------
    float32 array (rows, columns)
        Fractions of the power through the pupil.

    Raises
    ------
    InputError
        If the grids would need too much memory.
    """
    grids = grids or field_grids(camera, position, wavelength, refinement, growth)
    pupil = _pupil_field(camera, position, wavelength, grids, pupil_weights)
    mla = _at_mla(camera, wavelength, grids, pupil)
    del pupil
    spectrum = _detector_spectrum(camera, wavelength, grids, mla.samples, microlenses)
    del mla
    dr.flush_malloc_cache()
    return backend().to_host(_pixel_integrals(camera, spectrum, grids))


def point_fields(
    camera: PlenopticCamera, position: NDArray[np.float64], wavelength: float, *, microlenses: bool = True
) -> PointFields:
    """Propagate one scene point's field, as `full_field` does, and keep it at every plane.

    Raises
    ------
    InputError
        If the grids would need too much memory.
    """
    grids = field_grids(camera, position, wavelength, 1.0, 1.0)
    pupil = _pupil_field(camera, position, wavelength, grids)
    mla = _at_mla(camera, wavelength, grids, pupil)
    spectrum = _detector_spectrum(camera, wavelength, grids, mla.samples.copy(), microlenses)
    with resting_drjit():
        detector = fft2(spectrum, inverse=True)
    planes = (pupil, mla, SampledField(detector, mla.origin, mla.pitch))
    return PointFields(*(SampledField(backend().to_host(p.samples), p.origin, p.pitch) for p in planes))


def _pupil_field(
    camera: PlenopticCamera,
    position: NDArray[np.float64],
    wavelength: float,
    grids: FieldGrids,
    weights: PupilWeights | None = None,
) -> SampledField:
    types = backend().types
    count = grids.wide_pupil
    pitch = grids.pitch * grids.wide_mla / count
    index = dr.arange(types.UInt32, count * count)
    row = quotient(types, index, count)
    column = index - row * dr.opaque(types.UInt32, count)
    step = dr.opaque(types.Float64, pitch)
    Px = types.Float64(column) * step + dr.opaque(types.Float64, grids.wide_origin[0])
    Py = types.Float64(row) * step + dr.opaque(types.Float64, grids.wide_origin[1])
    X, Y, g = (dr.opaque(types.Float64, float(coordinate)) for coordinate in position)
    lens, pupil, point = lens_of_point(camera, position, wavelength), (Px, Py), (X, Y, g)
    # The edge is softened over one sample, so that it is round; the power is that of the hard edge.
    cover = types.Float(soft_edge(lens.inside(pupil) / step))
    bright = types.Float(lens.amplitude(pupil, point))
    density = types.Float64(bright * bright * cover)
    if weights is not None:
        passed, amplitude = weights.at(dr.zeros(types.UInt32, count * count), Px, Py, lens.pupil_radius, step)
        density *= types.Float64(passed)
        cover *= amplitude
    power = dr.sum(density)[0] * pitch**2
    if not 0 < power < math.inf:
        raise InputError(
            f"aperture_radius = {camera.aperture_radius:g}: no light passes it on a grid of samples {pitch:g} apart"
        )
    field = phasor(lens.path(pupil, point, wavelength)) * (bright * cover / math.sqrt(power))
    return SampledField(as_field(pack(field), (count, count)), grids.wide_origin, pitch)


def _at_mla(camera: PlenopticCamera, wavelength: float, grids: FieldGrids, pupil: SampledField) -> SampledField:
    """Propagate to the MLA, onto the finer grid there, and keep the detector's window."""
    with resting_drjit():
        spectrum = fft2(pupil.samples.copy())
    guards.judge(guards.UNDERSAMPLED, band_edge_fraction(spectrum))
    spectrum = advance(spectrum, pupil.pitch, camera.pupil_distance, wavelength)
    (left, top), (columns, rows) = grids.offset, grids.count
    arrays = backend().arrays
    samples = arrays.empty((rows, columns), np.complex64)
    with resting_drjit():
        # axis by axis, so that rows and columns outside the spectrum and the window are never transformed
        partial = arrays.empty((rows, spectrum.shape[1]), np.complex64)
        width, in_rim = rim(grids.wide_mla), 0.0
        for block in _blocks(spectrum.shape[1]):
            tall = _interpolate(spectrum[:, block], grids.wide_mla, axis=0)
            partial[:, block] = tall[top : top + rows]
            in_rim += power(tall[:width]) + power(tall[-width:])
        for block in _blocks(rows):
            wide = _interpolate(partial[block], grids.wide_mla, axis=1)
            samples[block] = wide[:, left : left + columns]
    guards.judge_window(fraction(in_rim, power(spectrum) * grids.wide_mla / spectrum.shape[0] ** 2))
    origin = (grids.wide_origin[0] + left * grids.pitch, grids.wide_origin[1] + top * grids.pitch)
    return SampledField(samples, origin, grids.pitch)


def _detector_spectrum(
    camera: PlenopticCamera, wavelength: float, grids: FieldGrids, samples: Field, microlenses: bool
) -> Field:
    """Spectrum on the detector of the field that reaches the MLA, whose memory is used."""
    if microlenses:
        before = _passed_power(camera, wavelength, grids, samples)
        if is_separable(camera):
            along_x, along_y = _microlens_factors(camera, wavelength, grids)
            samples *= along_x[None, :]
            samples *= along_y[:, None]
        else:
            _apply_plane(camera, wavelength, grids, samples)
        if before > 0:
            guards.judge(guards.MICROLENS, 1 - power(samples) / before)
    with resting_drjit():
        spectrum = fft2(samples)
    return advance(spectrum, grids.pitch, camera.detector_distance, wavelength)


def _blocks(count: int) -> Iterator[slice]:
    """Cut a range into slices, so that what is made of each stays small."""
    for start in range(0, count, BLOCK):
        yield slice(start, min(count, start + BLOCK))


def _interpolate(spectrum: Field, count: int, axis: int) -> Field:
    """Transform a spectrum back along one axis onto `count` samples of the same window: zero-padded."""
    size = spectrum.shape[axis]
    shape = list(spectrum.shape)
    shape[axis] = count
    arrays = backend().arrays
    padded = arrays.zeros(shape, np.complex64)
    source, target = arrays.moveaxis(spectrum, axis, 0), arrays.moveaxis(padded, axis, 0)
    positive = (size + 1) // 2
    target[:positive] = source[:positive]
    target[count - (size - positive) :] = source[positive:]
    padded *= np.float32(count / size)
    return fft(padded, axis=axis, inverse=True)


def _microlens_factors(camera: PlenopticCamera, wavelength: float, grids: FieldGrids) -> list[Field]:
    """Return the transmission of the microlenses along x and along y; the whole is their product."""
    types, lenses = backend().types, axis_transmission(camera, wavelength, grids.bend)
    factors = []
    for axis, (start, offset, count) in enumerate(zip(grids.wide_origin, grids.offset, grids.count, strict=True)):
        place = types.Float64(dr.arange(types.UInt32, count)) * grids.pitch + (start + offset * grids.pitch)
        factors.append(as_field(pack(lenses.along(place, axis)), (count,)))
    return factors


def _apply_plane(camera: PlenopticCamera, wavelength: float, grids: FieldGrids, samples: Field) -> None:
    """Multiply a field by the transmission of microlenses that are no product of two axes."""
    lenses = plane_transmission(camera, wavelength, grids.bend)
    for block, x, y in _places(grids):
        samples[block] *= as_field(pack(lenses.at(x, y)), samples[block].shape)


def _passed_power(camera: PlenopticCamera, wavelength: float, grids: FieldGrids, samples: Field) -> float:
    """Return the power, in units of a sample, of the part of a field that is within the microlenses' apertures."""
    if camera.lattice.fills:
        return power(samples)
    total, cosine = 0.0, in_millimetres(wavelength) / (2 * grids.pitch)
    for block, x, y in _places(grids):
        passed = backend().from_drjit(open_fraction(camera, wavelength, cosine, x, y))
        intensity = backend().arrays.abs(samples[block]).reshape(-1) ** 2
        total += float((intensity * passed).sum(dtype=np.float64))
    return total


def _places(grids: FieldGrids) -> Iterator[tuple[slice, Any, Any]]:
    """Yield blocks of rows of the detector's window, with x and y of their samples."""
    types = backend().types
    left, top = (start + offset * grids.pitch for start, offset in zip(grids.wide_origin, grids.offset, strict=True))
    columns = grids.count[0]
    for block in _blocks(grids.count[1]):
        index = dr.arange(types.UInt32, (block.stop - block.start) * columns)
        row = quotient(types, index, columns)
        x = types.Float64(index - row * columns) * grids.pitch + dr.opaque(types.Float64, left)
        y = types.Float64(row) * grids.pitch + dr.opaque(types.Float64, top + block.start * grids.pitch)
        yield block, x, y


def _pixel_integrals(camera: PlenopticCamera, spectrum: Field, grids: FieldGrids) -> NDArray[np.float32]:
    """Integrate the intensity over the recorded pixels, exactly for the band-limited field."""
    arrays = backend().arrays
    height, width = camera.shape
    with resting_drjit():
        partial = _interpolate(spectrum, 2 * spectrum.shape[0], axis=0)
        rows = arrays.empty((partial.shape[0], width), np.float32)
        for block in _blocks(partial.shape[0]):
            parts = _interpolate(partial[block], 2 * partial.shape[1], axis=1).view(np.float32)
            arrays.multiply(parts, parts, out=parts)
            rows[block] = _along_pixels(parts[:, 0::2] + parts[:, 1::2], grids, width)
        del partial
        psf = arrays.empty((height, width), np.float32)
        for block in _blocks(width):
            psf[:, block] = _along_pixels(arrays.ascontiguousarray(rows[:, block].T), grids, height).T
    return psf


def _along_pixels(intensity: NDArray[np.float32], grids: FieldGrids, count: int) -> NDArray[np.float32]:
    """Integrate rows of the doubled grid over the recorded pixels, by their spectrum times the pixel's sinc."""
    size, per_pixel = intensity.shape[1], 2 * grids.per_pixel
    spectrum = rfft(intensity, axis=1)
    pixel = np.sinc(np.fft.rfftfreq(size) * per_pixel) * per_pixel * grids.pitch / 2
    spectrum *= backend().arrays.asarray(pixel.astype(np.float32))
    integrals = irfft(spectrum, size, axis=1)
    first = grids.margin * per_pixel + grids.per_pixel
    return integrals[:, first::per_pixel][:, :count]
