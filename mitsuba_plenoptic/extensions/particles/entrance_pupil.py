r"""The entrance pupil of a camera as particles see it: directions towards its points, and solid angles.

The pupil of a lens stands in a plane before the particles. That of an objective is infinitely far, and by the sine
condition the point P of its stop sends rays in the direction with :math:`n \sin\theta = |P| / f`, alike for all
particles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...light.optical_system import OpticalSystem
from ...prescription.objective import Objective


@dataclass(frozen=True)
class EntrancePupil:
    """The entrance pupil of a camera's main lens."""

    # Its z and its radius, those of the stop for an objective, in mm.
    place: float
    radius: float
    objective: Objective | None

    @classmethod
    def of(cls, camera: PlenopticCamera, wavelength: float) -> EntrancePupil:
        """Return the entrance pupil of a camera."""
        return cls(OpticalSystem(camera, wavelength).lens.entrance.pupil, camera.aperture_radius, camera.objective)

    def towards(self, positions: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return unit vectors from positions (n, 3) to the pupil's points (at, at), an array (n, y, x, 3)."""
        x, y = at, at[:, None]
        if self.objective is None:
            away = np.stack(np.broadcast_arrays(x, y, self.place), -1) - positions[:, None, None]
            return np.asarray(away / np.linalg.norm(away, axis=-1, keepdims=True))
        x, y = (each / (self.objective.immersion * self.objective.focal_length) for each in (x, y))
        # The corners of the square around the pupil may lie beyond the horizon.
        lines = np.stack(np.broadcast_arrays(x, y, -np.sqrt(np.maximum(1 - x * x - y * y, 0))), -1)
        return np.broadcast_to(lines, (len(positions), *lines.shape))

    def solid_angles(self, positions: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the solid angles from positions (n, 3) of the pupil's cells about (at, at), (n, y, x), in sr."""
        open_cells = np.hypot(at, at[:, None]) < self.radius
        if self.objective is None:
            whole = np.pi * (self.radius / (positions[:, 2] - self.place)) ** 2
            share = open_cells * 1.0
        else:
            whole = np.full(len(positions), 4 * np.pi * math.sin(self.objective.half_angle / 2) ** 2)
            share = np.divide(1.0, -self.towards(positions[:1], at)[0, ..., 2], where=open_cells, out=open_cells * 0.0)
        return np.asarray(whole[:, None, None] * (share / share.sum()))

    def angle(self, positions: NDArray[np.float64]) -> float:
        """Return the largest angle in radians, seen from positions (n, 3), between the pupil's centre and its rim."""
        if self.objective is not None:
            return self.objective.half_angle
        return self.radius / float(np.abs(positions[:, 2] - self.place).min(initial=np.inf))
