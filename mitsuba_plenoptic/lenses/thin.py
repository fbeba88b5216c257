"""A thin main lens with aberrations and, in the ray model, with distortion; `MainLens` documents its methods.

Aberrations are Zernike polynomials over the pupil. The polynomials are in Noll's order, each with root mean square 1
over the pupil (R. J. Noll, "Zernike polynomials and atmospheric turbulence", 1976). They are evaluated as polynomials
of x and y, whose derivatives are again polynomials.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PhaseScreen
from ..errors import WAVEFRONT_UNIT
from ..optics import rays
from ..optics.waves import in_millimetres, parabola
from ..prescription.lens_data import SINGLE, vergence
from ..runtime import sqrt
from .common import FinitePupil, LensNumbers, UniformLens, builds
from .distortion import undistort
from .main_lens import Pair, Traced


def noll(j: int) -> tuple[int, int]:
    """Return the radial order n and the azimuthal order m (negative for sines) of Noll index j."""
    n = (math.isqrt(8 * j - 7) - 1) // 2
    position = j - n * (n + 1) // 2 - 1
    m = (-1) ** j * (n % 2 + 2 * ((position + (n + 1) % 2) // 2))
    return n, m


@functools.cache
def zernike(j: int) -> NDArray[np.float64]:
    """Return the coefficients of a Zernike polynomial; element [a, b] belongs to x^a y^b."""
    n, m = noll(j)
    order = abs(m)
    result = np.zeros((n + 1, n + 1))
    for k in range((n - order) // 2 + 1):
        radial = (-1) ** k * math.comb(n - k, k) * math.comb(n - 2 * k, (n - order) // 2 - k)
        half = (n - order) // 2 - k  # (x^2 + y^2)^half times the real or imaginary part of (x + i y)^order
        for i in range(half + 1):
            for p in range(order + 1):
                if p % 2 == (m < 0):
                    sign = (-1) ** (p // 2)
                    result[2 * i + order - p, 2 * (half - i) + p] += (
                        radial * math.comb(half, i) * math.comb(order, p) * sign
                    )
    return result * math.sqrt((n + 1) * (1 if m == 0 else 2))


class Wavefront:
    """Path over the pupil in mm: a sum of Zernike polynomials and an optional phase screen."""

    def __init__(
        self,
        # In waves of 633 nm, from Noll index 1 on.
        coefficients: Any,
        # Radius of the pupil, in millimetres.
        radius: Any,
        screen: PhaseScreen | None = None,
    ) -> None:
        self._radius, self._screen = radius, screen
        size = max((len(zernike(j)) for j in range(1, len(coefficients) + 1)), default=0)
        self._terms: list[list[Any]] = [[0.0] * (size - a) for a in range(size)]
        for j, coefficient in enumerate(coefficients, 1):
            for (a, b), factor in np.ndenumerate(zernike(j)):
                if factor:
                    self._terms[a][b] = self._terms[a][b] + coefficient * float(factor)

    def path(self, x: Any, y: Any) -> Any:
        """Return the path difference in mm at a point of the pupil."""
        u, v = x / self._radius, y / self._radius
        path = _sum([_sum(row, v) for row in self._terms], u) * in_millimetres(WAVEFRONT_UNIT)
        return path if self._screen is None else path + self._screen.path(x, y)

    def slope(self, x: Any, y: Any) -> Pair:
        """Return the derivatives of `path` along x and y, which are changes of direction."""
        u, v = x / self._radius, y / self._radius
        scale = in_millimetres(WAVEFRONT_UNIT) / self._radius
        along_x = _sum([_sum([a * term for term in row], v) for a, row in enumerate(self._terms)][1:], u)
        along_y = _sum([_sum([b * term for b, term in enumerate(row)][1:], v) for row in self._terms], u)
        along_x, along_y = along_x * scale, along_y * scale
        if self._screen is None:
            return along_x, along_y
        own = self._screen.slopes(x, y)
        return along_x + own[0], along_y + own[1]


def _sum(terms: list[Any], x: Any) -> Any:
    """Return the value of a polynomial in x, by Horner's rule."""
    total: Any = 0.0
    for term in reversed(terms):
        total = total * x + term
    return total


_ROUNDING = 1e-9
"""Distance outside a round pupil, over its radius, up to which a point counts as on its edge."""


