r"""Sampled scalar fields: phase factors, softened edges, power, and free-space propagation by the angular spectrum.

In free space every plane wave of a field, of transverse wave vector :math:`(k_x, k_y)`, advances by the phase
:math:`k_z d` with :math:`k_z = (k^2 - k_x^2 - k_y^2)^{1/2}`: an exact solution of the scalar wave equation
(Goodman, "Introduction to Fourier Optics", section 3.10), without the paraxial approximation. The carrier
:math:`\exp(i k d)`, the same for the whole field, is omitted, and evanescent waves are set to zero.

The field is periodic: light that leaves the window on one side re-enters it on the other. The caller chooses a window
that is wide enough.
"""

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ..errors import refuse_if, require_number, require_wavelength
from ..runtime import (
    Array,
    Doubles,
    Field,
    Pair,
    Shape,
    Sizes,
    active_backend,
    array_module,
    backend_of,
    drjit_array,
    fft,
    one_at_a_time,
)
from . import guards

_MM_PER_NM = 1e-6


def in_millimetres(wavelength: float) -> float:
    """Return a wavelength in millimetres, from nanometres."""
    return wavelength * _MM_PER_NM


def phasor(waves: Any) -> Any:
    r"""Return :math:`\exp(2 \pi i w)` for path differences in waves.

    Paths may be 10^6 waves long, which single precision cannot represent to a fraction. Whole waves are therefore
    removed in double precision; sine and cosine of the remainder are computed in single precision, with an error of
    3e-7 rad at any distance.
    """
    if not dr.is_array_v(waves):
        return np.exp(2j * math.pi * waves).astype(np.complex64)
    types = fft.array_types(waves)
    sine, cosine = dr.sincos(types.Float(waves - dr.round(waves)) * (2 * math.pi))
    return types.Complex2f(cosine, sine)


def parabola(square: Any, focal_length: Any, wavelength: float) -> Any:
    r"""Return the path difference of a thin parabolic lens in waves, :math:`-r^2 / 2 \lambda f`.

    Goodman, "Introduction to Fourier Optics", section 5.1.
    """
    return square * (-0.5 / (in_millimetres(wavelength) * focal_length))


def soft_edge(samples: Any) -> Any:
    """Return the transmission of an edge softened over one sample, at distances in samples, positive inside.

    The steep spectrum of a hard edge would be aliased into the band of the grid.
    """
    clip = dr.clip if dr.is_array_v(samples) else np.clip
    return clip(samples + 0.5, 0, 1)


def smooth_edge(samples: Any) -> Any:
    """Return the transmission of an edge softened over one sample, like `soft_edge`, but by a cubic."""
    passed = soft_edge(samples)
    return passed * passed * (3 - 2 * passed)


EDGE = 1 / 8
"""Outer fraction of a window or spectrum that should be dark; a uniform field has 23 % of its power there."""


def power(field: Field) -> float:
    """Return the sum of the squared moduli of a field."""
    return float(power_by_row(field).sum())


def rim(size: int) -> int:
    """Return the width in samples of a window's rim, on one side."""
    return max(1, round(size * EDGE / 2))


def band_edge_fraction(spectrum: Field, frequencies: Array | None = None, weight: Array | float = 1.0) -> float:
    """Fraction of a spectrum's power in the outer eighth of the frequencies; zero frequency is first.

    `spectrum` has the shape (rows, columns); `frequencies` and `weight` have one value for each row.
    """
    rows = frequencies_of(len(spectrum)) if frequencies is None else frequencies
    outer = np.abs(rows) > 1 - EDGE
    high = np.flatnonzero(np.abs(frequencies_of(spectrum.shape[1])) > 1 - EDGE)
    # The high frequencies are in the middle of the columns.
    columns = spectrum[:, int(high[0]) : int(high[-1]) + 1] if high.size else spectrum[:, :0]
    edge = weighted(weight * outer, spectrum) + weighted(weight * ~outer, columns)
    return fraction(edge, weighted(weight * np.ones(len(rows)), spectrum))


def frequencies_of(size: int) -> Array:
    """Frequencies of a transform over the grid's band limit, zero first, as float64 (size,)."""
    return np.fft.fftfreq(size) * 2


def fraction(share: float, total: float) -> float:
    """Return part / whole, or 0 if the whole is 0."""
    return float(share / total) if total > 0 else 0.0


def weighted(weight: Array, field: Field) -> float:
    """Return the sum of the power of rows, each multiplied by a weight."""
    return float((backend_of(field).arrays.asarray(weight.astype(np.float64)) * power_by_row(field)).sum())


def power_by_row(field: Field) -> Doubles:
    """Return the sum of squared moduli of each row, computed on the field's device."""
    arrays = backend_of(field).arrays
    # CuPy's transforms along the first axis leave columns contiguous, and not rows.
    rows = field if field.strides[-1] == field.itemsize else arrays.ascontiguousarray(field)
    parts = rows.view(np.float32)
    return arrays.einsum("ij,ij->i", parts, parts).astype(np.float64)


