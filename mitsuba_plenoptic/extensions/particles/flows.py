r"""Steady flows with exact displacements: velocities in millimetres per second at positions in the camera frame.

All but imported ones are free of divergence, so that particles that are spread evenly stay so. A new flow is a frozen
dataclass with `velocity`, and an entry in `FLOWS`; a flow without a closed form of its paths has them integrated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.interpolate import RegularGridInterpolator

from ...errors import (
    InputError,
    put,
    refuse_if,
    refusing,
    require_choice,
    require_length,
    require_number,
    require_numbers,
)
from ...runtime import MILLIMETRES, Doubles, as_array, require_file, require_units

Points = Doubles
"""Positions or velocities, (n, 3)."""

_TOLERANCE = 1e-11
"""Error of an integrated path, over its length and over the flow's own size."""

_FASTEST = 1e9

_AXES = "xyz"

_SPEEDS = "mm/s", "mm s-1", "mm s^-1", "mm.s-1"
"""Names of the unit of velocities."""


def _cylinder(axis: str) -> list[int]:
    """Return the indices of two axes and of the one that they turn about, in this order."""
    last = _AXES.index(axis)
    return [(last + 1) % 3, (last + 2) % 3, last]


def _centre(value: Sequence[float]) -> tuple[float, ...]:
    return require_numbers("centre", value, count=3, minimum=-1e9, maximum=1e9)


def _speed(name: str, value: float) -> float:
    return require_number(name, value, minimum=-_FASTEST, maximum=_FASTEST)


class Flow:
    """A steady flow."""

    def velocity(self, points: Points) -> Points:
        """Return the velocities at positions."""
        raise NotImplementedError

    def advected(self, points: Points, time: float) -> Points:
        """Return where particles at some positions are after a time in seconds, which may be negative.

        Parameters
        ----------
        points : float64 array (n, 3)
            Positions in mm.
        time : float
            The time.

        Raises
        ------
        InputError
            If the path of a particle cannot be followed.
        """
        if time == 0 or not len(points):
            return points.copy()
        paths = solve_ivp(
            lambda _, state: self.velocity(state.reshape(-1, 3)).ravel(),
            (0.0, time),
            points.ravel(),
            method="DOP853",
            rtol=_TOLERANCE,
            atol=_TOLERANCE,
        )
        refuse_if(not paths.success, f"flow: paths over {time:g} s cannot be followed: {paths.message}")
        return np.asarray(paths.y[:, -1].reshape(-1, 3))


@dataclass(frozen=True)
class Uniform(Flow):
    """The same velocity everywhere.

    Parameters
    ----------
    speed : (float, float, float)
        Velocity along x, y and z in mm/s.
    """

    speed: tuple[float, ...] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        speed = require_numbers("speed", self.speed, count=3, minimum=-_FASTEST, maximum=_FASTEST)
        put(self, speed=speed)

    def velocity(self, points: Points) -> Points:
        """Return the velocities at positions."""
        return np.broadcast_to(np.array(self.speed), points.shape)

    def advected(self, points: Points, time: float) -> Points:
        """Return where particles at some positions are after a time in seconds."""
        return np.asarray(points + time * np.array(self.speed))


@dataclass(frozen=True)
class Shear(Flow):
    """A velocity along one axis that grows evenly along another one.

    Parameters
    ----------
    rate : float
        Growth of the velocity in 1/s.
    along, across : {"x", "y", "z"}
        Axis of the velocity, and axis along which it grows.
    centre : (float, float, float)
        A place in mm where the velocity is 0.
    """

    rate: float = 1.0
    along: str = "x"
    across: str = "z"
    centre: tuple[float, ...] = (0.0, 0.0, 240.0)

    def __post_init__(self) -> None:
        for name in ("along", "across"):
            require_choice(name, getattr(self, name), tuple(_AXES))
        refuse_if(self.along == self.across, f"along = {self.along}, across = {self.across}: they must differ")
        put(self, rate=_speed("rate", self.rate), centre=_centre(self.centre))

    def velocity(self, points: Points) -> Points:
        """Return the velocities at positions."""
        result = np.zeros(points.shape)
        across = _AXES.index(self.across)
        result[:, _AXES.index(self.along)] = self.rate * (points[:, across] - self.centre[across])
        return result

    def advected(self, points: Points, time: float) -> Points:
        """Return where particles at some positions are after a time in seconds."""
        return np.asarray(points + time * self.velocity(points))


