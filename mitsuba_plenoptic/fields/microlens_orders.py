r"""The microlens array as a sum of diffraction orders, up to a highest direction.

The transmission of an array is a product of factors: one function of x and one of y if it is separable, otherwise a
single function of both. Each factor is periodic in the lattice frame, and therefore a sum of orders. Along an axis of
pitch :math:`D_2` the orders are :math:`\lambda / D_2` apart in direction cosine:

.. math:: t(x) = \sum_q c_q \, e^{2 \pi i q x / D_2}, \qquad
          c_q = \frac{1}{D_2} \int_\mathrm{lens} e^{-i \pi (x - c)^2 / \lambda f_2} \, e^{-2 \pi i q x / D_2} dx,

a Fresnel integral (Goodman, "Introduction to Fourier Optics", section 4.2.2, for the integrals). A factor of both
coordinates has a rectangular period of a few lenses (three focal lengths repeat every third lens), and its orders are
the two-dimensional Fourier transform of fine samples of that period.

Sampling t itself would alias its steep orders, which come from the edges of the lenses, into the band of a grid; the
sum over the orders that the grid can represent does not.

In units of its lattice, a factor is a function of the position, of :math:`\kappa = D_2^2 / \lambda f_2` along each axis
and for each type of lens, and of the apertures' widths over the pitches, :math:`\beta`. Derivatives by these three are
sums of orders; those by all parameters of the array follow by the chain rule:

- the position u: :math:`2 \pi i q \, c_q`;
- :math:`\kappa`: the orders of :math:`-i \pi v^2 t`, v the offset from the lens's centre;
- :math:`\beta`: an edge that moves acts as a line of light. In one dimension it is two points, whose orders are plane
  waves. In two dimensions integration by parts removes the line: with the aperture :math:`\chi(v / \beta)` and the
  phase :math:`\varphi`, :math:`\beta \, \partial_\beta \chi \varphi` is
  :math:`\chi \varphi + \chi v \, \partial_v \varphi - \partial_v (v \chi \varphi)`.

Apertures that fill their cells can only shrink, so that their derivative is one-sided.
"""

from __future__ import annotations

import functools
import itertools
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import drjit as dr
import numpy as np
import scipy
from numpy.typing import NDArray

from ..array import Lattice
from ..camera import PlenopticCamera
from ..optics import in_millimetres
from ..runtime import (
    Array,
    Field,
    Pair,
    Sizes,
    array_module,
    backend_of,
    check_memory,
    drjit_array,
    empty_packets,
    fft,
    turn,
)
from .accuracy import ACCURACY
from .transmittance import factor_axes, opaque_lattice, transmission


class ArrayParameter(NamedTuple):
    """A parameter with respect to which a factor is differentiated: position, Fresnel number or relative width."""

    name: Literal["position", "fresnel", "width"]
    axis: int
    lens_type: int = 0


