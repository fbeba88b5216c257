"""A thin main lens with aberrations and, in the ray model, with distortion; `MainLens` documents its methods.

Aberrations are Zernike polynomials over the pupil. The polynomials are in Noll's order, each with root mean square 1
over the pupil (R. J. Noll, "Zernike polynomials and atmospheric turbulence", 1976). They are evaluated as polynomials
of x and y, whose derivatives are again polynomials.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Container
from dataclasses import dataclass, field, replace
from typing import Any, cast

import drjit as dr
import numpy as np

from ..camera import PhaseScreen
from ..errors import WAVEFRONT_UNIT
from ..optics import in_millimetres, parabola, rays
from ..prescription import SINGLE, Collimator, vergence
from ..runtime import Doubles, Facts, Numbers, Pair, Shape, Triple, sqrt
from .accuracy import ACCURACY
from .closed_lens import ClosedLens
from .common import LensNumbers, builds
from .distortion import undistort
from .protocol import Entrance, Traced
from .pupil import Pupil


def noll(j: int) -> Shape:
    """Return the radial order n and the azimuthal order m (negative for sines) of Noll index j."""
    n = (math.isqrt(8 * j - 7) - 1) // 2
    position = j - n * (n + 1) // 2 - 1
    m = (-1) ** j * (n % 2 + 2 * ((position + (n + 1) % 2) // 2))
    return n, m


@functools.cache
def zernike(j: int) -> Doubles:
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
    ):
        self._radius = radius
        self._screen = screen
        size = max((len(zernike(j)) for j in range(1, len(coefficients) + 1)), default=0)
        self._terms = [[0.0] * (size - a) for a in range(size)]
        for j, coefficient in enumerate(coefficients, 1):
            for (a, b), factor in np.ndenumerate(zernike(j)):
                if factor:
                    self._terms[a][b] = self._terms[a][b] + coefficient * float(factor)

    def path(self, x: Any, y: Any) -> Any:
        """Return the path difference in mm at a point of the pupil."""
        u = x / self._radius
        v = y / self._radius
        path = _sum([_sum(row, v) for row in self._terms], u) * in_millimetres(WAVEFRONT_UNIT)
        return path if self._screen is None else path + self._screen.path(x, y)

    def slope(self, x: Any, y: Any) -> Pair:
        """Return the derivatives of `path` along x and y, which are changes of direction."""
        u = x / self._radius
        v = y / self._radius
        scale = in_millimetres(WAVEFRONT_UNIT) / self._radius
        along_x = _sum([_sum([a * term for term in row], v) for a, row in enumerate(self._terms)][1:], u)
        along_y = _sum([_sum([b * term for b, term in enumerate(row)][1:], v) for row in self._terms], u)
        along_x = along_x * scale
        along_y = along_y * scale
        if self._screen is None:
            return along_x, along_y
        added = self._screen.slopes(x, y)
        return along_x + added[0], along_y + added[1]


def _sum(terms: list, x: Any) -> Any:
    """Return the value of a polynomial in x, by Horner's rule."""
    total = 0.0
    for term in reversed(terms):
        total = total * x + term
    return total


_DIRECTIONS = 6
"""Directions of pairs of points of the pupil."""


