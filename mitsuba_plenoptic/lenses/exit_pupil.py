r"""One scene point's light on the exit pupil of a real main lens: path, amplitude and edge, fitted to traced rays.

Rays are traced from the point through the entrance pupil and all surfaces to the plane of the exit pupil. There
path, amplitude and the heights on each surface are smooth functions of the position, to which polynomials are fitted by
least squares. For the path the polynomial is its difference from that of a sphere around the paraxial image (the wave
aberration: Welford, "Aberrations of Optical Systems", chapter 7). The field is

.. math:: U(P) = A(P) \exp(i k \Phi(P)), \quad A = \frac{g}{|E - X|^2} \sqrt{\left| \frac{dE}{dP} \right|}

with E the point of the entrance pupil whose ray arrives at P, and g the distance of the object from its plane: the
amplitude that a thin lens in that pupil receives (see `ThinLens.amplitude`), transported along the rays.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..optics import guards
from ..optics.waves import in_millimetres
from ..runtime.backend import minimum, safe_sqrt
from . import sequential
from .lens_system import LensSystem
from .main_lens import Pair

_ACROSS = 45
"""Rays across the entrance pupil; alternate rays are fitted, and the others check the fit."""

_WIDER, _BEYOND = 1.4, 1.1
"""Largest radius at which rays are started, over the pupil's, and largest height fitted, over the semi-aperture."""

_DEGREE = 10
"""Degree of the polynomials."""

_FARTHEST_IMAGE = 1e12
"""Distance in millimetres that represents an image at infinity."""

_POWERS = [(i, degree - i) for degree in range(_DEGREE + 1) for i in range(degree + 1)]


