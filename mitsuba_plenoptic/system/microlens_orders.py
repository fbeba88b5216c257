r"""The microlens array, cut off at a highest direction: the sum of the orders into which it splits a plane wave.

The array is periodic. Where it is a product of a function of x and one of y, its orders are :math:`\lambda / D_2` apart
in direction cosine along each axis:

.. math:: t(x) = \sum_q c_q \, e^{2 \pi i q x / D_2}, \qquad
          c_q = \frac{1}{D_2} \int_\mathrm{lens} e^{-i \pi (x - c)^2 / \lambda f_2} \, e^{-2 \pi i q x / D_2} dx,

a Fresnel integral (Goodman, "Introduction to Fourier Optics", section 4.2.2, for the integrals). Every other array has,
in its own frame, a rectangular period of a few lenses (three focal lengths repeat every third lens), and its orders are
the two-dimensional Fourier transform of fine samples of that period.

Samples of t itself would fold its steep orders, which come from the edges of the lenses, back into the band of a grid;
the sum over the orders that the grid holds does not.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import scipy
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lattice import turn
from ..optics.phase import in_millimetres
from ..runtime.backend import array_module, backend_of
from ..runtime.fft import Field, array_types, as_field, pack, split, unpack, worker_count
from .microlenses import from_centre, is_separable, transmission
from .sampling import check_memory, fast_length

_FLAT = 1e4
"""Focal length, in millimetres, of a lens that is a mere hole."""

_TABLE_LENGTH = 2**14

_FINE = 2048
"""Samples across a pitch of which the orders of a period are made: its edges are known that finely."""

_PER_WAVE = 8
"""Fine samples across the finest wave that is kept, at least, so that none folds."""

_FINE_BYTES = 16
"""Memory that a fine sample takes while the orders are made."""

_PER_ORDER = 40
"""Samples of a period's table across one wave of its highest order, between which it is interpolated."""


def axis_orders(camera: PlenopticCamera, wavelength: float, count: int, axis: int) -> NDArray[np.complex128]:
    """Return the amplitudes of the orders -count ... count along one axis, in which an edge of a cell lies at 0.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, whose transmission is separable.
    wavelength : float
        Wavelength in nanometres.
    count : int
        Highest order.
    axis : int
        0: x, 1: y.

    Returns
    -------
    complex128 array (2 count + 1,)
    """
    return axis_order_derivatives(camera, wavelength, count, axis)[0]


