r"""How the transmission of the microlenses changes with the numbers of the array.

In units of its own lattice the transmission is a function of the place, of :math:`\kappa = D_2^2 / \lambda f_2` along
each axis and for each type of lenses, and of the apertures' widths over the pitches, :math:`\beta`; all else follows by
the chain rule. Each derivative is a sum of orders as the transmission is, of

- the place u: :math:`2 \pi i q \, c_q`;
- :math:`\kappa`: the orders of :math:`-i \pi v^2 t`, v the offset from the lens's centre;
- :math:`\beta`: an edge that moves is a line of light. By parts it has no such line: with the aperture
  :math:`\chi(v / \beta)` and the phase :math:`\varphi`,
  :math:`\beta \, \partial_\beta \chi \varphi` is
  :math:`\chi \varphi + \chi v \, \partial_v \varphi - \partial_v (v \chi \varphi)`.

Apertures that fill their cells can only shrink; their derivative is that to the one side.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lattice import Lattice
from ..optics.phase import in_millimetres
from ..runtime.backend import array_module
from ..runtime.fft import array_types
from .microlens_orders import AxisTransmission, PlaneTransmission, axis_order_derivatives, plane_orders


@dataclass(frozen=True)
class VaryingMicrolenses:
    """The transmission of microlenses whose numbers carry gradients, with their first order only.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera, upright, by plain numbers.
    wavelength : float
        The plain wavelength in nanometres.
    cosine : float
        Largest direction cosine that is kept.
    lattice : Lattice
        The lattice by numbers of Dr.Jit.
    focal_lengths : list of Dr.Jit numbers
        Of each type of lenses.
    varying_wavelength : Dr.Jit number
        In nanometres.
    """

    camera: PlenopticCamera
    wavelength: float
    cosine: float
    lattice: Lattice
    focal_lengths: list[Any]
    varying_wavelength: Any

    def along(self, coordinate: Any, axis: int) -> Any:
        """Return the factor along one axis at float64 coordinates of Dr.Jit, as Complex2f."""
        tables = _axis_tables(array_module(), self.camera, self.wavelength, self.cosine)
        changes = {
            "place": (coordinate - self.lattice.offset[axis]) / self.lattice.pitches[axis],
            "area": 1 / self._fresnel(axis, 0),
            "width": self._width(axis),
        }
        coordinate = dr.detach(coordinate)
        result = tables.base.along(coordinate, axis)
        return _first_order(result, changes, lambda name: tables.base.look(tables.table(name, axis), coordinate, axis))

    def at(self, x: Any, y: Any) -> Any:
        """Return the transmission at float64 places of Dr.Jit, as Complex2f."""
        tables = _plane_tables(array_module(), self.camera, self.wavelength, self.cosine)
        period = self.lattice.period(len(self.focal_lengths))
        changes: dict[tuple[str, int, int], Any] = {}
        for axis, place in enumerate((x, y)):
            changes["place", axis, 0] = (place - self.lattice.offset[axis]) / period[axis]
            changes["width", axis, 0] = self._width(axis)
            for lens_type in range(len(self.focal_lengths)):
                changes["fresnel", axis, lens_type] = self._fresnel(axis, lens_type)
        x, y = dr.detach(x), dr.detach(y)
        result = tables.base.at(x, y)
        return _first_order(result, changes, lambda name: tables.base.look(tables.table(*name), x, y))

    def _fresnel(self, axis: int, lens_type: int) -> Any:
        pitch = self.lattice.pitches[axis]
        return pitch * pitch / (in_millimetres(self.varying_wavelength) * self.focal_lengths[lens_type])

    def _width(self, axis: int) -> Any:
        return self.lattice.aperture_widths[axis] / self.lattice.pitches[axis]


def _first_order(value: Any, changes: dict[Any, Any], derivative: Any) -> Any:
    """Give a value the gradients of some numbers, by its derivatives with respect to them."""
    Float = array_types(value.real).Float
    for name, number in changes.items():
        if dr.grad_enabled(number):
            value = value + derivative(name) * Float(number - dr.detach(number))
    return value


class AxisTables:
    """Tables of a separable transmission and of its derivatives along its axes; arguments as of `AxisTransmission`."""

    def __init__(self, camera: PlenopticCamera, wavelength: float, cosine: float) -> None:
        self.base = AxisTransmission(camera, wavelength, cosine)
        self._orders = []
        for axis, pitch in enumerate(camera.mla_pitches):
            count = int(cosine / in_millimetres(wavelength) * pitch)
            orders, by_area, by_width = axis_order_derivatives(camera, wavelength, count, axis)
            by_place = 2j * math.pi * np.arange(-count, count + 1) * orders
            self._orders.append({"place": by_place, "area": by_area, "width": by_width})

    @functools.cache  # noqa: B019 (the tables live as long as their owner, of which few are kept)
    def table(self, name: str, axis: int) -> Any:
        """Return the table of the derivative with respect to the place in pitches, an area or a width."""
        return self.base.table(self._orders[axis][name])


class PlaneTables:
    """Tables of any transmission and of its derivatives in its plane; arguments as of `PlaneTransmission`."""

    def __init__(self, camera: PlenopticCamera, wavelength: float, cosine: float) -> None:
        self.base = PlaneTransmission(camera, wavelength, cosine)
        self._camera, self._wavelength, self._cosine = camera, wavelength, cosine

    @functools.cache  # noqa: B019
    def _moment(self, axis: int, power: int, lens_type: int | None) -> NDArray[np.complex64]:
        """Return the orders of the transmission times a power of the offset in pitches, of one type of lenses."""
        pitch = self._camera.mla_pitches[axis]

        def factor(dx: Any, dy: Any, which: Any) -> Any:
            offset = ((dx, dy)[axis] / pitch) ** power
            return offset if lens_type is None else dr.select(which == lens_type, offset, 0)

        return plane_orders(self._camera, self._wavelength, self._cosine, factor=factor)

    @functools.cache  # noqa: B019
    def table(self, name: str, axis: int, lens_type: int) -> Any:
        """Return the table of the derivative with respect to the place in periods, a Fresnel number or a width."""
        return self.base.table(getattr(self, f"_by_{name}")(axis, lens_type).astype(np.complex64))

    def _by_place(self, axis: int, lens_type: int) -> NDArray[Any]:
        orders = self._moment(axis, 0, None)
        return self._order(orders, axis) * orders

    def _by_fresnel(self, axis: int, lens_type: int) -> NDArray[Any]:
        return -1j * math.pi * self._moment(axis, 2, lens_type)

    def _by_width(self, axis: int, lens_type: int) -> NDArray[Any]:
        camera, pitch = self._camera, self._camera.mla_pitches[axis]
        periods = camera.lattice.period(len(camera.mla_focal_lengths))[axis] / pitch
        result = self._moment(axis, 0, None) - self._order(moved := self._moment(axis, 1, None), axis) / periods * moved
        for lens_type, length in enumerate(camera.mla_focal_lengths):
            fresnel = pitch**2 / (in_millimetres(self._wavelength) * length)
            result = result - 2j * math.pi * fresnel * self._moment(axis, 2, lens_type)
        return result / (camera.lattice.aperture_widths[axis] / pitch)

    @staticmethod
    def _order(orders: NDArray[np.complex64], axis: int) -> NDArray[Any]:
        """Return the factor that differentiates with respect to the place in periods."""
        half = [size // 2 for size in orders.shape]
        numbers = np.arange(-half[1], half[1] + 1)[None, :] if axis == 0 else np.arange(-half[0], half[0] + 1)[:, None]
        return 2j * math.pi * numbers


@functools.lru_cache(maxsize=2)
def _axis_tables(types: Any, camera: PlenopticCamera, wavelength: float, cosine: float) -> AxisTables:
    return AxisTables(camera, wavelength, cosine)


@functools.lru_cache(maxsize=1)
def _plane_tables(types: Any, camera: PlenopticCamera, wavelength: float, cosine: float) -> PlaneTables:
    return PlaneTables(camera, wavelength, cosine)