@dataclass(frozen=True)
class TaylorGreen(Flow):
    """Rows of square vortices that turn about one axis, each against its neighbours (Taylor and Green 1937).

    Parameters
    ----------
    speed : float
        Largest velocity in mm/s.
    length : float
        Width of a vortex in mm.
    axis : {"x", "y", "z"}
        Axis about which they turn.
    centre : (float, float, float)
        A corner of four vortices, in mm.
    """

    speed: float = 1.0
    length: float = 2.0
    axis: str = "z"
    centre: tuple[float, ...] = (0.0, 0.0, 240.0)

    def __post_init__(self) -> None:
        require_choice("axis", self.axis, tuple(_AXES))
        length = require_length("length", self.length)
        put(self, speed=_speed("speed", self.speed), length=length, centre=_centre(self.centre))

    def velocity(self, points: Points) -> Points:
        """Return the velocities at positions."""
        first, second, _ = _cylinder(self.axis)
        p, q = ((points[:, i] - self.centre[i]) * math.pi / self.length for i in (first, second))
        result = np.zeros(points.shape)
        result[:, first] = self.speed * np.sin(p) * np.cos(q)
        result[:, second] = -self.speed * np.cos(p) * np.sin(q)
        return result


@dataclass(frozen=True)
class LambOseen(Flow):
    r"""A line vortex with a core, at one moment: :math:`v = \Gamma / 2 \pi r \, (1 - e^{-r^2 / c^2})` (Lamb 1932).

    Parameters
    ----------
    circulation : float
        Circulation :math:`\Gamma` in mm^2/s.
    core : float
        Radius c of the core in mm.
    axis : {"x", "y", "z"}
        Axis about which it turns.
    centre : (float, float, float)
        A point of its axis, in mm.
    """

    circulation: float = 10.0
    core: float = 0.5
    axis: str = "z"
    centre: tuple[float, ...] = (0.0, 0.0, 240.0)

    def __post_init__(self) -> None:
        require_choice("axis", self.axis, tuple(_AXES))
        circulation = _speed("circulation", self.circulation)
        core = require_length("core", self.core)
        put(self, circulation=circulation, core=core, centre=_centre(self.centre))

    def _turning(self, p: Doubles, q: Doubles) -> Doubles:
        """Return the angular velocity in 1/s at distances from the axis of the vortex."""
        square = (p * p + q * q) / self.core**2
        # (1 - exp(-s)) / s is 1 at s = 0.
        ratio = np.where(square > 0, -np.expm1(-square) / np.where(square > 0, square, 1), 1.0)
        return np.asarray(self.circulation / (2 * math.pi * self.core**2) * ratio)

    def velocity(self, points: Points) -> Points:
        """Return the velocities at positions."""
        first, second, _ = _cylinder(self.axis)
        p, q = (points[:, i] - self.centre[i] for i in (first, second))
        turning = self._turning(p, q)
        result = np.zeros(points.shape)
        result[:, first] = -turning * q
        result[:, second] = turning * p
        return result

    def advected(self, points: Points, time: float) -> Points:
        """Return where particles at some positions are after a time in seconds: on circles about the axis."""
        first, second, _ = _cylinder(self.axis)
        p, q = (points[:, i] - self.centre[i] for i in (first, second))
        angle = time * self._turning(p, q)
        result = points.copy()
        result[:, first] = self.centre[first] + p * np.cos(angle) - q * np.sin(angle)
        result[:, second] = self.centre[second] + p * np.sin(angle) + q * np.cos(angle)
        return result