def axis_order_derivatives(
    camera: PlenopticCamera, wavelength: float, count: int, axis: int
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
    r"""Return the amplitudes of `axis_orders`, and their derivatives by two numbers that they depend on.

    These are :math:`\lambda f_2 / D_2^2`, and the width of the aperture over the pitch.
    """
    pitch = camera.mla_pitches[axis]
    width = camera.lattice.aperture_widths[axis] / pitch
    area = in_millimetres(wavelength) * camera.mla_focal_length / pitch**2
    q = np.arange(-count, count + 1)
    shift = area * q
    scale = math.sqrt(2 / area)
    sines, cosines = scipy.special.fresnel(np.stack([shift - width / 2, shift + width / 2]) * scale)
    integral = (cosines[1] - cosines[0]) - 1j * (sines[1] - sines[0])
    centred = integral / scale * np.exp(1j * math.pi * area * q.astype(float) ** 2)
    # The integrand e at the edges, and its moments by parts: x e = i (area / 2 pi) e' - area q e.
    edges = [
        np.exp(-1j * math.pi * (side * width / 2) ** 2 / area - 1j * math.pi * q * side * width) for side in (-1, 1)
    ]
    part = 1j * area / (2 * math.pi)
    first = part * (edges[1] - edges[0]) - shift * centred
    second = part * ((edges[1] + edges[0]) * width / 2 - centred) - shift * first
    sign = np.where(q % 2, -1, 1)
    return centred * sign, 1j * math.pi / area**2 * second * sign, (edges[1] + edges[0]) / 2 * sign


class AxisTransmission:
    """A separable transmission along its axes, of the orders up to a direction cosine.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    cosine : float
        Largest direction cosine, relative to that of the incident light, that is kept.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float, cosine: float) -> None:
        highest = cosine / in_millimetres(wavelength)
        self._length = max(_TABLE_LENGTH, 2 ** math.ceil(math.log2(64 * max(highest * max(camera.mla_pitches), 1))))
        self._pitches, self._offset = camera.mla_pitches, camera.mla_offset
        counts = [int(highest * pitch) for pitch in camera.mla_pitches]
        self._words = [self.table(axis_orders(camera, wavelength, counts[axis], axis)) for axis in (0, 1)]

    def table(self, amplitudes: NDArray[np.complex128]) -> Any:
        """Return a table over the pitch of a sum of orders, those from the most negative on."""
        count = len(amplitudes) // 2
        spectrum = np.zeros(self._length, np.complex128)
        spectrum[np.arange(-count, count + 1)] = amplitudes
        table = (np.fft.ifft(spectrum) * self._length).astype(np.complex64)
        return words(np.append(table, table[0]))

    def along(self, coordinate: Any, axis: int) -> Any:
        """Return the factor along one axis (0: x, 1: y) at float64 coordinates of Dr.Jit, as Complex2f."""
        return self.look(self._words[axis], coordinate, axis)

    def look(self, table: Any, coordinate: Any, axis: int) -> Any:
        """Return what a `table` has at some coordinates along an axis, as Complex2f."""
        node, part = _node(coordinate - self._offset[axis], self._pitches[axis], self._length)
        types = array_types(coordinate)
        low, high = (unpack(dr.gather(types.UInt64, types.UInt64(table), node + step)) for step in (0, 1))
        return types.Complex2f(dr.lerp(low.real, high.real, part), dr.lerp(low.imag, high.imag, part))


def plane_orders(
    camera: PlenopticCamera,
    wavelength: float,
    cosine: float,
    fine: int = _FINE,
    factor: Callable[[Any, Any, Any], Any] | None = None,
) -> NDArray[np.complex64]:
    """Return the amplitudes of the orders of any array, in its own frame and without its offset.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    cosine : float
        Largest direction cosine, relative to that of the incident light, that is kept.
    fine : int
        Samples across the smaller pitch of which they are made, at least.
    factor : callable, optional
        What the transmission is multiplied by, from the offset from a lens's centre and the type of the lens.

    Returns
    -------
    complex64 array (2 rows + 1, 2 columns + 1)
        Those along y in rows, from the most negative on; zero beyond `cosine`.

    Raises
    ------
    InputError
        If they would take too much memory.
    """
    sides = camera.lattice.period(len(camera.mla_focal_lengths))
    highest = cosine / in_millimetres(wavelength)
    counts = [int(highest * side) for side in sides[::-1]]
    pitch = min(camera.mla_pitches)
    fine = max(fine, math.ceil(_PER_WAVE * highest * pitch))
    table = math.prod(side * highest * _PER_ORDER for side in sides)
    check_memory(
        _FINE_BYTES * math.prod(side / pitch * fine for side in sides) + 16 * table,
        f"microlens array of pitch {camera.mla_pitch:g} with {counts[1]} x {counts[0]} orders",
    )
    shape = [fast_length(side / pitch * fine, 2) for side in sides[::-1]]
    spectrum = scipy.fft.fft2(
        _period_samples(camera, wavelength, shape, factor), norm="forward", overwrite_x=True, workers=worker_count()
    )
    order = [np.arange(-count, count + 1) for count in counts]
    # Fine samples lie half a step within the period.
    waves = order[0][:, None] / (2 * shape[0]) + order[1] / (2 * shape[1])
    held = np.hypot(order[0][:, None] / sides[1], order[1] / sides[0]) * in_millimetres(wavelength) <= cosine
    return (spectrum[np.ix_(*order)] * np.exp(-2j * math.pi * waves) * held).astype(np.complex64)


def _period_samples(
    camera: PlenopticCamera, wavelength: float, shape: list[int], factor: Callable[[Any, Any, Any], Any] | None
) -> Field:
    """Return the transmission at fine samples of one period, in the middles of equal rectangles."""
    types = array_module()
    sides = camera.lattice.period(len(camera.mla_focal_lengths))
    index = dr.arange(types.UInt32, shape[0] * shape[1])
    _, row, column = split(types, index, *shape)
    x, y = (
        (types.Float64(place) + 0.5) * (side / count)
        for place, side, count in zip((column, row), sides, shape[::-1], strict=True)
    )
    centred = camera.replace(mla_rotation=0.0, mla_offset=(0.0, 0.0))
    samples = transmission(centred, wavelength, x, y)
    packed = pack(samples if factor is None else samples * types.Float(factor(*from_centre(centred, x, y))))
    return np.asarray(backend_of(packed).to_host(as_field(packed, tuple(shape))))


class PlaneTransmission:
    """The transmission of any array in its plane, of the orders up to a direction cosine.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    cosine : float
        Largest direction cosine, relative to that of the incident light, that is kept.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float, cosine: float) -> None:
        amplitudes = plane_orders(camera, wavelength, cosine)
        self._shape = tuple(fast_length(_PER_ORDER * max(size // 2, 1)) for size in amplitudes.shape)
        self._words = self.table(amplitudes)
        self._period = camera.lattice.period(len(camera.mla_focal_lengths))
        self._rotation, self._offset = camera.mla_rotation, camera.mla_offset

    def table(self, amplitudes: NDArray[np.complex64]) -> Any:
        """Return a table over the period of a sum of orders, laid out as by `plane_orders`."""
        spectrum = np.zeros(self._shape, np.complex64)
        spectrum[np.ix_(*(np.arange(-(size // 2), size // 2 + 1) for size in amplitudes.shape))] = amplitudes
        table = scipy.fft.ifft2(spectrum, norm="forward", overwrite_x=True, workers=worker_count())
        return words(np.pad(table, ((0, 1), (0, 1)), mode="wrap"))

    def at(self, x: Any, y: Any) -> Any:
        """Return the transmission at float64 places of Dr.Jit in the camera's frame, as Complex2f."""
        return self.look(self._words, x, y)

    def look(self, table: Any, x: Any, y: Any) -> Any:
        """Return what a `table` has at some places, as Complex2f."""
        types = array_types(x)
        x, y = turn(x - self._offset[0], y - self._offset[1], -self._rotation)
        (column, across), (row, down) = (
            _node(place, side, count)
            for place, side, count in zip((x, y), self._period, self._shape[::-1], strict=True)
        )
        width = dr.opaque(types.UInt32, self._shape[1] + 1)
        below = row * width + column
        corners = [
            unpack(dr.gather(types.UInt64, types.UInt64(table), line + step))
            for line in (below, below + width)
            for step in (0, 1)
        ]
        real, imaginary = (
            dr.lerp(dr.lerp(*pairs[:2], across), dr.lerp(*pairs[2:], across), down)
            for pairs in ([corner.real for corner in corners], [corner.imag for corner in corners])
        )
        return types.Complex2f(real, imaginary)


def words(table: NDArray[np.complex64]) -> Any:
    """Return a table as a Dr.Jit array of 64-bit words, on the active processor."""
    return array_module().UInt64(np.ascontiguousarray(table).reshape(-1).view(np.uint64))


def _node(place: Any, period: float, count: int) -> tuple[Any, Any]:
    """Return the sample of a period's `count` below a place, and the place's distance from it in samples."""
    types = array_types(place)
    scaled = place * dr.opaque(types.Float64, 1 / period)
    scaled = (scaled - dr.floor(scaled)) * dr.opaque(types.Float64, count)
    node = dr.minimum(types.UInt32(scaled), dr.opaque(types.UInt32, count - 1))
    return node, types.Float(scaled - types.Float64(node))


def axis_transmission(camera: PlenopticCamera, wavelength: float, cosine: float) -> AxisTransmission:
    """Return a separable transmission on the active processor; the last few are kept."""
    return _kept(AxisTransmission, array_module(), camera, wavelength, cosine)


def plane_transmission(camera: PlenopticCamera, wavelength: float, cosine: float) -> PlaneTransmission:
    """Return the transmission of any array on the active processor; the last few are kept."""
    return _kept(PlaneTransmission, array_module(), camera, wavelength, cosine)


def open_fraction(camera: PlenopticCamera, wavelength: float, cosine: float, x: Any, y: Any) -> Any:
    """Return 1 within the microlenses' apertures and 0 between them, without directions beyond a cosine.

    The integral of a product with it is exact where the other factor has no such directions, an intensity for one.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    cosine : float
        Largest direction cosine that is kept.
    x, y : float64 arrays of Dr.Jit
        Places in the camera's frame, in millimetres.

    Returns
    -------
    Float array of Dr.Jit
    """
    flat = camera.replace(mla_focal_length=_FLAT)
    if is_separable(flat):
        axes = axis_transmission(flat, wavelength, cosine)
        return (axes.along(x, 0) * axes.along(y, 1)).real
    return plane_transmission(flat, wavelength, cosine).at(x, y).real


@functools.lru_cache(maxsize=8)
def _kept(transmission_type: Any, types: Any, camera: PlenopticCamera, wavelength: float, cosine: float) -> Any:
    return transmission_type(camera, wavelength, cosine)