@dataclass(frozen=True)
class ThinLens(UniformLens, FinitePupil):
    r"""A thin lens with a round pupil, optional aberrations and an optional phase screen.

    Parameters
    ----------
    focal_length : float or Dr.Jit array
        Focal length :math:`f_1`.
    pupil_radius : float or Dr.Jit array
        Radius :math:`D_1 / 2`.
    pupil_distance : float or Dr.Jit array
        Distance b to the MLA.
    model : {"ideal", "parabolic"}
        ``"ideal"`` is stigmatic for every point and refracts rays by slopes. ``"parabolic"`` is a thin parabolic phase
        and refracts rays by direction cosines.
    aberrations : floats or Dr.Jit arrays
        Coefficients of Zernike polynomials, see `wavefront`.
    screen : PhaseScreen, optional
        A path that light gains in addition.
    """

    focal_length: Any
    pupil_radius: Any
    pupil_distance: Any
    model: str = "ideal"
    aberrations: Any = ()
    screen: PhaseScreen | None = None
    _wavefront: Wavefront = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # Computed at once: a value first computed while Dr.Jit suspends gradients would never carry any.
        object.__setattr__(self, "_wavefront", Wavefront(self.aberrations, self.pupil_radius, self.screen))

    @property
    def is_round(self) -> bool:
        """Whether the lens has neither aberrations nor a phase screen."""
        return len(self.aberrations) == 0 and self.screen is None

    @property
    def refraction(self) -> Any:
        """Focal length in mm, which determines how the lens refracts rays."""
        return self.focal_length

    def vergence(self, distance: Any) -> Any:
        r"""Return :math:`1/g' = 1/f_1 - 1/g` in 1/mm, the image vergence; at most 0 where there is no real image."""
        return vergence(self.focal_length, distance)

    def trace(self, position: Pair, slope: Pair) -> Traced:
        """Return the ray from a position on the MLA to the scene."""
        Px, Py = (rays.pupil_point(m, t, self.pupil_distance) for m, t in zip(position, slope, strict=True))
        return (Px, Py, 0.0), self.refract(slope, (Px, Py)), Px * Px + Py * Py <= self.pupil_radius * self.pupil_radius

    def refract(self, slope: Pair, pupil: Pair) -> Pair:
        """Return a ray's slopes before the lens from its slopes between lens and MLA."""
        turned = slope if self.model == "ideal" else rays.slopes_to_cosines(*slope)
        tx, ty = (rays.main_lens_slope(t, P, self.focal_length) for t, P in zip(turned, pupil, strict=True))
        if not self.is_round:
            sx, sy = self._wavefront.slope(*pupil)
            tx, ty = tx + sx, ty + sy
        return (tx, ty) if self.model == "ideal" else rays.cosines_to_slopes(tx, ty)

    def convergence(self, distance: Any) -> Any:
        """Return `vergence`, as a thin lens is its own pupil."""
        return self.vergence(distance)

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the MLA through a pupil point, which may lie on the edge up to rounding."""
        (Px, Py), largest = pupil, self.pupil_radius * (1 + SINGLE)
        tx, ty = ((P - q) / self.pupil_distance for P, q in zip(pupil, position, strict=True))
        return (Px, Py, 0.0), self.refract((tx, ty), pupil), Px * Px + Py * Py <= largest * largest

    def varying(self, numbers: Mapping[str, Any], names: Container[str], turned: Any) -> ThinLens:
        """Return the lens with Dr.Jit parameters that carry gradients."""
        f1, radius, b = numbers["focal_length"], numbers["aperture_radius"], numbers["mla_distance"]
        return replace(self, focal_length=f1, pupil_radius=radius, pupil_distance=b, aberrations=numbers["wavefront"])

    def opaque(self, number: Callable[[Any], Any]) -> ThinLens:
        """Return the lens with parameters that are not compiled into kernels."""
        names = "focal_length", "pupil_radius", "pupil_distance"
        aberrations = [number(value) for value in self.aberrations]
        return replace(self, **{name: number(getattr(self, name)) for name in names}, aberrations=aberrations)

    def start_bounds(self, field: float) -> tuple[float, tuple[float, ...]]:
        """Return radius and z of the pupil, where all rays start, in mm."""
        return self.pupil_radius, (0.0,)

    def images(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions (n, 2) on the MLA of the rays from scene points (n, 3) through the pupil's centre."""
        return np.asarray(rays.conjugate_coordinate(points[:, :2], points[:, 2:], self.pupil_distance))

    def inverse_distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reciprocals (n,) of the distances of scene points."""
        return np.asarray(1 / points[:, 2])

    def points(self, images: NDArray[np.float64], inverse_distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scene points (n, 3) with given `images` and `inverse_distance`."""
        distance = 1 / inverse_distance[:, None]
        return np.hstack([images * (-distance / self.pupil_distance), distance])

    def land(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Pair:
        """Return the position on the MLA of the ray from a scene point through a pupil point, with aberrations."""
        b, f1, g = self.pupil_distance, self.focal_length, point[2]
        if self.model != "ideal":
            slopes = rays.cosines_to_slopes(*self.cosines(pupil, point))
            return pupil[0] + b * slopes[0], pupil[1] + b * slopes[1]
        x, y = (rays.mla_point(X, P, g, b, f1) for X, P in zip(point[:2], pupil, strict=True))
        if not self.is_round:
            sx, sy = self._wavefront.slope(*pupil)
            x, y = x + b * sx, y + b * sy
        return x, y

    def path(self, pupil: Pair, point: tuple[Any, Any, Any], wavelength: float) -> Any:
        r"""Return the path in waves from a scene point X to a pupil point P, less the path to the pupil's centre.

        With aberrations W, a thin parabolic phase has the path :math:`(|P - X| - |X| - P^2 / 2 f_1 + W(P)) / \lambda`
        (Goodman, "Introduction to Fourier Optics", section 5.1). Behind an ideal lens all paths to the image X' are
        equal, which leaves :math:`(|X'| - |P - X'| + W(P)) / \lambda`. Both are computed without cancellation.

        Parameters
        ----------
        pupil : (array, array)
            Point on the exit pupil in millimetres.
        point : (array, array, array)
            Scene point in the camera frame in millimetres.
        wavelength : float
            Wavelength in nanometres.
        """
        (Px, Py), (X, Y, g) = pupil, point
        square = Px * Px + Py * Py
        if self.model == "ideal":
            # Slopes towards the image from the pupil's centre and from P, with the opposite sign.
            v = self.vergence(g)
            u, w = X / g, Y / g
            lengths = sqrt(1 + u * u + w * w) + sqrt(1 + (Px * v + u) ** 2 + (Py * v + w) ** 2)
            ideal = -(square * v + 2 * (Px * u + Py * w)) / lengths
            return (ideal if self.is_round else ideal + self._wavefront.path(Px, Py)) * (1 / in_millimetres(wavelength))
        axis = _signed(sqrt(X * X + Y * Y + g * g), g)
        difference = (square - 2 * (Px * X + Py * Y)) / (_distance(pupil, point) + axis)
        waves = difference * (1 / in_millimetres(wavelength)) + parabola(square, self.focal_length, wavelength)
        return waves if self.is_round else waves + self._wavefront.path(Px, Py) * (1 / in_millimetres(wavelength))

    def paraxial_path(self, pupil: Pair, distance: Any, wavelength: float) -> Any:
        r"""Return :math:`(-P^2 / 2 g' + W(P)) / \lambda`, the paraxial path in waves of all points at one distance g.

        Where light moves by slopes (see `mitsuba_plenoptic.optics.waves.transfer`), parabolas replace the spheres
        around points, and differ by tilts only. Tilts are left out.
        """
        (Px, Py), scale = pupil, 1 / in_millimetres(wavelength)
        waves = (Px * Px + Py * Py) * (self.vergence(distance) * (-0.5 * scale))
        return waves if self.is_round else waves + self.aberration(pupil, wavelength)

    def aberration(self, pupil: Pair, wavelength: float) -> Any:
        """Return the path W(P), in waves, that light gains at a pupil point by aberrations and a phase screen."""
        Px, Py = pupil
        return 0 * Px + self._wavefront.path(Px, Py) * (1 / in_millimetres(wavelength))

    def amplitude(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Any:
        r"""Return the amplitude :math:`|g| / |P - X|^2`, the first Rayleigh-Sommerfeld solution (Goodman, 3.5)."""
        length = _distance(pupil, point)
        return abs(point[2]) / (length * length)

    def inside(self, pupil: Pair) -> Any:
        """Return the distance in mm of a point from the edge of the pupil, positive inside."""
        return self.pupil_radius - sqrt(pupil[0] * pupil[0] + pupil[1] * pupil[1])

    def is_open(self, pupil: Pair) -> Any:
        """Return whether a point lies inside the pupil or, up to rounding, on its edge."""
        return self.inside(pupil) >= -_ROUNDING * self.pupil_radius

    def cosines(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Pair:
        r"""Return a point's direction cosines, :math:`(P - X) / |P - X| - P / f_1`, plus the slope of the aberrations.

        Behind an ideal lens the direction is that towards the image.
        """
        sx: Any
        sy: Any
        if self.model == "ideal":
            v = self.vergence(point[2])
            towards = (-(P * v + X / point[2]) for P, X in zip(pupil, point[:2], strict=True))
            sx, sy = rays.slopes_to_cosines(*towards)
        else:
            length = _distance(pupil, point)
            sx, sy = ((P - X) / length - P / self.focal_length for P, X in zip(pupil, point[:2], strict=True))
        if not self.is_round:
            x, y = self._wavefront.slope(*pupil)
            sx, sy = sx + x, sy + y
        return sx, sy

    def path_change(self, radius: Any, step: Any, wavelength: float) -> Any:
        r"""Return the change of path :math:`a (a^2 + 3 r^2) d / 2 b^3 \lambda` for the pupil's radius a and the step d.

        For an ideal lens this is an upper bound: its light changes with the field only as defocus in tilted cones.
        """
        a, b = self.pupil_radius, self.pupil_distance
        return a * (a * a + 3 * radius * radius) * step / (2 * b**3 * in_millimetres(wavelength))


def _distance(pupil: Pair, point: tuple[Any, Any, Any]) -> Any:
    """Return the distance |P - X| in mm, negative for light that converges to a point behind the lens."""
    dx, dy, g = pupil[0] - point[0], pupil[1] - point[1], point[2]
    return _signed(sqrt(dx * dx + dy * dy + g * g), g)


def _signed(length: Any, g: Any) -> Any:
    return dr.copysign(length, g) if dr.is_array_v(length) else np.copysign(length, g)


_STEPS = 12
"""Iterations that find the position on the MLA from the undistorted one."""


@dataclass(frozen=True)
class DistortedLens(ThinLens):
    """A thin lens with distortion, whose rays continue as if from another MLA point; for the ray model only.

    Parameters
    ----------
    distortion : five floats
        See `mitsuba_plenoptic.lenses.distortion`.
    """

    distortion: tuple[float, ...] = (0.0,) * 5

    def trace(self, position: Pair, slope: Pair) -> Traced:
        """Return the ray from a position on the MLA through an unchanged pupil point to the scene."""
        source = undistort(*position, self.distortion)
        moved = (t + (m - u) / self.pupil_distance for t, m, u in zip(slope, position, source, strict=True))
        return super().trace(source, (next(moved), next(moved)))

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the MLA through a pupil point, without a test of the pupil's edge."""
        return super().ray(pupil, undistort(*position, self.distortion))

    def images(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the positions (n, 2) on the MLA of the rays from scene points (n, 3) through the pupil's centre."""
        x, y = super().images(points).T
        return np.stack(self._distort((x, y)), -1)

    def land(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Pair:
        """Return the position on the MLA of the ray from a scene point through a pupil point, with aberrations."""
        return self._distort(super().land(pupil, point))

    def _distort(self, image: Pair) -> Pair:
        """Return the positions on the MLA of which `undistort` makes given ones."""
        (x, y), (u, v) = image, image
        # Each step multiplies the error by the derivative of the displacement, some per cent.
        for _ in range(_STEPS):
            moved = undistort(x, y, self.distortion)
            x, y = x + u - moved[0], y + v - moved[1]
        return x, y


@builds(type(None))
def thin_lens(numbers: LensNumbers) -> ThinLens:
    """Return the main lens of a camera without an objective or prescription."""
    own = (
        *(numbers.focal_length, numbers.aperture_radius, numbers.mla_distance, numbers.model, numbers.wavefront),
        numbers.camera.phase_screen,
    )
    if any(numbers.camera.distortion):
        return DistortedLens(*own, numbers.camera.distortion)
    return ThinLens(*own)
