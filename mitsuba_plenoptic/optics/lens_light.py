"""Scene points' light on the exit pupil of a real main lens, by fitted polynomials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .phase import in_millimetres
from .pupil_polynomials import Place, PupilPolynomial


@dataclass(frozen=True)
class LensLight:
    """The light of one scene point for each row of NumPy's arrays, or for each lane of Dr.Jit's.

    Attributes
    ----------
    pupil_distance : float
        Distance from the exit pupil to the MLA in millimetres.
    slope : (array, array)
        Of the ray from the middle of the exit pupil to the paraxial image.
    convergence : array
        Reciprocal of that image's distance from the exit pupil.
    aberration, brightness : PupilPolynomial
        Path beyond that of a sphere around the paraxial image, in millimetres, and amplitude.
    stops : list of PupilPolynomial
        Squares of the distances from the axis, over those of the edges, for each surface that cuts beams.
    """

    pupil_distance: float
    slope: Place
    convergence: Any
    aberration: PupilPolynomial
    brightness: PupilPolynomial
    stops: list[PupilPolynomial]

    def length(self, pupil: Place) -> Any:
        """Return the path to a place on the exit pupil, less that of one place, in millimetres."""
        (x, y), (sx, sy), w = pupil, self.slope, self.convergence
        sphere = 2 * (x * sx + y * sy) - (x * x + y * y) * w
        return sphere / (self._secant(pupil) + _sqrt(sx * sx + sy * sy + 1)) + self.aberration.value(pupil)

    def path(self, pupil: Place, point: Any, wavelength: float) -> Any:
        """Return the path in waves, as `Light.path` does; the point must be the light's own.

        Parameters
        ----------
        pupil : (array, array)
            Place on the exit pupil in millimetres.
        point : tuple of arrays
            The scene point.
        wavelength : float
            Wavelength in nanometres, of which the lens has been fitted.
        """
        return self.length(pupil) * (1 / in_millimetres(wavelength))

    def amplitude(self, pupil: Place, point: Any) -> Any:
        """Return the amplitude, as `Light.amplitude` does; the point must be the light's own."""
        return self.brightness.value(pupil)

    def inside(self, pupil: Place) -> Any:
        """Return how far within the edges of all surfaces a place lies, negative outside; right near the edges."""
        least: Any = None
        for stop in self.stops:
            square, along_x, along_y = stop.gradient(pupil)
            # (1 - r) / |grad r| with r the root; the middle of the stop has no gradient
            root = _sqrt(square)
            away = (1 - root) * 2 * root / _sqrt(along_x * along_x + along_y * along_y)
            least = away if least is None else _minimum(least, away)
        return least

    def is_open(self, pupil: Place) -> Any:
        """Return whether light comes to a place, as `Light.is_open` does."""
        result: Any = True
        for stop in self.stops:
            result = (stop.value(pupil) <= 1) & result
        return result

    def cosines(self, pupil: Place, point: Any) -> Place:
        """Return the direction cosines in which the light leaves the exit pupil, as `Light.cosines` does."""
        secant = self._secant(pupil)
        _, *change = self.aberration.gradient(pupil)
        cx, cy = (
            (s - P * self.convergence) / secant + more for s, P, more in zip(self.slope, pupil, change, strict=True)
        )
        return cx, cy

    def land(self, pupil: Place, point: Any) -> Place:
        """Return where on the MLA the rays through places of the exit pupil come, as `Light.land` does."""
        cosines = self.cosines(pupil, point)
        along = self.pupil_distance / _sqrt(1 - cosines[0] * cosines[0] - cosines[1] * cosines[1])
        x, y = (P + along * c for P, c in zip(pupil, cosines, strict=True))
        return x, y

    def _secant(self, pupil: Place) -> Any:
        x, y = (P * self.convergence - s for P, s in zip(pupil, self.slope, strict=True))
        return _sqrt(x * x + y * y + 1)


def _sqrt(value: Any) -> Any:
    return dr.sqrt(dr.maximum(value, 1e-20)) if dr.is_array_v(value) else np.sqrt(np.maximum(value, 1e-20))


def _minimum(a: Any, b: Any) -> Any:
    return dr.minimum(a, b) if dr.is_array_v(a) else np.minimum(a, b)