class ArrayFactor(ABC):
    """Factor of the array's transmission in one coordinate, or in both, as a sum of diffraction orders.

    `axes` lists its coordinates (0: x, 1: y), and `periods` the periods along them.
    """

    _precision: type = np.complex64  # dtype of the transforms that compute its tables

    def __init__(self, camera: PlenopticCamera, axes: Sizes, shape: Sizes):
        lattice = camera.lattice
        types = len(camera.mla_focal_lengths)
        self._camera = camera
        self.axes = axes
        self._shape = shape
        self.periods = [lattice.period(types)[axis] for axis in axes]
        self._tables: dict[ArrayParameter | None, Any] = {}

    @abstractmethod
    def orders(self, parameter: ArrayParameter | None = None) -> Array:
        """Return the amplitudes of the orders, or their derivatives, from the most negative order; y along rows."""

    def at(self, *coordinates: Any, parameter: ArrayParameter | None = None) -> Any:
        """Return the factor, or its derivative, at Dr.Jit float64 coordinates along its axes, as Complex2f."""
        types = fft.array_types(coordinates[0])
        camera = self._camera
        if camera.lattice.displacement is not None:
            # No factor of such an array is of one coordinate.
            coordinates = camera.lattice.in_regular_array(*coordinates)
        if parameter not in self._tables:
            self._tables[parameter] = self._table(self.orders(parameter))
        table = types.UInt64(self._tables[parameter])
        places = tuple(
            coordinate - dr.opaque(types.Float64, camera.mla_offset[axis])
            for coordinate, axis in zip(coordinates, self.axes, strict=True)
        )
        if len(places) == 2 and camera.mla_rotation != 0:
            places = turn(*places, dr.opaque(types.Float64, -camera.mla_rotation))
        nodes = [_node(*axis_numbers) for axis_numbers in zip(places, self.periods, self._shape[::-1], strict=True)]
        terms = [(0, 1)]
        for (node, fraction), count in zip(nodes[::-1], self._shape, strict=True):
            row_length = dr.opaque(types.UInt32, count + 2)
            remainder = 1 - fraction
            weights = enumerate((remainder**2 / 2, 0.5 + fraction * remainder, fraction**2 / 2))
            terms = [
                (coordinate * row_length + node + step, share * weight)
                for (coordinate, share), (step, weight) in itertools.product(terms, weights)
            ]
        return sum(fft.unpack(dr.gather(types.UInt64, table, coordinate)) * share for coordinate, share in terms)

    def _table(self, amplitudes: Array) -> Any:
        """Return one period of a sum of orders as 64-bit words, with its last sample before it and its first after it.

        Quadratic splines, shifted by half a sample, multiply order q of n by a power of a sinc and a phase; orders are
        first divided by these.
        """
        orders = [np.arange(-(size // 2), size // 2 + 1) for size in amplitudes.shape]
        parts = [order / size for order, size in zip(orders, self._shape, strict=True)]
        windows = [np.sinc(part) ** 3 * np.exp(-1j * math.pi * part) for part in parts]
        spectrum: Array = np.zeros(self._shape, self._precision)
        spectrum[np.ix_(*orders)] = amplitudes / functools.reduce(np.multiply.outer, windows)
        table = scipy.fft.ifftn(spectrum, norm="forward", overwrite_x=True, workers=fft.worker_count())
        padded = empty_packets(tuple(size + 2 for size in table.shape), np.complex64)
        padded[(slice(1, -1),) * table.ndim] = table
        for axis in range(table.ndim):
            lines = np.moveaxis(padded, axis, 0)
            lines[0] = lines[-2]
            lines[-1] = lines[1]
        return drjit_array(array_module().UInt64, fft.as_words(padded))

    def _by_position(self, orders: Array, axis: int) -> Array:
        """Return the orders of the derivative with respect to the position along an axis, in periods."""
        rows_first = self.axes[::-1].index(axis)
        order = np.indices(orders.shape, sparse=True)[rows_first] - orders.shape[rows_first] // 2
        return 2j * math.pi * order * orders


class AxisFactor(ArrayFactor):
    """The factor of a separable array along one axis, with the orders up to a direction cosine."""

    _precision: type = np.complex128

    def __init__(self, camera: PlenopticCamera, wavelength: float, cosine: float, axis: int):
        highest = cosine / in_millimetres(wavelength)
        count = int(highest * camera.mla_pitches[axis])
        super().__init__(camera, (axis,), (fft.fast_length(ACCURACY.order_samples[0] * max(count, 1)),))
        self._orders = axis_orders(camera, wavelength, count, axis)

    def orders(self, parameter: ArrayParameter | None = None) -> Array:
        """Return the amplitudes of the orders, or their derivatives."""
        plain, by_fresnel, by_width = self._orders
        if parameter is None:
            return plain
        return {"position": self._by_position(plain, parameter.axis), "fresnel": by_fresnel, "width": by_width}[
            parameter.name
        ]


def axis_orders(
    camera: PlenopticCamera, wavelength: float, count: int, axis: int
) -> tuple[NDArray[np.complex128], NDArray[np.complex128], NDArray[np.complex128]]:
    """Return the orders -count ... count of a separable array along an axis (0: x, 1: y), from an edge of a cell.

    The other results are the orders' derivatives by the Fresnel number and by aperture width over pitch.
    """
    pitch = camera.mla_pitches[axis]
    width = camera.lattice.aperture_widths[axis] / pitch
    area = in_millimetres(wavelength) * camera.reduced_focal_lengths[0] / pitch**2
    q = np.arange(-count, count + 1)
    shift = area * q
    scale = math.sqrt(2 / area)
    sines, cosines = scipy.special.fresnel(np.stack([shift - width / 2, shift + width / 2]) * scale)
    integral = (cosines[1] - cosines[0]) - 1j * (sines[1] - sines[0])
    centred = integral / scale * np.exp(1j * math.pi * area * q.astype(float) ** 2)
    # The integrand e at the edges, and its moments by parts: x e = i (area / 2 pi) e' - area q e.
    low, high = (
        np.exp(-1j * math.pi * (side * width / 2) ** 2 / area - 1j * math.pi * q * side * width) for side in (-1, 1)
    )
    factor = 1j * area / (2 * math.pi)
    first = factor * (high - low) - shift * centred
    second = factor * ((high + low) * width / 2 - centred) - shift * first
    sign = np.where(q % 2, -1, 1)
    return centred * sign, -1j * math.pi * second * sign, (high + low) / 2 * sign


class PlaneFactor(ArrayFactor):
    """The single factor of an array that is not separable, with the orders up to a direction cosine.

    The orders are computed from at least `fine` samples across the smaller pitch.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float, cosine: float, fine: int = ACCURACY.edge_samples):
        sides = camera.lattice.period(len(camera.mla_focal_lengths))
        self._wavelength = wavelength
        self._cosine = cosine
        self._fine = fine
        self._counts = [int(cosine / in_millimetres(wavelength) * side) for side in sides[::-1]]
        super().__init__(
            camera, (0, 1), tuple(fft.fast_length(ACCURACY.order_samples[1] * max(count, 1)) for count in self._counts)
        )
        self._moments: dict[tuple[int, int, int | None], NDArray[np.complex64]] = {}

    def orders(self, parameter: ArrayParameter | None = None) -> Array:
        """Return the amplitudes of the orders, or their derivatives."""
        plain = self._moment(0, 0, None)
        if parameter is None:
            return plain
        name, axis, lens_type = parameter
        if name == "position":
            return self._by_position(plain, axis)
        if name == "fresnel":
            return -1j * math.pi * self._moment(axis, 2, lens_type)
        camera = self._camera
        pitch = self._camera.mla_pitches[axis]
        result = plain - self._by_position(self._moment(axis, 1, None), axis) / (self.periods[axis] / pitch)
        for type_index, length in enumerate(camera.reduced_focal_lengths):
            fresnel = pitch**2 / (in_millimetres(self._wavelength) * length)
            result = result - 2j * math.pi * fresnel * self._moment(axis, 2, type_index)
        return result / (camera.lattice.aperture_widths[axis] / pitch)

    def _moment(self, axis: int, power: int, lens_type: int | None) -> NDArray[np.complex64]:
        """Return the orders of the transmission times a power of the offset in pitches, for one or all lens types."""
        key = axis, power, lens_type
        if key not in self._moments:
            self._moments[key] = self._transformed(*key)
        return self._moments[key]

    def _transformed(self, axis: int, power: int, lens_type: int | None) -> NDArray[np.complex64]:
        """Return the orders of one period from fine samples; orders beyond the largest direction are zero."""
        camera = self._camera
        sides = self.periods
        wave = in_millimetres(self._wavelength)
        highest = self._cosine / wave
        pitch = min(camera.mla_pitches)
        fine = max(self._fine, math.ceil(ACCURACY.wave_samples * highest * pitch))
        table = math.prod(side * highest * ACCURACY.order_samples[1] for side in sides)
        # 16: Memory in bytes per sample while the orders are computed.
        check_memory(
            16 * math.prod(side / pitch * fine for side in sides) + 16 * table,
            f"microlens array of pitch {camera.row_pitch:g} with {self._counts[1]} x {self._counts[0]} orders",
        )
        shape = [fft.fast_length(side / pitch * fine, 2) for side in sides[::-1]]
        samples = self._samples(shape, axis, power, lens_type)
        spectrum = scipy.fft.fft2(samples, norm="forward", overwrite_x=True, workers=fft.worker_count())
        order = [np.arange(-count, count + 1) for count in self._counts]
        # Samples are at cell centres, which is half a step from the start of the period.
        waves = order[0][:, None] / (2 * shape[0]) + order[1] / (2 * shape[1])
        inside = np.hypot(order[0][:, None] / sides[1], order[1] / sides[0]) * wave <= self._cosine
        return (spectrum[np.ix_(*order)] * np.exp(-2j * math.pi * waves) * inside).astype(np.complex64)

    def _samples(self, shape: list[int], axis: int, power: int, lens_type: int | None) -> Field:
        """Return samples of one period of the transmission, at the centres of equal rectangles, on the host."""
        types = array_module()
        row, column = fft.rows_and_columns(types, *shape)
        x, y = (
            (types.Float64(coordinate) + 0.5) * dr.opaque(types.Float64, side / count)
            for coordinate, side, count in zip((column, row), self.periods, shape[::-1], strict=True)
        )
        centred = self._camera.replace(
            mla_rotation=0.0, mla_offset=(0.0, 0.0), mla_warp=(), mla_cra=(), mla_jitter=(0.0, 0.0)
        )
        samples = transmission(centred, self._wavelength, x, y)
        if power:
            lattice = opaque_lattice(centred, types.Float64)
            cell = lattice.cell(x, y)
            offset = (x, y)[axis] - lattice.centre(*cell)[axis]
            factor = types.Float((offset / dr.opaque(types.Float64, centred.mla_pitches[axis])) ** power)
            if lens_type is not None and len(centred.mla_focal_lengths) > 1:
                factor = dr.select(lattice.lens_type(*cell) == lens_type, factor, 0)
            samples *= factor
        packed = fft.pack(samples)
        return backend_of(packed).to_host(fft.as_field(packed, tuple(shape)))


class MicrolensArray:
    """The transmission of a camera's microlenses at one wavelength, limited to largest directions.

    `axes` are the axes of each factor; without an array there is none. The most recent factors are cached, because
    they take long to compute for an array that is not separable.
    """

    def __init__(self, camera: PlenopticCamera, wavelength: float):
        self._camera = camera
        self._wavelength = wavelength
        self._factors: dict[tuple[Any, float], list[ArrayFactor]] = {}
        self.axes = factor_axes(camera)

    def __reduce__(self) -> tuple:
        return microlens_array, (self._camera, self._wavelength)

    @property
    def fills(self) -> bool:
        """Whether all light passes, without gaps between lenses."""
        return not self.axes or self._camera.lattice.fills

    def factors(self, cosine: float) -> list[ArrayFactor]:
        """Return the factors on the active device, with directions up to a cosine relative to the incident light."""
        key = array_module(), cosine
        if key not in self._factors:
            # Factors that are kept, of two coordinates and of one: patches of different sizes ask for different
            # directions, and those of one size follow each other.
            if len(self._factors) == (2 if (0, 1) in self.axes else 16):
                del self._factors[next(iter(self._factors))]
            limits = self._camera, self._wavelength, cosine
            self._factors[key] = [
                PlaneFactor(*limits) if len(axes) == 2 else AxisFactor(*limits, axes[0]) for axes in self.axes
            ]
        return self._factors[key]

    def open_fraction(self, cosine: float, x: Any, y: Any) -> Any:
        """Return the aperture function, 1 in apertures and 0 between, at positions in mm, without steeper directions.

        The integral of its product with a function limited to these directions, such as an intensity, is exact.
        """
        product = 1
        for factor in self._holes.factors(cosine):
            product = factor.at(*((x, y)[axis] for axis in factor.axes)) * product
        return product.real

    @functools.cached_property
    def _holes(self) -> MicrolensArray:
        return MicrolensArray(self._camera.replace(mla_focal_length=ACCURACY.flat, mla_shape=None), self._wavelength)


@functools.lru_cache(maxsize=4)
def microlens_array(camera: PlenopticCamera, wavelength: float) -> MicrolensArray:
    """Return the transmission of a camera's microlenses, from a cache of the last few.

    The tables of arrays that are not separable take longer than a point spread. Many operators of one camera are made
    one after another, and batches of another process mostly need the previous array.
    """
    return MicrolensArray(camera, wavelength)


@dataclass(frozen=True)
class VaryingArrayFactor:
    """Factor of an upright array with Dr.Jit parameters that carry gradients, exact to first order in them."""

    factor: ArrayFactor
    lattice: Lattice
    focal_lengths: list  # for each type of lens, reduced by the index of the medium
    wavelength: Any

    @property
    def axes(self) -> Sizes:
        """Axes of the coordinates on which the factor depends."""
        return self.factor.axes

    def at(self, *coordinates: Any) -> Any:
        """Return the factor at Dr.Jit float64 coordinates along its axes, as Complex2f."""
        numbers = {}
        periods = self.lattice.period(len(self.focal_lengths))
        for axis, coordinate in zip(self.axes, coordinates, strict=True):
            pitch = self.lattice.pitches[axis]
            numbers[ArrayParameter("position", axis)] = (coordinate - self.lattice.offset[axis]) / periods[axis]
            numbers[ArrayParameter("width", axis)] = self.lattice.aperture_widths[axis] / pitch
            for lens_type, length in enumerate(self.focal_lengths):
                area = in_millimetres(self.wavelength) * length
                numbers[ArrayParameter("fresnel", axis, lens_type)] = pitch * pitch / area
        places = [dr.detach(coordinate) for coordinate in coordinates]
        value = self.factor.at(*places)
        for parameter, parameter_value in numbers.items():
            if dr.grad_enabled(parameter_value):
                change = fft.array_types(value.real).Float(parameter_value - dr.detach(parameter_value))
                value = value + self.factor.at(*places, parameter=parameter) * change
        return value


def _node(coordinate: Any, period: float, count: int) -> Pair:
    """Return the index of the sample before a position in periods, and the distance from it in samples."""
    types = fft.array_types(coordinate)
    scaled = coordinate * dr.opaque(types.Float64, 1 / period)
    scaled = (scaled - dr.floor(scaled)) * dr.opaque(types.Float64, count)
    node = dr.minimum(types.UInt32(scaled), dr.opaque(types.UInt32, count - 1))
    return node, types.Float(scaled - types.Float64(node))
