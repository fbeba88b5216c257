r"""Steady flows with exact displacements: velocities in millimetres per second at positions in the camera frame.

All but imported ones are free of divergence, so that particles that are spread evenly stay so. A new flow is a frozen
dataclass with `velocity`, and an entry in `FLOWS`; a flow without a closed form of its paths has them integrated.
"""

import math
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.interpolate import RegularGridInterpolator

from ...errors import InputError, put, put_checked, refuse_if, refusing, require_choice, require_length, require_number
from ...runtime import MILLIMETRES, Doubles, Named, Numbers, as_array, require_file, require_units
from .seeding import PLACE

_AXES = ("x", "y", "z")
_AXIS = partial(require_choice, choices=_AXES)
_SPEED = partial(require_number, minimum=-1e9, maximum=1e9)
"""Rules of an axis, and of a velocity or what it is proportional to."""


class Flow:
    """A steady flow."""

    def velocity(self, points: Doubles) -> Doubles:
        """Return the velocities at positions."""
        raise NotImplementedError

    def advected(self, points: Doubles, time: float) -> Doubles:
        """Return where particles at positions (n, 3) in mm are after a time in seconds, which may be negative."""
        if time == 0 or not len(points):
            return points.copy()
        paths = solve_ivp(
            lambda _, state: self.velocity(state.reshape(-1, 3)).ravel(),
            (0.0, time),
            points.ravel(),
            method="DOP853",
            rtol=1e-11,
            atol=1e-11,
        )
        refuse_if(not paths.success, f"flow: paths over {time:g} s cannot be followed: {paths.message}")
        return paths.y[:, -1].reshape(-1, 3)


class ParallelFlow(Flow):
    """A flow in which each particle keeps its velocity."""

    def advected(self, points: Doubles, time: float) -> Doubles:
        """Return where particles at positions (n, 3) in mm are after a time in seconds, which may be negative."""
        return points + time * self.velocity(points)


class Vortex(Flow):
    """A flow about an axis.

    Parameters
    ----------
    axis : {"x", "y", "z"}
        Axis about which it turns.
    centre : (float, float, float)
        The vortex's centre in mm: for vortices that are alike along the axis, a point of it.
    """

    axis: str
    centre: Numbers

    def __post_init__(self) -> None:
        # A vortex's first field is its strength, and the second its size.
        strength, size, *_ = (field.name for field in fields(self))  # type: ignore[arg-type]
        rules: Named = {strength: _SPEED, size: require_length}
        put_checked(self, **rules, axis=_AXIS, centre=PLACE)

    def velocity(self, points: Doubles) -> Doubles:
        """Return the velocities at positions."""
        turned = -1 - _AXES.index(self.axis)
        around = self._around(*np.roll(points - self.centre, turned, axis=1).T)
        return np.roll(np.stack(np.broadcast_arrays(*around), -1), -turned, axis=1)

    def _around(self, p: Doubles, q: Doubles, along: Doubles) -> tuple[Doubles | float, ...]:
        """Return the velocity at places from the centre; p, q and the axis are right-handed."""
        raise NotImplementedError


@dataclass(frozen=True)
class Uniform(ParallelFlow):
    """The same velocity everywhere.

    Parameters
    ----------
    speed : (float, float, float)
        Velocity along x, y and z in mm/s.
    """

    speed: Numbers = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        put_checked(self, speed=PLACE)

    def velocity(self, points: Doubles) -> Doubles:
        """Return the velocities at positions."""
        return np.broadcast_to(np.array(self.speed), points.shape)


@dataclass(frozen=True)
class Shear(ParallelFlow):
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
    centre: Numbers = (0.0, 0.0, 240.0)

    def __post_init__(self) -> None:
        put_checked(self, rate=_SPEED, along=_AXIS, across=_AXIS, centre=PLACE)
        refuse_if(self.along == self.across, f"along = {self.along}, across = {self.across}: they must differ")

    def velocity(self, points: Doubles) -> Doubles:
        """Return the velocities at positions."""
        along, across = (np.eye(3)[_AXES.index(axis)] for axis in (self.along, self.across))
        return self.rate * ((points - self.centre) @ across)[:, None] * along


@dataclass(frozen=True)
class TaylorGreen(Vortex):
    """Rows of square vortices that turn about one axis, each against its neighbours (Taylor and Green 1937).

    The `centre` is a corner of four vortices.

    Parameters
    ----------
    speed : float
        Largest velocity in mm/s.
    length : float
        Width of a vortex in mm.
    """

    speed: float = 1.0
    length: float = 2.0
    axis: str = "z"
    centre: Numbers = (0.0, 0.0, 240.0)

    def _around(self, p: Doubles, q: Doubles, along: Doubles) -> tuple[Doubles | float, ...]:
        p, q = p * math.pi / self.length, q * math.pi / self.length
        return self.speed * np.sin(p) * np.cos(q), -self.speed * np.cos(p) * np.sin(q), 0.0


