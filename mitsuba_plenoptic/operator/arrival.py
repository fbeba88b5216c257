"""The field of one scene point on its way to the MLA: behind the exit pupil, and just before the microlenses."""

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
from ..lenses.telecentric import TelecentricLens
from ..optics import guards
from ..optics.free_space import advance
from ..optics.phase import in_millimetres, phasor, soft_edge
from ..optics.power import band_edge_fraction, fraction, power, rim
from ..runtime.backend import backend
from ..runtime.fft import Field, as_field, fft, fft2, pack, resting_drjit, rows_and_columns
from ..system.optical_system import OpticalSystem
from .full_field_grids import BLOCK, FieldGrids
from .pupil_weights import PupilWeights


@dataclass(frozen=True)
class SampledField:
    r"""A complex field on a square grid in a plane of the camera."""

    # Scaled so that the sum of squared moduli times the squared pitch is the fraction of the power through the pupil.
    # Without the carrier :math:`\exp(i k d)` of the path from the main lens; (rows, columns).
    samples: Field
    # Camera-frame x and y of the first sample, in millimetres.
    origin: tuple[float, float]
    # Distance between samples in millimetres.
    pitch: float

    @property
    def power(self) -> float:
        """Fraction of the power through the pupil that is on the grid."""
        return float(np.sum(np.abs(self.samples) ** 2, dtype=np.float64)) * self.pitch**2


def pupil_field(
    system: OpticalSystem,
    position: NDArray[np.float64],
    grids: FieldGrids,
    weights: PupilWeights | None = None,
) -> SampledField:
    """Return the field of a scene point behind the exit pupil; parameters as of `full_field`."""
    types = backend().types
    count = grids.wide_pupil
    pitch = grids.pitch * grids.wide_mla / count
    row, column = rows_and_columns(types, count, count)
    step = dr.opaque(types.Float64, pitch)
    Px = types.Float64(column) * step + dr.opaque(types.Float64, grids.wide_origin[0])
    Py = types.Float64(row) * step + dr.opaque(types.Float64, grids.wide_origin[1])
    X, Y, g = (dr.opaque(types.Float64, float(coordinate)) for coordinate in position)
    lens, pupil, point = system.waves_of_one(position), (Px, Py), (X, Y, g)
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
            f"aperture_radius = {system.camera.aperture_radius:g}: no light passes it on a grid of samples "
            f"{pitch:g} apart"
        )
    field = phasor(lens.path(pupil, point, system.wavelength)) * (bright * cover / math.sqrt(power))
    return SampledField(as_field(pack(field), (count, count)), grids.wide_origin, pitch)


def at_mla(camera: PlenopticCamera, wavelength: float, grids: FieldGrids, pupil: SampledField) -> SampledField:
    """Propagate a field to the MLA, onto the finer grid there, and keep the detector's window."""
    with resting_drjit():
        spectrum = fft2(pupil.samples.copy())
    guards.judge(guards.UNDERSAMPLED, band_edge_fraction(spectrum))
    spectrum = advance(spectrum, pupil.pitch, camera.pupil_distance, wavelength)
    return onto_window(spectrum, grids)


def onto_window(spectrum: Field, grids: FieldGrids) -> SampledField:
    """Transform the spectrum of a field at the MLA onto the finer grid there, and keep the detector's window."""
    (left, top), (columns, rows) = grids.offset, grids.count
    arrays = backend().arrays
    samples = arrays.empty((rows, columns), np.complex64)
    with resting_drjit():
        # axis by axis, so that rows and columns outside the spectrum and the window are never transformed
        partial = arrays.empty((rows, spectrum.shape[1]), np.complex64)
        width, in_rim = rim(grids.wide_mla), 0.0
        for block in blocks(spectrum.shape[1]):
            tall = interpolate(spectrum[:, block], grids.wide_mla, axis=0)
            partial[:, block] = tall[top : top + rows]
            in_rim += power(tall[:width]) + power(tall[-width:])
        for block in blocks(rows):
            wide = interpolate(partial[block], grids.wide_mla, axis=1)
            samples[block] = wide[:, left : left + columns]
    guards.judge_window(fraction(in_rim, power(spectrum) * grids.wide_mla / spectrum.shape[0] ** 2))
    origin = (grids.wide_origin[0] + left * grids.pitch, grids.wide_origin[1] + top * grids.pitch)
    return SampledField(samples, origin, grids.pitch)


def blocks(count: int) -> Iterator[slice]:
    """Cut a range into slices, so that what is made of each stays small."""
    for start in range(0, count, BLOCK):
        yield slice(start, min(count, start + BLOCK))