class StepGuard:
    """Checks of one propagation step, made on the field before it, on the spectrum, and on the field after it.

    About 32 rows of each large array are checked, in about a hundredth of the step's time. If these rows do not contain
    their share of the power, because the power is concentrated in few rows, all rows of the spectrum are checked.

    `pitch` is the distance between samples in millimetres.
    """

    def __init__(self, field: Field, pitch: float, wavelength: float):
        self._shape = field.shape
        self._cosine = in_millimetres(wavelength) / (2 * pitch)
        self._step = _row_step(field)
        self._power, self._rim = self._of_field(field)
        self._band_edge = self._evanescent = 0.0
        self._representative = True

    def see_spectrum(self, packed: Any) -> None:
        """Check the spectrum, zero frequency first, given as 64-bit words."""
        count = self._shape[0]
        # all of the lowest frequencies, which contain most of the power of a smooth field
        order = np.rint(np.fft.fftfreq(count) * count).astype(int)
        chosen = np.flatnonzero((np.abs(order) <= self._step) | (np.arange(count) % self._step == 0))
        weight = np.where(np.abs(order[chosen]) <= self._step, 1, self._step)
        waves = _packed_rows(packed, self._shape, chosen)
        power = weighted(weight, waves) / math.prod(self._shape)
        # Relative error of the power in those rows beyond which all rows are checked.
        self._representative = abs(fraction(power, self._power) - 1) < 0.01
        if not self._representative:
            chosen = np.arange(count)
            weight = np.ones(count)
            waves = _packed_rows(packed, self._shape, None)
        rows, columns = (frequencies_of(size) for size in self._shape)
        rows = rows[chosen]
        self._band_edge = band_edge_fraction(waves, rows, weight)
        if self._cosine**2 * 2 > 1:
            lost = backend_of(waves).arrays.asarray(self._cosine**2 * (rows[:, None] ** 2 + columns**2) >= 1)
            self._evanescent = fraction(weighted(weight, waves * lost), weighted(weight, waves))

    def see_result(self, field: Field) -> None:
        """Check the field after the step, and report all findings."""
        after, rim = self._of_field(field)
        with guards.watch():
            guards.check(guards.EVANESCENT, self._evanescent)
            guards.check(guards.UNDERSAMPLED, self._band_edge)
            # if the rows do not represent the field, its power in the rim before the step is unknown
            guards.check_window(fraction(rim, after), fraction(self._rim, self._power) if self._representative else 1.0)

    def _of_field(self, field: Field) -> Pair:
        """Total power, and power in the rim of the window."""
        rows = field[:: _row_step(field)]
        high, wide = (rim(size) for size in field.shape)
        position = np.arange(len(rows)) * self._step
        outer = (position < high) | (position >= len(field) - high)
        sides = sum(weighted(~outer, side) for side in (rows[:, :wide], rows[:, -wide:]))
        return self._step * power(rows), self._step * (weighted(outer, rows) + sides)


def _row_step(field: Field) -> int:
    # odd, so that the rows do not align with structures that repeat by powers of two
    # Of large fields some 32 rows are checked.
    return len(field) // 32 | 1 if field.size > 2**18 else 1


def _packed_rows(packed: Any, shape: Sizes, chosen: Array | None) -> Field:
    """Return some or all rows of a field that is stored as 64-bit words."""
    field = fft.as_field(packed, shape)
    return field if chosen is None else field[backend_of(field).arrays.asarray(chosen)]


@one_at_a_time
def propagate(field: Any, pitch: float, distance: float, wavelength: float, *, overwrite: bool = False) -> Field:
    r"""Return a field propagated from one plane to a parallel one.

    .. math:: U_d = F^{-1}\left[\exp\left(i (k_z - k) d\right) F[U_0]\right]

    The carrier :math:`\exp(i k d)` is omitted. The result is on the device of `field`.

    Parameters
    ----------
    field : array
        Complex samples, (rows, columns).
    pitch : float
        Distance of samples in millimetres.
    distance : float
        Distance of the planes in millimetres; a negative one propagates back.
    wavelength : float
        Wavelength in nanometres.
    overwrite : bool
        Whether the result reuses the memory of the field.

    Raises
    ------
    PhysicsError
        If the field is under-sampled or leaves its window; see `guards`.
    """
    libraries = active_backend()
    on_device = libraries.is_cuda and isinstance(field, libraries.arrays.ndarray)
    source = (libraries.arrays if on_device else np).asarray(field, np.complex64, order="C")
    refuse_if(source.ndim != 2 or source.size == 0, f"field of shape {source.shape}: it must have rows and columns")
    samples = source if overwrite else backend_of(source).empty(source.shape, np.complex64)
    if not overwrite:
        samples[...] = source
    pitch = require_number("pitch", pitch, positive=True)
    distance = require_number("distance", distance)
    wavelength = require_wavelength(wavelength)
    shape = samples.shape
    guard = StepGuard(samples, pitch, wavelength)
    packed = fft.fft2_packed(drjit_array(libraries.types.UInt64, fft.as_words(samples)), shape)
    guard.see_spectrum(packed)
    packed = _advance(packed, shape, pitch, distance, wavelength)
    result = fft.as_field(fft.fft2_packed(packed, shape, inverse=True), shape)
    result = result if on_device else libraries.to_host(result)
    # Every sample of a transform depends on all others: a single sample that is not finite makes them all so.
    refuse_if(not np.isfinite(complex(result[0, 0])), "field: its samples must be finite")
    guard.see_result(result)
    return result


