r"""The microlens lattice as a thin element of apertures and phases, cut off at a highest direction.

The lattice is periodic, so it splits a plane wave into orders. Where it is upright, square and its apertures are, too,
it is the product of a function of x and one of y, whose orders are :math:`\lambda / D_2` apart in direction cosine:

.. math:: t(x) = \sum_q c_q \, e^{2 \pi i q x / D_2}, \qquad
          c_q = \frac{1}{D_2} \int_\mathrm{lens} e^{-i \pi (x - c)^2 / \lambda f_2} \, e^{-2 \pi i q x / D_2} dx,

a Fresnel integral (Goodman, "Introduction to Fourier Optics", section 4.2.2, for the integrals). Every other lattice
has, in its own frame, a rectangular period of a few lenses (three focal lengths repeat every third lens), whose
orders a two-dimensional Fourier transform of fine samples tells.

Samples of t itself would fold its steep orders, which come from the edges of the lenses, back into the band of a
grid; the sum over the orders that the grid holds does not.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import drjit as dr
import numpy as np
import scipy.fft
import scipy.special
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lattice import turn
from ..runtime.backend import array_module, backend_of
from ..runtime.fft import Field, as_field, pack, unpack, worker_count
from ..runtime.indexing import split
from .sampling import check_memory, fast_length, in_millimetres

_TABLE_LENGTH = 2**14

_FINE = 2048
"""Samples across a pitch of which the orders of a plane lattice are made: its edges are known that finely."""

_PER_WAVE = 8
"""Fine samples across the finest wave that is kept, at least, so that none folds."""

_FINE_BYTES = 16
"""Memory that a fine sample takes while the orders are made."""

_PER_ORDER = 40
"""Samples of a plane transmission across one wave of its highest order, between which it is interpolated."""


def is_separable(camera: PlenopticCamera) -> bool:
    """Whether the transmission is a function of x times one of y."""
    return camera.lattice.separable and len(camera.mla_focal_lengths) == 1


# -- one axis ----------------------------------------------------------------------------------------


def orders(camera: PlenopticCamera, wavelength: float, count: int) -> NDArray[np.complex128]:
    """Amplitudes of the orders -count ... count along one axis; a corner of four cells lies at x = 0.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    count : int
        Highest order.

    Returns
    -------
    complex128 array (2 count + 1,)
    """
    pitch, width = camera.mla_pitch, camera.lattice.aperture_width
    area = in_millimetres(wavelength) * camera.mla_focal_length
    q = np.arange(-count, count + 1)
    shift = area * q / pitch
    scale = math.sqrt(2 / area)
    sines, cosines = scipy.special.fresnel(np.stack([shift - width / 2, shift + width / 2]) * scale)
    integral = (cosines[1] - cosines[0]) - 1j * (sines[1] - sines[0])
    centred = integral / (scale * pitch) * np.exp(1j * math.pi * area * (q / pitch) ** 2)
    return centred * np.where(q % 2, -1, 1)


def transmission_table(camera: PlenopticCamera, wavelength: float, cosine: float) -> NDArray[np.complex64]:
    """One period of the transmission along one axis, of the orders up to a direction cosine.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    cosine : float
        Largest direction cosine, relative to that of the incident light, that is kept.

    Returns
    -------
    complex64 array (length + 1,)
        Samples from the edge of a cell to the next, both included; `length` is a power of two.
    """
    count = int(cosine * camera.mla_pitch / in_millimetres(wavelength))
    length = max(_TABLE_LENGTH, 2 ** math.ceil(math.log2(64 * max(count, 1))))
    spectrum = np.zeros(length, np.complex128)
    spectrum[np.arange(-count, count + 1)] = orders(camera, wavelength, count)
    period = np.fft.ifft(spectrum) * length
    return np.append(period, period[0]).astype(np.complex64)


def transmission(
    camera: PlenopticCamera, table: NDArray[np.complex64], x: NDArray[np.floating[Any]], axis: int
) -> NDArray[np.complex64]:
    """Transmission along one axis (0: x, 1: y) at any places, interpolated from `transmission_table`."""
    places = (x - camera.mla_offset[axis]) / camera.mla_pitch
    places = (places - np.floor(places)) * (len(table) - 1)
    index = np.minimum(places.astype(int), len(table) - 2)
    part = (places - index).astype(np.float32)
    return table[index] * (1 - part) + table[index + 1] * part


# -- both axes ---------------------------------------------------------------------------------------


def upright(camera: PlenopticCamera) -> PlenopticCamera:
    """Return the camera as it is in the frame that is turned with its lattice about the axis."""
    if camera.mla_rotation == 0:
        return camera
    return camera.replace(mla_rotation=0.0, mla_offset=turn(*camera.mla_offset, -camera.mla_rotation))


def period(camera: PlenopticCamera) -> tuple[float, float]:
    """Width and height of a rectangle, in the lattice's frame, after which its transmission repeats."""
    width, height = camera.lattice.period(len(camera.mla_focal_lengths))
    return width, height