@dataclass(frozen=True)
class ThinLens(ClosedLens):
    r"""A thin lens with a round pupil, optional aberrations and an optional phase screen.

    Parameters
    ----------
    focal_length : float or Dr.Jit array
        Focal length :math:`f_1`.
    pupil : Pupil
        The lens itself, of the radius :math:`D_1 / 2` at the distance b before the MLA. A telescope with a collimator
        is a lens without power whose pupil is imaged onto the array.
    model : {"ideal", "parabolic"}
        ``"ideal"`` is stigmatic for every point and refracts rays by slopes. ``"parabolic"`` is a thin parabolic phase
        and refracts rays by direction cosines.
    aberrations : floats or Dr.Jit arrays
        Coefficients of Zernike polynomials, see `wavefront`.
    screen : PhaseScreen, optional
        A path that light gains in addition.
    """

    focal_length: Any
    pupil: Pupil
    model: str = "ideal"
    aberrations: Any = ()
    screen: PhaseScreen | None = None
    _wavefront: Wavefront = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # Computed at once: a value first computed while Dr.Jit suspends gradients would never carry any.
        object.__setattr__(self, "_wavefront", Wavefront(self.aberrations, self.pupil.radius, self.screen))

    @property
    def is_round(self) -> bool:
        """Whether the lens has neither aberrations nor a phase screen."""
        return len(self.aberrations) == 0 and self.screen is None

    @property
    def entrance(self) -> Entrance:
        """Entrance pupil, which is the lens itself."""
        return Entrance(radius=self.pupil.radius)

    def vergence(self, distance: Any) -> Any:
        r"""Return :math:`1/g' = 1/f_1 - 1/g` in 1/mm, the image vergence; at most 0 where there is no real image."""
        return vergence(self.focal_length, distance)

    def trace(self, position: Pair, slope: Pair) -> Traced:
        """Return the ray from a position on the MLA to the scene."""
        Px, Py = (self.pupil.point(m, t) for m, t in zip(position, slope, strict=True))
        return (Px, Py, 0.0), self.refract(slope, (Px, Py)), Px * Px + Py * Py <= self.pupil.radius * self.pupil.radius

    def refract(self, slope: Pair, pupil: Pair) -> Pair:
        """Return a ray's slopes before the lens from its slopes between lens and MLA."""
        turned = slope if self.model == "ideal" else rays.slopes_to_cosines(*slope)
        tx, ty = (rays.main_lens_slope(t, P, self.focal_length) for t, P in zip(turned, pupil, strict=True))
        if not self.is_round:
            sx, sy = self._wavefront.slope(*pupil)
            tx = tx + sx
            ty = ty + sy
        return (tx, ty) if self.model == "ideal" else rays.cosines_to_slopes(tx, ty)

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the MLA through a pupil point, which may lie on the edge up to rounding."""
        Px, Py = pupil
        largest = self.pupil.radius * (1 + SINGLE)
        tx, ty = (self.pupil.slope(P, q) for P, q in zip(pupil, position, strict=True))
        return (Px, Py, 0.0), self.refract((tx, ty), pupil), Px * Px + Py * Py <= largest * largest

    def varying(self, numbers: Facts, names: Container[str], turned: Any) -> ThinLens:
        """Return the lens with Dr.Jit parameters that carry gradients."""
        pupil = Pupil(numbers["aperture_radius"], numbers["mla_distance"])
        return replace(self, focal_length=numbers["focal_length"], pupil=pupil, aberrations=numbers["wavefront"])

    def opaque(self, convert: Callable[[Any], Any]) -> ThinLens:
        """Return the lens with parameters that are not compiled into kernels."""
        pupil = replace(self.pupil, radius=convert(self.pupil.radius), distance=convert(self.pupil.distance))
        aberrations = [convert(value) for value in self.aberrations]
        return replace(self, focal_length=convert(self.focal_length), pupil=pupil, aberrations=aberrations)

    def images(self, points: Doubles) -> Doubles:
        """Return the positions (n, 2) on the MLA of the rays from scene points (n, 3) through the pupil's centre."""
        return rays.conjugate_coordinate(points[:, :2], points[:, 2:], self.pupil.distance)

    def points(self, images: Doubles, inverse_distance: Doubles) -> Doubles:
        """Return the scene points (n, 3) with given `images` and `inverse_distance`."""
        distance = 1 / inverse_distance[:, None]
        return np.hstack([images * (-distance / self.pupil.distance), distance])

    def land(self, pupil: Pair, point: Triple) -> Pair:
        """Return the position on the MLA of the ray from a scene point through a pupil point, with aberrations."""
        if not self.pupil.finite:
            return self.pupil.image(pupil, point)
        b = self.pupil.distance
        f1 = self.focal_length
        g = point[2]
        if self.model != "ideal":
            slopes = rays.cosines_to_slopes(*self.cosines(pupil, point))
            return pupil[0] + b * slopes[0], pupil[1] + b * slopes[1]
        x, y = (rays.mla_point(X, P, g, b, f1) for X, P in zip(point[:2], pupil, strict=True))
        if not self.is_round:
            sx, sy = self._wavefront.slope(*pupil)
            x = x + b * sx
            y = y + b * sy
        return x, y

    def path(self, pupil: Pair, point: Triple, wavelength: float) -> Any:
        r"""Return the path in waves from a scene point X to a pupil point P, less the path to the pupil's centre.

        With aberrations W, a thin parabolic phase has the path :math:`(|P - X| - |X| - P^2 / 2 f_1 + W(P)) / \lambda`
        (Goodman, "Introduction to Fourier Optics", section 5.1). Behind an ideal lens all paths to the image X' are
        equal, which leaves :math:`(|X'| - |P - X'| + W(P)) / \lambda`. Both are computed without cancellation.
        """
        Px, Py = pupil
        X, Y, g = point
        square = Px * Px + Py * Py
        if self.model == "ideal":
            # Slopes towards the image from the pupil's centre and from P, with the opposite sign.
            v = self.vergence(g)
            u = X / g
            w = Y / g
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
        Px, Py = pupil
        scale = 1 / in_millimetres(wavelength)
        waves = (Px * Px + Py * Py) * (self.vergence(distance) * (-0.5 * scale))
        return waves if self.is_round else waves + self.aberration(pupil, wavelength)

    def aberration(self, pupil: Pair, wavelength: float) -> Any:
        """Return the path W(P), in waves, that light gains at a pupil point by aberrations and a phase screen."""
        Px, Py = pupil
        return 0 * Px + self._wavefront.path(Px, Py) * (1 / in_millimetres(wavelength))

    def beyond_slopes(self, apart: float, wavelength: float) -> float:
        r"""Return how far the paths of pupil points some mm apart differ by more than the slope halfway between them.

        It is the mean of :math:`1 - \cos 2 \pi \Delta`, over all such pairs in the pupil and directions q of length
        `apart`, where :math:`\lambda \Delta = W(P + q/2) - W(P - q/2) - q \cdot \nabla W(P)` grows with the third
        derivative of W.
        """
        radius = float(self.pupil.radius)
        scale = 1 / in_millimetres(wavelength)
        # 65: Middles of pairs of points across the pupil.
        x, y = (place.ravel() for place in np.meshgrid(*2 * [np.linspace(-radius, radius, 65)]))
        slopes = self._wavefront.slope(x, y)
        errors = []
        for angle in math.pi / _DIRECTIONS * np.arange(_DIRECTIONS):
            u = apart * math.cos(angle)
            v = apart * math.sin(angle)
            ends = [(x + side * u, y + side * v) for side in (0.5, -0.5)]
            inside = np.maximum(*(np.hypot(*end) for end in ends)) <= radius
            first, second = (self._wavefront.path(*end) for end in ends)
            phase = (first - second - u * slopes[0] - v * slopes[1]) * (2 * math.pi * scale)
            errors.append((1 - np.cos(phase))[inside])
        return float(np.concatenate(errors).mean())

    def amplitude(self, pupil: Pair, point: Triple) -> Any:
        r"""Return the amplitude :math:`|g| / |P - X|^2`, the first Rayleigh-Sommerfeld solution (Goodman, 3.5)."""
        length = _distance(pupil, point)
        return abs(point[2]) / (length * length)

    def power_through(self, point: Doubles) -> float:
        """Return the integral of the squared amplitude over the pupil, by Gauss's rule in radius, evenly in angle."""
        nodes, weights = np.polynomial.legendre.leggauss(ACCURACY.wavefront_nodes)
        radius = self.pupil.radius * np.sqrt((nodes + 1) / 2)[:, None]
        angle = math.pi * np.arange(2 * ACCURACY.wavefront_nodes) / ACCURACY.wavefront_nodes
        squares = self.amplitude((radius * np.cos(angle), radius * np.sin(angle)), tuple(point)) ** 2
        return float(math.pi * self.pupil.radius**2 * (weights / 2) @ squares.mean(1))

    def cosines(self, pupil: Pair, point: Triple) -> Pair:
        r"""Return a point's direction cosines, :math:`(P - X) / |P - X| - P / f_1`, plus the slope of the aberrations.

        Behind an ideal lens the direction is that towards the image. In an image of the pupil angles are larger by the
        reciprocal of its magnification.
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
            sx = sx + x
            sy = sy + y
        if not self.pupil.finite:
            return sx * self.pupil.stop_scale, sy * self.pupil.stop_scale
        return sx, sy


def _distance(pupil: Pair, point: Triple) -> Any:
    """Return the distance |P - X| in mm, negative for light that converges to a point behind the lens."""
    dx = pupil[0] - point[0]
    dy = pupil[1] - point[1]
    g = point[2]
    return _signed(sqrt(dx * dx + dy * dy + g * g), g)


def _signed(length: Any, g: Any) -> Any:
    return dr.copysign(length, g) if dr.is_array_v(length) else np.copysign(length, g)


@dataclass(frozen=True)
class DistortedLens(ThinLens):
    """A thin lens with distortion (`undistort`), whose rays continue as if from another MLA point; for rays only."""

    distortion: Numbers = (0.0,) * 5

    def trace(self, position: Pair, slope: Pair) -> Traced:
        """Return the ray from a position on the MLA through an unchanged pupil point to the scene."""
        source = undistort(*position, self.distortion)
        moved = (t + (m - u) / self.pupil.distance for t, m, u in zip(slope, position, source, strict=True))
        return super().trace(source, (next(moved), next(moved)))

    def ray(self, pupil: Pair, position: Pair) -> Traced:
        """Return the ray from a position on the MLA through a pupil point, without a test of the pupil's edge."""
        return super().ray(pupil, undistort(*position, self.distortion))

    def images(self, points: Doubles) -> Doubles:
        """Return the positions (n, 2) on the MLA of the rays from scene points (n, 3) through the pupil's centre."""
        x, y = super().images(points).T
        return np.stack(self._distort((x, y)), -1)

    def land(self, pupil: Pair, point: Triple) -> Pair:
        """Return the position on the MLA of the ray from a scene point through a pupil point, with aberrations."""
        return self._distort(super().land(pupil, point))

    def _distort(self, image: Pair) -> Pair:
        """Return the positions on the MLA of which `undistort` makes given ones."""
        x, y = image
        u, v = image
        # Each step multiplies the error by the derivative of the displacement, some per cent.
        for _ in range(ACCURACY.distortion_steps):
            moved = undistort(x, y, self.distortion)
            x = x + u - moved[0]
            y = y + v - moved[1]
        return x, y


@builds(type(None))
def thin_lens(numbers: LensNumbers) -> ThinLens:
    """Return the main lens of a camera without an objective or prescription."""
    pupil = Pupil(numbers.aperture_radius, numbers.mla_distance)
    screen = numbers.camera.phase_screen
    arguments = numbers.focal_length, pupil, numbers.model, numbers.wavefront, screen
    if any(numbers.camera.distortion):
        return DistortedLens(*arguments, numbers.camera.distortion)
    return ThinLens(*arguments)


@builds(Collimator)
def collimated_lens(numbers: LensNumbers) -> ThinLens:
    """Return the objective of a telescope with a collimator, for waves: its pupil is imaged, inverted, onto the array.

    Such a camera is simulated by full fields alone.
    """
    camera = numbers.camera
    collimator = cast(Collimator, numbers.camera.main_lens)
    swap = collimator.collimator_focal_length
    pupil = Pupil(numbers.aperture_radius, camera.focal_length, finite=0, swap=swap)
    return ThinLens(math.inf, pupil, aberrations=numbers.wavefront, screen=camera.phase_screen)