def advance(
    spectrum: Field,
    pitch: float | Pair,
    distance: float,
    wavelength: float,
    *,
    shift: Pair,
    part: Shape | None,
    paraxial: bool,
    beyond_paraxial: bool,
    response: Callable[[Any, Any], Any] | None,
) -> Field:
    r"""Return a field's spectrum multiplied by free space's transfer function :math:`\exp(i (k_z - k) d)`.

    The spectrum has zero frequency first. `shift` is the displacement (down, across) of the new samples from the old
    ones, in millimetres. `part` describes a block of rows: the index of its first row, and the number of rows of the
    whole spectrum. `paraxial` and `beyond_paraxial` are as in `transfer`. `response` is an amplitude of plane waves, a
    function of their direction cosines across and down.
    """
    packed = drjit_array(array_module().UInt64, fft.as_words(spectrum))
    how = {"shift": shift, "paraxial": paraxial, "beyond_paraxial": beyond_paraxial}
    packed = _advance(packed, spectrum.shape, pitch, distance, wavelength, part, response, **how)
    return fft.as_field(packed, spectrum.shape)


def _advance(
    packed: Any,
    shape: Sizes,
    pitch: float | Pair,
    distance: float,
    wavelength: float,
    part: Shape | None = None,
    response: Callable[[Any, Any], Any] | None = None,
    **how: Any,
) -> Any:
    """Multiply a packed spectrum, zero frequency first, by the transfer function of free space; see `transfer`."""
    types = fft.array_types(packed)
    rows, columns = shape
    row, column = fft.rows_and_columns(types, rows, columns)
    down, across = pitch if isinstance(pitch, tuple) else (pitch, pitch)
    sx = direction_cosine(types, column, columns, across, wavelength)
    first, all_rows = part or (0, rows)
    row += dr.opaque(types.UInt32, first)
    sy = direction_cosine(types, row, all_rows, down, wavelength)
    factor = transfer(sx, sy, distance, wavelength, **how)
    light = fft.unpack(packed) * (factor if response is None else factor * response(sx, sy))
    # The frequency of half a period a sample stands for both of its signs: kept with one, light would go to one side.
    half = [2 * index == dr.opaque(types.UInt32, count) for index, count in ((column, columns), (row, all_rows))]
    return fft.pack(dr.select(half[0] | half[1], 0, light))


def transfer(
    sx: Any,
    sy: Any,
    distance: float,
    wavelength: float,
    *,
    shift: Pair = (0.0, 0.0),
    paraxial: bool = False,
    beyond_paraxial: bool = False,
) -> Any:
    r"""Return the transfer function of free space, :math:`\exp(i (k_z - k) d)`, zero for evanescent waves.

    The `paraxial` transfer function is Fresnel's, :math:`\exp(-i k s^2 d / 2)`: light of the frequency :math:`s /
    \lambda` moves sideways by s d, as a ray of the slope s does (Goodman, "Introduction to Fourier Optics", section
    4.2.3). With `beyond_paraxial`, the ratio of the exact function to Fresnel's is returned.
    """
    types = fft.array_types(sx)

    def in_waves(length: Any) -> Any:
        waves = length / in_millimetres(wavelength)
        return waves if dr.is_array_v(waves) else dr.opaque(types.Float64, waves)

    square = sx * sx + sy * sy
    if paraxial:
        waves = in_waves(distance) * (-0.5 * square)
    else:
        # The derivative of the square root does not exist at 0.
        waves = in_waves(distance) * (dr.sqrt(dr.select(square < 1, 1 - square, 1)) - 1)
    if beyond_paraxial:
        waves = waves + in_waves(distance) * (0.5 * square)
    if any(shift):
        waves = waves + sy * in_waves(shift[0]) + sx * in_waves(shift[1])
    return phasor(waves) if paraxial else dr.select(square < 1, phasor(waves), 0)


def direction_cosine(types: Any, index: Any, count: int, pitch: float, wavelength: float) -> Any:
    """Return the direction cosine of a plane wave, from its index in a spectrum with zero frequency first."""
    position = types.Int32(index)
    size = dr.opaque(types.Int32, count)
    order = dr.select(2 * position < size, position, position - size)
    return types.Float64(order) * dr.opaque(types.Float64, in_millimetres(wavelength) / (count * pitch))
