r"""Free-space propagation of a sampled scalar field by its angular spectrum.

Every plane wave of the field, of transverse wave vector :math:`(k_x, k_y)`, advances by the phase
:math:`k_z d` with :math:`k_z = (k^2 - k_x^2 - k_y^2)^{1/2}`: an exact solution of the scalar wave equation
(Goodman, "Introduction to Fourier Optics", section 3.10), without a paraxial step. The carrier
:math:`\exp(i k d)`, the same for the whole field, is left out; evanescent waves are cut.

The field is periodic: what leaves the window on one side comes back in on the other. Callers choose
the window.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..bounds import require_wavelength
from ..errors import InputError, require_number
from ..runtime.backend import array_module, backend, one_at_a_time
from ..runtime.fft import Field, array_types, as_field, as_words, fft2_packed, pack, unpack
from ..runtime.indexing import rows_and_columns
from .phase import in_millimetres, phasor
from .step_guard import StepGuard


@one_at_a_time
def propagate(field: Any, pitch: float, distance: float, wavelength: float, *, overwrite: bool = False) -> Field:
    r"""Propagate a field from one plane to a parallel one.

    .. math:: U_d = F^{-1}\left[\exp\left(i (k_z - k) d\right) F[U_0]\right]

    Parameters
    ----------
    field : complex array (rows, columns)
        Samples of the field, taken as ``complex64``.
    pitch : float
        Distance between samples, along both axes, in millimetres.
    distance : float
        Distance to the new plane in millimetres; negative to go back.
    wavelength : float
        Wavelength in nanometres.
    overwrite : bool
        Whether the memory of `field` may be used for the work.

    Returns
    -------
    complex64 array (rows, columns)
        The field in the new plane, without the carrier :math:`\exp(i k d)`; where `field` is: with a CUDA variant a
        CuPy array never leaves the device.

    Raises
    ------
    InputError
        If the field is not a two-dimensional finite array, or a number is out of range.
    PhysicsError
        If the field is under-sampled, or leaves its window (see `guards`, which warn long before that).
    """
    libraries = backend()
    on_device = libraries.is_cuda and isinstance(field, libraries.arrays.ndarray)
    arrays = libraries.arrays if on_device else np
    samples = arrays.array(field, np.complex64, order="C", copy=None if overwrite else True)
    if samples.ndim != 2 or samples.size == 0:
        raise InputError(f"field of shape {samples.shape}: it must have rows and columns")
    pitch, distance, wavelength = _check(pitch, distance, wavelength)
    shape, guard = samples.shape, StepGuard(samples, pitch, wavelength)
    packed = fft2_packed(libraries.types.UInt64(as_words(samples)), shape)
    guard.see_spectrum(packed)
    packed = _advance(packed, shape, pitch, distance, wavelength)
    result = as_field(fft2_packed(packed, shape, inverse=True), shape)
    result = result if on_device else libraries.to_host(result)
    # Every sample of a transform depends on every other: one that is not finite leaves none that is.
    if not np.isfinite(complex(result[0, 0])):
        raise InputError("field: its samples must be finite")
    guard.see_result(result)
    return result


def advance(
    spectrum: Field,
    pitch: float | tuple[float, float],
    distance: float,
    wavelength: float,
    *,
    shift: tuple[float, float] = (0.0, 0.0),
    part: tuple[int, int] | None = None,
) -> Field:
    r"""Multiply the spectrum of a field by the transfer function :math:`\exp(i (k_z - k) d)` of free space.

    Parameters
    ----------
    spectrum : complex64 array (rows, columns)
        Zero frequency first.
    pitch : float or (float, float)
        Sampling distance of the field, or those down and across, in millimetres.
    distance : float
        Distance to the new plane in millimetres.
    wavelength : float
        Wavelength in nanometres.
    shift : (float, float)
        How far down and across the new plane's samples lie from the old one's, in millimetres.
    part : (int, int), optional
        If the array holds some rows of the spectrum only: the number of the first, and how many there are in all.

    Returns
    -------
    complex64 array (rows, columns)
    """
    packed = array_module().UInt64(as_words(spectrum))
    packed = _advance(packed, spectrum.shape, pitch, distance, wavelength, shift, part)
    return as_field(packed, spectrum.shape)


def _advance(
    packed: Any,
    shape: tuple[int, ...],
    pitch: float | tuple[float, float],
    distance: float,
    wavelength: float,
    shift: tuple[float, float] = (0.0, 0.0),
    part: tuple[int, int] | None = None,
) -> Any:
    """Multiply a packed spectrum, zero frequency first, by the transfer function of free space."""
    types = array_types(packed)
    rows, columns = shape
    row, column = rows_and_columns(types, rows, columns)
    down, across = pitch if isinstance(pitch, tuple) else (pitch, pitch)
    sx = _cosine(types, column, columns, across, wavelength)
    first, all_rows = part or (0, rows)
    sy = _cosine(types, row + dr.opaque(types.UInt32, first), all_rows, down, wavelength)
    return pack(unpack(packed) * transfer(sx, sy, distance, wavelength, shift=shift))


def transfer(sx: Any, sy: Any, distance: float, wavelength: float, *, shift: tuple[float, float] = (0.0, 0.0)) -> Any:
    r"""Return the transfer function of free space, :math:`\exp(i (k_z - k) d)`, zero for evanescent waves.

    Parameters
    ----------
    sx, sy : float64 arrays of Dr.Jit
        Direction cosines along x and y.
    distance : float or Dr.Jit number
        Distance to the new plane in millimetres.
    wavelength : float or Dr.Jit number
        Wavelength in nanometres.
    shift : (float, float)
        How far down and across the new plane's samples lie from the old one's, in millimetres.

    Returns
    -------
    Complex2f of Dr.Jit
    """
    types = array_types(sx)

    def in_waves(length: Any) -> Any:
        waves = length / in_millimetres(wavelength)
        return waves if dr.is_array_v(waves) else dr.opaque(types.Float64, waves)

    square = sx * sx + sy * sy
    # The root of 0 has no derivative.
    waves = in_waves(distance) * (dr.sqrt(dr.select(square < 1, 1 - square, 1)) - 1)
    if any(shift):
        waves = waves + sy * in_waves(shift[0]) + sx * in_waves(shift[1])
    return dr.select(square < 1, phasor(waves), 0)


def _cosine(types: Any, index: Any, count: int, pitch: float, wavelength: float) -> Any:
    """Direction cosine of a plane wave, by its place in a spectrum with zero frequency first."""
    place, size = types.Int32(index), dr.opaque(types.Int32, count)
    order = dr.select(2 * place < size, place, place - size)
    return types.Float64(order) * dr.opaque(types.Float64, in_millimetres(wavelength) / (count * pitch))


def _check(pitch: float, distance: float, wavelength: float) -> tuple[float, float, float]:
    return (
        require_number("pitch", pitch, positive=True),
        require_number("distance", distance),
        require_wavelength(wavelength),
    )