class ExitPupil:
    """The light of a scene point on the exit pupil of a real main lens.

    Parameters
    ----------
    lens : LensSystem
        The lens, at one wavelength.
    point : (float, float, float)
        Scene point in the camera frame, before the lens.

    Raises
    ------
    InputError
        If the point does not lie before the lens, or no light of it passes the lens.
    PhysicsError
        If the path cannot be fitted.
    """

    def __init__(self, lens: LensSystem, point: tuple[float, float, float]) -> None:
        front = max(lens.front_bounds[1])
        if not point[2] > front:
            raise InputError(f"position: g = {point[2]:g}: it must lie before the main_lens, beyond {front:.6g}")
        self._lens, self._point = lens, point
        self.pupil_distance = float(lens.pupil_distance)
        wavelength = lens.prescription.wavelength if lens.wavelength is None else lens.wavelength
        P, E, slopes, path, stops, is_open = self._trace()
        if not np.any(is_open):
            raise InputError(f"position = ({', '.join(f'{c:g}' for c in point)}): no light of it passes the main_lens")
        self._middle = P[:, is_open].mean(1)
        self._radius = float(np.max(np.hypot(*(P - self._middle[:, None]))))
        image = self._image(P, slopes, is_open)
        self._sphere = image
        aberration = path - _sphere_path(tuple(P), image)
        some = np.zeros(P.shape[1], bool)
        some[::2] = True
        basis = self._basis(P)
        self._aberration = _fit(basis[some], aberration[some])
        left = (aberration - basis @ self._aberration)[~some & is_open]
        error = float(np.sqrt(np.mean((left - left.mean()) ** 2))) / in_millimetres(wavelength)
        self.error = error
        guards.check(guards.MAIN_LENS, -math.expm1(-((2 * math.pi * error) ** 2)))
        # A surface that lets all traced rays through does not vignette.
        ends = [stop for stop in stops if stop.max() > 1]
        fitted = _fit(basis, np.array([*E, *ends]).T).T
        self._stops = list(fitted[2:])
        self._amplitude = _fit(basis, self._amplitudes(P, E, fitted[:2]))
        shift = P[:, is_open]
        self.pupil_radius = float(np.max(np.hypot(*shift))) + self._radius / _ACROSS
        self.bundle = shift.T, (slopes / np.sqrt(1 + (slopes**2).sum(0)))[:, is_open].T

    def _trace(self) -> tuple[NDArray, NDArray, NDArray, NDArray, list[NDArray], NDArray]:
        """Return traced rays through the entrance pupil: positions, paths, amplitudes and edges.

        Returns
        -------
        P, E : (2, n) array
            Positions in the planes of the exit and of the entrance pupil, in millimetres.
        slopes : (2, n) array
            Slopes behind the lens, as change per distance towards the array.
        path : (n,) array
            Path to the exit pupil in millimetres, less a constant.
        stops : list of (n,) array
            Squared distance from the axis over the squared semi-aperture of each surface.
        is_open : (n,) bool array
            Whether rays pass all surfaces.
        """
        lens, scale, numbers = self._lens, self._lens.scale, self._lens.numbers
        X, Y, g = (coordinate / scale for coordinate in self._point)
        axis = np.linspace(-_WIDER, _WIDER, _ACROSS) * lens.aperture_radius / scale
        Ex, Ey = (values.ravel() for values in np.meshgrid(axis, axis))
        distance = g - (numbers.front_principal - numbers.entrance_pupil)
        length = np.sqrt((Ex - X) ** 2 + (Ey - Y) ** 2 + distance**2)
        before = (Ex * Ex + Ey * Ey - 2 * (Ex * X + Ey * Y)) / (length + math.sqrt(X * X + Y * Y + distance**2))
        direction = ((Ex - X) / length, (Ey - Y) / length, distance / length)
        start = (Ex, Ey, np.full_like(Ex, numbers.entrance_pupil))
        elements = lens.forwards
        wider = [sequential.widened(element, _BEYOND) for element in elements]
        heights: list[Any] = []
        (x, y, z), (L, M, N), valid, path = sequential.follow(wider, start, direction, heights)
        left = (numbers.exit_pupil - z) / N
        stops = [square / element.semi_aperture**2 for square, element in zip(heights, elements, strict=True)]
        found = scale * np.array([x + left * L, y + left * M]), scale * np.array([Ex, Ey]), np.array([L / N, M / N])
        P, E, slopes = (values[:, valid] for values in found)
        stops = [stop[valid] for stop in stops]
        is_open = np.all(np.array(stops) <= 1, axis=0)
        return P, E, slopes, scale * (before + path + left)[valid], stops, is_open

    def _image(self, P: NDArray, slopes: NDArray, is_open: NDArray) -> tuple[float, float, float]:
        """Return the reference sphere's centre from the exit pupil's: at the paraxial distance, on a central ray."""
        vergence = float(self._lens.vergence(self._point[2]))
        behind = math.copysign(_FARTHEST_IMAGE, vergence) if abs(vergence) * _FARTHEST_IMAGE < 1 else 1 / vergence
        z = behind + self.pupil_distance - float(self._lens.mla_distance)
        away = np.where(is_open, np.hypot(*(P - self._middle[:, None])), np.inf)
        (x, y), (tx, ty) = P[:, np.argmin(away)], slopes[:, np.argmin(away)]
        return x + z * tx, y + z * ty, z

    def _basis(self, P: NDArray) -> NDArray:
        """Return all products of powers (n, terms) at positions (2, n)."""
        x, y = (P - self._middle[:, None]) / self._radius
        return np.stack([x**i * y**j for i, j in _POWERS], -1)

    def _amplitudes(self, P: NDArray, E: NDArray, fitted: NDArray) -> NDArray:
        """Return the amplitude of each ray from the mapping of the exit pupil to the entrance pupil."""
        x, y = (P - self._middle[:, None]) / self._radius
        along_x = np.stack([i * x ** max(i - 1, 0) * y**j for i, j in _POWERS], -1) / self._radius
        along_y = np.stack([j * x**i * y ** max(j - 1, 0) for i, j in _POWERS], -1) / self._radius
        (ax, bx), (ay, by) = ((along_x @ coefficients, along_y @ coefficients) for coefficients in fitted)
        X, Y, g = self._point
        numbers = self._lens.numbers
        distance = g - self._lens.scale * (numbers.front_principal - numbers.entrance_pupil)
        square = (E[0] - X) ** 2 + (E[1] - Y) ** 2 + distance**2
        return distance / square * np.sqrt(np.abs(ax * by - ay * bx))

    def _polynomial(self, coefficients: NDArray, pupil: Pair) -> Any:
        """Evaluate a polynomial by Horner's rule, along x for each power of y."""
        x, y = ((P - float(m)) * (1 / self._radius) for P, m in zip(pupil, self._middle, strict=True))
        terms = {power: float(value) for power, value in zip(_POWERS, coefficients, strict=True)}
        total: Any = 0.0
        for j in range(_DEGREE, -1, -1):
            row: Any = 0.0
            for i in range(_DEGREE - j, -1, -1):
                row = row * x + terms[i, j]
            total = total * y + row
        return total

    def path(self, pupil: Pair, point: tuple[Any, Any, Any], wavelength: float) -> Any:
        """Return the path to a pupil point, as `Light.path` does.

        Parameters
        ----------
        pupil : (array, array)
            Point on the plane of the exit pupil in millimetres.
        point : (array, array, array)
            Scene point; it must be the one for which this object was made.
        wavelength : float
            Wavelength in nanometres.
        """
        waves = _sphere_path(pupil, self._sphere) + self._polynomial(self._aberration, pupil)
        return waves * (1 / in_millimetres(wavelength))

    def amplitude(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Any:
        """Return the amplitude at a pupil point, as `Light.amplitude` does.

        Parameters
        ----------
        pupil : (array, array)
            Point on the plane of the exit pupil in millimetres.
        point : (array, array, array)
            Scene point; it must be the one for which this object was made.
        """
        return self._polynomial(self._amplitude, pupil)

    def inside(self, pupil: Pair) -> Any:
        """Return the distance of a point from the nearest surface's edge, positive inside; accurate near the edges."""
        x, y = (P - float(m) for P, m in zip(pupil, self._middle, strict=True))
        least = self._radius - safe_sqrt(x * x + y * y)
        step = 1e-4 * self._radius
        for coefficients in self._stops:

            def ratio(x: Any, y: Any, coefficients: NDArray = coefficients) -> Any:
                return safe_sqrt(self._polynomial(coefficients, (x, y)))

            x, y = pupil
            here = ratio(x, y)
            along = (ratio(x + step, y) - here) / step, (ratio(x, y + step) - here) / step
            least = minimum(least, (1 - here) / safe_sqrt(along[0] * along[0] + along[1] * along[1]))
        return least


def _sphere_path(pupil: Any, image: tuple[float, float, float]) -> Any:
    """Return the path of a perfect wave: the distance from the pupil's centre to the image less that from a point."""
    (x, y), (mx, my, mz) = pupil, image
    axis = math.sqrt(mx * mx + my * my + mz * mz)
    dx, dy = x - mx, y - my
    length = safe_sqrt(dx * dx + dy * dy + mz * mz)
    return math.copysign(1.0, mz) * (2 * (x * mx + y * my) - x * x - y * y) / (length + axis)


def _fit(basis: NDArray, values: NDArray) -> NDArray:
    """Return the coefficients of the least-squares polynomials of values (n,) or (n, m)."""
    Q, R = np.linalg.qr(basis)
    return np.linalg.solve(R, Q.T @ values)
