r"""The field of one scene point behind a microscope's objective: on its stop, and on the microlens array.

Behind the tube lens a place P on the stop is a direction :math:`s = -P / f_T`, so that the field in the native image
plane is an inverse Fourier transform of that on the stop,

.. math:: U(m) = \frac{1}{\lambda} \int A(s) \exp(i k s \cdot m) \, d^2s,

which holds :math:`\int |U|^2 d^2m = \int |A|^2 d^2s` (Goodman, "Introduction to Fourier Optics", section 5.2: a lens
between its two focal planes). In the Fourier arrangement the array stands where a further lens forms the image of the
stop, and the field there is A itself at :math:`s = m / f_F`.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..optics import guards
from ..optics.phase import in_millimetres, phasor, soft_edge
from ..optics.power import band_edge_fraction
from ..optics.telecentric import TelecentricLens
from ..runtime.backend import backend
from ..runtime.fft import as_field, pack
from ..runtime.indexing import rows_and_columns
from .arrival import SampledField, onto_window
from .full_field_grids import FieldGrids
from .pupil_weights import PupilWeights


def telecentric_arrival(
    lens: TelecentricLens,
    position: NDArray[np.float64],
    wavelength: float,
    grids: FieldGrids,
    weights: PupilWeights | None = None,
) -> tuple[SampledField, SampledField]:
    """Return the field on the stop, and that on the array just before the microlenses.

    Parameters
    ----------
    lens : TelecentricLens
        The objective.
    position : float64 array (3,)
        Scene point in the camera frame.
    wavelength : float
        Wavelength in nanometres.
    grids : FieldGrids
        Sizes and places of the grids.
    weights : PupilWeights, optional
        Relative power over the stop, of this one point.

    Returns
    -------
    stop, mla : SampledField
        Both have the power 1, but for what misses the detector's window.
    """
    if lens.objective.is_fourier:
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