def interpolate(spectrum: Field, count: int, axis: int) -> Field:
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


def telecentric_arrival(
    lens: TelecentricLens,
    position: NDArray[np.float64],
    wavelength: float,
    grids: FieldGrids,
    weights: PupilWeights | None = None,
) -> tuple[SampledField, SampledField]:
    """Return the field on the stop, and that on the array just before the microlenses.

    `position` is that of a scene point, (3,). Both have the power 1, except for what misses the detector's window.
    """
    if lens.objective.images_stop:
        return _at_stop_image(lens, position, wavelength, grids, weights)
    return _at_native_image(lens, position, wavelength, grids, weights)


def _at_native_image(
    lens: TelecentricLens,
    position: NDArray[np.float64],
    wavelength: float,
    grids: FieldGrids,
    weights: PupilWeights | None,
) -> tuple[SampledField, SampledField]:
    types, count = backend().types, grids.wide_pupil
    pitch = grids.pitch * grids.wide_mla / count
    step = in_millimetres(wavelength) / (count * pitch)
    numbers = []
    row, column = rows_and_columns(types, count, count)
    for place in (column, row):
        # Zero frequency first, as transforms have it.
        number = types.Float64(place)
        numbers.append(dr.select(number < (count + 1) // 2, number, number - count))
    reach = lens.pupil_distance * step
    pupil = -numbers[0] * dr.opaque(types.Float64, reach), -numbers[1] * dr.opaque(types.Float64, reach)
    field = _stop_field(lens, position, wavelength, pupil, reach, weights)
    # The grid's first sample is at its corner.
    to_corner = [dr.opaque(types.Float64, start / (count * pitch)) for start in grids.wide_origin]
    spectrum = field * phasor(numbers[0] * to_corner[0] + numbers[1] * to_corner[1])
    # The field on the stop is a density over places; over directions it is larger by the focal length.
    scale = lens.pupil_distance * in_millimetres(wavelength) / pitch**2
    shape = count, count
    packed = as_field(pack(spectrum * types.Float(scale)), shape)
    guards.judge(guards.UNDERSAMPLED, band_edge_fraction(packed))
    mla = onto_window(packed, grids)
    stop = backend().arrays.fft.fftshift(as_field(pack(field), shape))[::-1, ::-1]
    half = (count - 1) // 2
    return SampledField(stop, (-half * reach, -half * reach), reach), mla


def _at_stop_image(
    lens: TelecentricLens,
    position: NDArray[np.float64],
    wavelength: float,
    grids: FieldGrids,
    weights: PupilWeights | None,
) -> tuple[SampledField, SampledField]:
    types, (columns, rows) = backend().types, grids.count
    growth = -lens.pupil_distance / lens.objective.last_focal_length
    origin = tuple(start + offset * grids.pitch for start, offset in zip(grids.wide_origin, grids.offset, strict=True))
    row, column = rows_and_columns(types, rows, columns)
    pupil = tuple(
        (types.Float64(number) * dr.opaque(types.Float64, grids.pitch) + dr.opaque(types.Float64, start)) * growth
        for number, start in zip((column, row), origin, strict=True)
    )
    sample = grids.pitch * abs(growth)
    field = as_field(pack(_stop_field(lens, position, wavelength, pupil, sample, weights)), (rows, columns))
    mla = SampledField(field * np.float32(abs(growth)), (origin[0], origin[1]), grids.pitch)
    stop = SampledField(
        field[::-1, ::-1],
        (origin[0] * growth - (columns - 1) * sample, origin[1] * growth - (rows - 1) * sample),
        sample,
    )
    return stop, mla


def _stop_field(
    lens: TelecentricLens,
    position: NDArray[np.float64],
    wavelength: float,
    pupil: tuple[Any, Any],
    sample: float,
    weights: PupilWeights | None,
) -> Any:
    """Return the field at places on the stop, of the power 1, softened over a sample at the edge."""
    types = backend().types
    point = tuple(dr.opaque(types.Float64, float(coordinate)) for coordinate in position)
    cover = types.Float(soft_edge(lens.inside(pupil) / sample))
    amplitude = types.Float(lens.amplitude(pupil, point))
    power = lens.passed_power
    if weights is not None:
        count = dr.width(pupil[0])
        passed, relative = weights.at(dr.zeros(types.UInt32, count), *pupil, lens.pupil_radius, sample)
        power = float(dr.sum(types.Float64(amplitude * amplitude * cover * passed))[0]) * sample**2
        cover *= relative
    return phasor(lens.path(pupil, point, wavelength)) * (amplitude * cover / math.sqrt(power))
