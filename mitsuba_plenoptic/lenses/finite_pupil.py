"""What follows for waves at the microlens array from an exit pupil at a finite distance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray


class FinitePupil(ABC):
    """A main lens with its exit pupil at a finite distance b before the array; see `MainLens` for what is asked."""

    pupil_radius: Any
    pupil_distance: Any

    @abstractmethod
    def convergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to an object plane's image."""

    def cone(self, distances: Any) -> float:
        """Return the cosine to the rim of the pupil: of light that is collimated, or meets at MLA or image."""
        powers = np.abs(self.convergence(distances))
        return float(self.pupil_radius) * float(powers.max(initial=1 / self.pupil_distance))

    def from_array(self, cosine: tuple[Any, Any], image: tuple[Any, Any]) -> tuple[tuple[Any, Any], Any, Any]:
        r"""Return :math:`M - R s`, :math:`R = b / \sqrt{1 - s^2}`, and R without that of the chief ray."""
        (sx, sy), (x, y), b = cosine, image, self.pupil_distance
        R = b / _sqrt(1 - sx * sx - sy * sy)
        return (x - R * sx, y - R * sy), R, R - _sqrt(x * x + y * y + b * b)

    def to_array(self, pupil: NDArray[np.float64], image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the direction cosines from points of the pupil to places on the MLA."""
        towards = image - pupil
        return np.asarray(towards / np.sqrt((towards**2).sum(-1) + self.pupil_distance**2)[..., None])

    def chief_slope(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the slopes of the chief rays at places on the MLA."""
        return np.asarray(image / self.pupil_distance)

    def curvature(self, square: Any) -> Any:
        """Return the reciprocal of the distance."""
        return 1 / _sqrt(square)


def _sqrt(value: Any) -> Any:
    return dr.sqrt(value) if dr.is_array_v(value) else np.sqrt(value)
