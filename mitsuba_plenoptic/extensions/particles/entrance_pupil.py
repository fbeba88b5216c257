r"""The entrance pupil of a camera as particles see it: directions towards its points, and solid angles.

The pupil of a lens stands in a plane before the particles. That of an objective is infinitely far, and by the sine
condition the point P of its stop sends rays in the direction with :math:`n \sin\theta = |P| / f`, alike for all
particles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...fields import OpticalSystem
from ...prescription import Objective
from ...runtime import Doubles


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

    def towards(self, positions: Doubles, x: Doubles, y: Doubles) -> NDArray[Any]:
        """Return unit vectors from positions (n, 3) to points (q,) of the pupil, (n, q, 3)."""
        if self.objective is None:
            away = np.stack([x, y, np.full(len(x), self.place)], -1) - positions[:, None]
            return np.asarray(away / np.linalg.norm(away, axis=-1, keepdims=True))
        x, y = (coordinate / (self.objective.immersion * self.objective.focal_length) for coordinate in (x, y))
        # The corners of the square around the pupil may lie beyond the horizon.
        # 0.999: Largest sine of directions.
        within = np.minimum(1, 0.999 / np.maximum(np.hypot(x, y), 1e-300))
        x = within * x
        y = within * y
        lines = np.stack([x, y, -np.sqrt(1 - x * x - y * y)], -1)
        return np.broadcast_to(lines, (len(positions), *lines.shape))

    def solid_angles(self, positions: Doubles, x: Doubles, y: Doubles) -> Doubles:
        """Return the solid angles from positions (n, 3) of a square millimetre at points (q,) of the pupil, (n, q)."""
        cosine = -self.towards(positions, x, y)[..., 2]
        if self.objective is not None:
            return np.asarray(1 / (cosine * (self.objective.immersion * self.objective.focal_length) ** 2))
        return np.asarray(cosine**3 / (positions[:, 2:] - self.place) ** 2)

    def angle(self, positions: Doubles) -> float:
        """Return the largest angle in radians, seen from positions (n, 3), between the pupil's centre and its rim."""
        if self.objective is not None:
            return self.objective.half_angle
        return self.radius / float(np.abs(positions[:, 2] - self.place).min(initial=np.inf))