def plane_orders(camera: PlenopticCamera, wavelength: float, cosine: float, fine: int = _FINE) -> NDArray[np.complex64]:
    """Amplitudes of the orders of a lattice, in its own frame and without its offset.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    cosine : float
        Largest direction cosine, relative to that of the incident light, that is kept.
    fine : int
        Samples across a pitch of which they are made, at least.

    Returns
    -------
    complex64 array (2 rows + 1, 2 columns + 1)
        Those along y in rows, from the most negative on; zero beyond `cosine`.
    """
    sides = period(camera)
    highest = cosine / in_millimetres(wavelength)
    counts = [int(highest * side) for side in sides[::-1]]
    fine = max(fine, math.ceil(_PER_WAVE * highest * camera.mla_pitch))
    table = math.prod(side * highest * _PER_ORDER for side in sides)
    check_memory(
        _FINE_BYTES * math.prod(side / camera.mla_pitch * fine for side in sides) + 16 * table,
        f"microlens array of pitch {camera.mla_pitch:g} with {counts[1]} x {counts[0]} orders",
    )
    shape = [fast_length(side / camera.mla_pitch * fine, 2) for side in sides[::-1]]
    spectrum = scipy.fft.fft2(
        _lenses(camera, wavelength, shape), norm="forward", overwrite_x=True, workers=worker_count()
    )
    order = [np.arange(-count, count + 1) for count in counts]
    # fine samples lie half a step within the period
    turns = order[0][:, None] / (2 * shape[0]) + order[1] / (2 * shape[1])
    held = np.hypot(order[0][:, None] / sides[1], order[1] / sides[0]) * in_millimetres(wavelength) <= cosine
    return (spectrum[np.ix_(*order)] * np.exp(-2j * math.pi * turns) * held).astype(np.complex64)


def _lenses(camera: PlenopticCamera, wavelength: float, shape: list[int]) -> Field:
    """Transmission at fine samples of one period, in the middles of equal rectangles."""
    types = array_module()
    index = dr.arange(types.UInt32, shape[0] * shape[1])
    _, row, column = split(types, index, *shape)
    x, y = (
        (types.Float64(place) + 0.5) * (side / count)
        for place, side, count in zip((column, row), period(camera), shape[::-1], strict=True)
    )
    packed = pack(lenses_at(camera.replace(mla_rotation=0.0, mla_offset=(0.0, 0.0)), wavelength, x, y))
    return np.asarray(backend_of(packed).to_host(as_field(packed, tuple(shape))))


def lenses_at(camera: PlenopticCamera, wavelength: float, x: Any, y: Any) -> Any:
    r"""Transmission of the microlenses with all of its orders: :math:`e^{-i \pi |m - c|^2 / \lambda f_2}` in a lens.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    x, y : float64 arrays of Dr.Jit
        Places m in the camera's frame.

    Returns
    -------
    Complex2f of Dr.Jit
    """
    types, lattice, lengths = array_module(), camera.lattice, camera.mla_focal_lengths
    i, j = lattice.cell(x, y)
    cx, cy = lattice.centre(i, j)
    dx, dy = x - cx, y - cy
    kind = types.UInt32(lattice.lens_type(i, j)) if len(lengths) > 1 else types.UInt32(0)
    power = dr.gather(types.Float64, types.Float64([1 / f2 for f2 in lengths]), kind)
    turns = (dx * dx + dy * dy) * power * (-0.5 / in_millimetres(wavelength))
    sine, cosine = dr.sincos(types.Float(turns - dr.round(turns)) * (2 * math.pi))
    return dr.select(lattice.in_aperture(dx, dy), types.Complex2f(cosine, sine), 0)


class PlaneTransmission:
    """One period of the transmission of a lattice, of the orders up to a direction cosine.

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
        half = [size // 2 for size in amplitudes.shape]
        self._shape = tuple(fast_length(_PER_ORDER * max(count, 1)) for count in half)
        spectrum = np.zeros(self._shape, np.complex64)
        spectrum[np.ix_(*(np.arange(-count, count + 1) for count in half))] = amplitudes
        table = scipy.fft.ifft2(spectrum, norm="forward", overwrite_x=True, workers=worker_count())
        self._words = array_module().UInt64(np.pad(table, ((0, 1), (0, 1)), mode="wrap").reshape(-1).view(np.uint64))
        self._period = period(camera)
        self._rotation, self._offset = camera.mla_rotation, camera.mla_offset

    def at(self, x: Any, y: Any) -> Any:
        """Interpolate between its samples.

        Parameters
        ----------
        x, y : float64 arrays of Dr.Jit
            Places in the camera's frame.

        Returns
        -------
        Complex2f of Dr.Jit
        """
        types = array_module()
        x, y = x - self._offset[0], y - self._offset[1]
        if self._rotation != 0:
            x, y = turn(x, y, -self._rotation)
        nodes, parts = [], []
        for place, side, count in zip((x, y), self._period, self._shape[::-1], strict=True):
            scaled = place * dr.opaque(types.Float64, 1 / side)
            scaled = (scaled - dr.floor(scaled)) * dr.opaque(types.Float64, count)
            node = dr.minimum(types.UInt32(scaled), dr.opaque(types.UInt32, count - 1))
            nodes.append(node)
            parts.append(types.Float(scaled - types.Float64(node)))
        below = nodes[1] * dr.opaque(types.UInt32, self._shape[1] + 1) + nodes[0]
        above = below + dr.opaque(types.UInt32, self._shape[1] + 1)
        corners = [
            unpack(dr.gather(types.UInt64, self._words, line + step)) for line in (below, above) for step in (0, 1)
        ]
        real, imaginary = (
            dr.lerp(dr.lerp(*pairs[:2], parts[0]), dr.lerp(*pairs[2:], parts[0]), parts[1])
            for pairs in ([corner.real for corner in corners], [corner.imag for corner in corners])
        )
        return types.Complex2f(real, imaginary)


def plane_transmission(camera: PlenopticCamera, wavelength: float, cosine: float) -> PlaneTransmission:
    """Return the transmission of a lattice on the active processor; the last few are kept."""
    return _plane_transmission(array_module(), camera, wavelength, cosine)


@functools.lru_cache(maxsize=4)
def _plane_transmission(types: Any, camera: PlenopticCamera, wavelength: float, cosine: float) -> PlaneTransmission:
    return PlaneTransmission(camera, wavelength, cosine)