@dataclass(frozen=True)
class LambOseen(Vortex):
    r"""A line vortex with a core, at one moment: :math:`v = \Gamma / 2 \pi r \, (1 - e^{-r^2 / c^2})` (Lamb 1932).

    Parameters
    ----------
    circulation : float
        Circulation :math:`\Gamma` in mm^2/s.
    core : float
        Radius c of the core in mm.
    """

    circulation: float = 10.0
    core: float = 0.5
    axis: str = "z"
    centre: Numbers = (0.0, 0.0, 240.0)

    def _around(self, p: Doubles, q: Doubles, along: Doubles) -> tuple[Doubles | float, ...]:
        # On the axis (1 - exp(-s)) / s is 1, also of the smallest s.
        square = np.maximum((p * p + q * q) / self.core**2, 1e-300)
        turning = self.circulation / (2 * math.pi * self.core**2) * -np.expm1(-square) / square
        return -turning * q, turning * p, 0.0


@dataclass(frozen=True)
class HillVortex(Vortex):
    r"""Hill's spherical vortex, which stands in a stream of velocity :math:`-U` along its axis (Hill 1894).

    The stream function is :math:`\tfrac34 U r^2 (1 - R^2 / a^2)` within the sphere of radius a, and
    :math:`-\tfrac12 U r^2 (1 - a^3 / R^3)` outside; R is the distance from the centre, r that from the axis.

    Parameters
    ----------
    speed : float
        Velocity U in mm/s.
    radius : float
        Radius a of the sphere in mm.
    """

    speed: float = 1.0
    radius: float = 2.0
    axis: str = "z"
    centre: Numbers = (0.0, 0.0, 240.0)

    def _around(self, p: Doubles, q: Doubles, along: Doubles) -> tuple[Doubles | float, ...]:
        p, q, along = p / self.radius, q / self.radius, along / self.radius
        square = p * p + q * q
        distance = np.sqrt(square + along * along).clip(1)
        bent = 1.5 * self.speed / distance**5
        stream = np.where(
            distance > 1,
            -self.speed * (1 - distance**-3.0) - bent * square,
            1.5 * self.speed * (1 - 2 * square - along * along),
        )
        return bent * along * p, bent * along * q, stream


@dataclass(frozen=True)
class ImportedFlow(Flow):
    """A velocity field on a regular grid, linear between its nodes.

    The NetCDF file, or `xarray.Dataset`, has the variables u, v and w, in mm/s along x, y and z of the camera frame, on
    the dimensions x, y and z in mm. Attributes ``units`` that say otherwise are refused.

    Parameters
    ----------
    field : path or xarray.Dataset
        The file or the data set.
    """

    field: str | Path | xr.Dataset

    def __post_init__(self) -> None:
        name = "field"
        data = self.field
        if isinstance(data, (str, Path)):
            name = str(data)
            with refusing(f"{name}: it cannot be read as a velocity field:"):
                data = xr.load_dataset(require_file(data))
        refuse_if(
            not isinstance(data, xr.Dataset) or not {*"uvwxyz"} <= {*data.variables},
            f"{name}: it must be a data set with u, v and w on x, y and z",
        )
        speed = ("mm/s", "mm s-1", "mm s^-1", "mm.s-1")
        require_units(name, data, dict.fromkeys("uvw", speed) | dict.fromkeys(_AXES, MILLIMETRES))
        with refusing(f"{name}: u, v and w must be on axes x, y and z that rise, and on no other:", ValueError):
            values = np.stack([as_array(part, data[part].transpose(*_AXES), _AXES) for part in "uvw"], -1)
            flow = RegularGridInterpolator([as_array(axis, data[axis]) for axis in _AXES], values)
        refuse_if(min(values.shape) < 2 or not np.isfinite(values).all(), f"{name}: give two finite values or more")
        put(self, field=name, _interpolated=flow)

    def velocity(self, points: Doubles) -> Doubles:
        """Return the velocities at positions, which must be within the grid."""
        flow = vars(self)["_interpolated"]
        bounds = np.array([(axis[0], axis[-1]) for axis in flow.grid])
        outside = ((points < bounds[:, 0]) | (points > bounds[:, 1])).any(1)
        if outside.any():
            where = ", ".join(f"{value:.4g}" for value in points[outside][0])
            grid = ", ".join(f"{low:g} to {high:g}" for low, high in bounds)
            raise InputError(f"flow: {self.field}: a particle at ({where}) leaves its grid, {grid} mm")
        return flow(points)


FLOWS = {
    "uniform": Uniform,
    "shear": Shear,
    "taylor_green": TaylorGreen,
    "lamb_oseen": LambOseen,
    "hill": HillVortex,
    "file": ImportedFlow,
}
"""Flows by the names that the command and recipes call them."""
