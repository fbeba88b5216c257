"""Vignetting: the transmission of the main lens's pupil as it is seen from each place of the microlens array."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import partial
from typing import Any

from ..errors import put, put_checked, refuse_if, require_length, require_numbers, short_repr, suggest_keywords
from ..runtime import Pair, PlainData, exponents, known_record, module_of, monomials, select

_DEGREES = {1: 0, 3: 1, 6: 2, 10: 3, 15: 4}
"""Degree of a polynomial of two variables by its number of coefficients."""

_MAP_DEGREES = {0: 1, 3: 2, 7: 3, 12: 4, 18: 5, 25: 6}
"""Degree of the map over the pupil, without terms below the second, by its number of coefficients."""

_LARGEST = 100.0
"""Size of a coefficient at most."""


@suggest_keywords
@dataclass(frozen=True, eq=False)
class Vignetting(PlainData):
    r"""Pupil of a real camera over its field: outline, apodisation and slope, as a white picture shows them.

    Seen from a place (x, y) of the microlens array, the point :math:`(p_x, p_y)` of the pupil, in units of its radius,
    has the transmission

    .. math:: T = \max(0,\; 1 + s_x u + s_y v + a_2 r^2 + a_4 r^4 + \sum m_{ij} u^i v^j) \quad\text{for}\quad
        r = \sqrt{u^2 + v^2} \le 1 + \sum (c_k \cos k\varphi + d_k \sin k\varphi),
        \qquad u = \frac{(1 - e_x) p_x - e_y p_y}{\rho}, \quad v = \frac{(1 + e_x) p_y - e_y p_x}{\rho}

    and 0 elsewhere; :math:`\varphi` is the angle of (u, v). The m, c and d are the same over the field. Each of the
    other numbers is a polynomial of the place over a scale, whose 1, 3, 6, 10 or 15 coefficients
    are those of 1; X, Y; :math:`X^2`, X Y, :math:`Y^2`; and so on, :math:`X = x / scale`. Coordinates are those of the
    camera frame. What the pupil's rim, at `aperture_radius`, cuts stays dark, so that :math:`\rho` above 1 has no
    effect. Light is weighted by T after the main lens: in wave captures of scenes, too, light diffracts at the rim
    alone. Light of points has the amplitude :math:`\sqrt{T}` behind the pupil, where (x, y) is the place at which its
    ray through the pupil point meets the array, and diffracts at the outline, too.

    Parameters
    ----------
    radius : list of float
        Radius :math:`\rho` of the pupil's outline.
    scale : float
        Length in millimetres by which places are divided, such as half the detector's width.
    ellipse_x, ellipse_y : list of float
        Elongation :math:`e_x` along x, and :math:`e_y` along the diagonal.
    slope_x, slope_y : list of float
        Rise of the transmission, :math:`s_x` and :math:`s_y`.
    apodisation_2, apodisation_4 : list of float
        Coefficients :math:`a_2` and :math:`a_4`.
    transmission : list of float
        Map over the pupil: the coefficients :math:`m_{ij}` of :math:`u^2`, u v, :math:`v^2`; :math:`u^3`, and so on, of
        up to sixth degree.
    harmonics : list of float
        Coefficients of an outline that is no ellipse, as of an iris: :math:`c_3, d_3, c_4, d_4`, and so on, up to the
        16th.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> towards_the_border = mp.Vignetting(radius=[1, 0, 0, -0.1, 0, -0.1], scale=4.0)
    >>> round(float(towards_the_border.power(0.95, 0.0, 4.0, 0.0)), 3)
    0.0
    """

    radius: Any
    scale: float = 1.0
    ellipse_x: Any = (0.0,)
    ellipse_y: Any = (0.0,)
    slope_x: Any = (0.0,)
    slope_y: Any = (0.0,)
    apodisation_2: Any = (0.0,)
    apodisation_4: Any = (0.0,)
    transmission: Any = ()
    harmonics: Any = ()

    def __post_init__(self) -> None:
        put_checked(self, scale=require_length)
        shared = {"transmission": tuple(_MAP_DEGREES), "harmonics": tuple(range(0, 29, 2))}
        for name in (*VIGNETTING_NUMBERS, *shared):
            value = getattr(self, name)
            values = (value,) if isinstance(value, (int, float)) else tuple(value) if hasattr(value, "__iter__") else ()
            allowed = shared.get(name, tuple(_DEGREES))
            counts = ", ".join(map(str, allowed))
            refuse_if(len(values) not in allowed, f"{name} = {short_repr(value)}: it has {counts} coefficients")
            put(self, **{name: require_numbers(name, values, count=len(values), minimum=-_LARGEST, maximum=_LARGEST)})

    def at(self, x: Any, y: Any) -> dict[str, Any]:
        """Return the numbers by name at places of the array in millimetres."""
        degree = max(_DEGREES[len(getattr(self, name))] for name in VIGNETTING_NUMBERS)
        terms = monomials(x * (1 / self.scale), y * (1 / self.scale), exponents(degree))
        return {
            name: sum(value * term for value, term in zip(getattr(self, name), terms, strict=False) if value)
            for name in VIGNETTING_NUMBERS
        }

    def power(self, px: Any, py: Any, x: Any, y: Any) -> Any:
        """Return the transmission of pupil points, in units of the pupil's radius, seen from places in millimetres.

        Parameters
        ----------
        px, py : array
            Coordinates on the pupil in the camera frame over its radius.
        x, y : array
            Places on the array in the camera frame, in millimetres.
        """
        square, edge, _, value = self._within(px, py, x, y)
        return select(square <= edge * edge, value, 0.0)

    def outline(self, px: Any, py: Any, x: Any, y: Any) -> Pair:
        """Return the distance from the outline, positive inside, and the transmission as if the outline were wider.

        Parameters are those of `power`. The distance is in units of the pupil's radius, to first order.
        """
        square, edge, radius, value = self._within(px, py, x, y)
        return radius * (edge - module_of(square).sqrt(square)), value

    def _within(self, px: Any, py: Any, x: Any, y: Any) -> tuple[Any, Any, Any, Any]:
        """Return r^2, its root's limit, the outline's radius, and the transmission regardless of the outline."""
        n = self.at(x, y)
        # Far beyond the detector polynomials may have any value; 1e-4 is the smallest radius, over the pupil's.
        radius = module_of(px * x).maximum(n["radius"], 1e-4)
        u = ((1 - n["ellipse_x"]) * px - n["ellipse_y"] * py) / radius
        v = ((1 + n["ellipse_x"]) * py - n["ellipse_y"] * px) / radius
        square = u * u + v * v
        types = module_of(square)
        slope = n["slope_x"] * u + n["slope_y"] * v
        value = 1 + slope + square * (n["apodisation_2"] + n["apodisation_4"] * square)
        terms = monomials(u, v, exponents(_MAP_DEGREES[len(self.transmission)], 2))
        for coefficient, term in zip(self.transmission, terms, strict=True):
            value = value + coefficient * term
        edge = 1.0
        if self.harmonics:
            length = types.sqrt(types.maximum(square, 1e-12))
            cosine = u / length
            sine = v / length
            real = cosine * cosine - sine * sine
            imaginary = 2 * cosine * sine
            for even, odd in zip(self.harmonics[::2], self.harmonics[1::2], strict=True):
                real, imaginary = real * cosine - imaginary * sine, real * sine + imaginary * cosine
                edge = edge + even * real + odd * imaginary
            edge = types.maximum(edge, 0)
        return square, edge, radius, types.maximum(value, 0)

    def __str__(self) -> str:
        return f"Vignetting(radius={short_repr(self.radius)}, ...)"


VIGNETTING_NUMBERS = tuple(field.name for field in fields(Vignetting)[:-2] if field.name != "scale")
"""Names of the polynomials over the field."""

known_vignetting = partial(known_record, Vignetting, "vignetting")
"""Return vignetting from any of its forms; None means none."""