@dataclass(frozen=True)
class HillVortex(Flow):
    r"""Hill's spherical vortex, which stands in a stream of velocity :math:`-U` along its axis (Hill 1894).

    The stream function is :math:`\tfrac34 U r^2 (1 - R^2 / a^2)` within the sphere of radius a, and
    :math:`-\tfrac12 U r^2 (1 - a^3 / R^3)` outside; R is the distance from the centre, r that from the axis.

    Parameters
    ----------
    speed : float
        Velocity U in mm/s.
    radius : float
        Radius a of the sphere in mm.
    axis : {"x", "y", "z"}
        Axis of the vortex.
    centre : (float, float, float)
        Centre of the sphere, in mm.
    """

    speed: float = 1.0
    radius: float = 2.0
    axis: str = "z"
    centre: tuple[float, ...] = (0.0, 0.0, 240.0)

    def __post_init__(self) -> None:
        require_choice("axis", self.axis, tuple(_AXES))
        radius = require_length("radius", self.radius)
        put(self, speed=_speed("speed", self.speed), radius=radius, centre=_centre(self.centre))

    def velocity(self, points: Points) -> Points:
        """Return the velocities at positions."""
        first, second, last = _cylinder(self.axis)
        p, q, along = ((points[:, i] - self.centre[i]) / self.radius for i in (first, second, last))
        square = p * p + q * q
        distance = np.maximum(np.sqrt(square + along * along), 1.0)
        within = square + along * along < 1
        outer = 1.5 * self.speed / distance**5
        bent = np.where(within, 1.5 * self.speed, outer) * along
        result = np.empty(points.shape)
        result[:, first] = bent * p
        result[:, second] = bent * q
        stream = -self.speed * (1 - distance**-3.0) - outer * square
        result[:, last] = np.where(within, 1.5 * self.speed * (1 - 2 * square - along * along), stream)
        return result


@dataclass(frozen=True)
class ImportedFlow(Flow):
    """A velocity field on a regular grid, linear between its nodes.

    The NetCDF file, or `xarray.Dataset`, has the variables u, v and w, in mm/s along x, y and z of the camera frame, on
    the dimensions x, y and z in mm. Attributes ``units`` that say otherwise are refused.

    Parameters
    ----------
    field : path or xarray.Dataset
        The file or the data set.

    Raises
    ------
    InputError
        If it is no velocity field, or a particle leaves its grid.
    """

    field: str | Path | xr.Dataset

    def __post_init__(self) -> None:
        name = "field"
        data: Any = self.field
        if isinstance(self.field, (str, Path)):
            name = str(self.field)
            with refusing(f"{name}: it cannot be read as a velocity field:"):
                data = xr.load_dataset(require_file(self.field))
        refuse_if(
            not isinstance(data, xr.Dataset) or any(component not in data for component in "uvwxyz"),
            f"{name}: it must be a data set with u, v and w on x, y and z",
        )
        try:
            axes = [as_array(axis, data[axis], np.float64) for axis in _AXES]
            parts = [
                as_array(component, data[component].transpose(*_AXES), np.float64, tuple(_AXES)) for component in "uvw"
            ]
        except ValueError:
            raise InputError(f"{name}: u, v and w must have the dimensions x, y and z, and no other") from None
        require_units(name, data, dict.fromkeys("uvw", _SPEEDS) | dict.fromkeys(_AXES, MILLIMETRES))
        for axis, values in zip(_AXES, axes, strict=True):
            refuse_if(len(values) < 2 or not (np.diff(values) > 0).all(), f"{name}: {axis} must rise, over two values")
        values = np.stack(parts, -1)
        refuse_if(not np.isfinite(values).all(), f"{name}: its velocities must be finite")
        put(self, field=name, _interpolated=RegularGridInterpolator(axes, values))

    def velocity(self, points: Points) -> Points:
        """Return the velocities at positions, which must be within the grid."""
        interpolated: RegularGridInterpolator = getattr(self, "_interpolated")  # noqa: B009
        bounds = np.array([(axis[0], axis[-1]) for axis in interpolated.grid])
        outside = ((points < bounds[:, 0]) | (points > bounds[:, 1])).any(1)
        if outside.any():
            where = ", ".join(f"{value:.4g}" for value in points[outside][0])
            grid = ", ".join(f"{low:g} to {high:g}" for low, high in bounds)
            raise InputError(f"flow: {self.field}: a particle at ({where}) leaves its grid, {grid} mm")
        return np.asarray(interpolated(points))


FLOWS: dict[str, Callable[..., Flow]] = {
    "uniform": Uniform,
    "shear": Shear,
    "taylor_green": TaylorGreen,
    "lamb_oseen": LambOseen,
    "hill": HillVortex,
    "file": ImportedFlow,
}
"""Flows by the names that the command and recipes call them."""
