"""The part of the pupil that the light of points passes, where vignetting changes it over the microlens array.

Light of a point that passes the pupil point P meets the array where its ray does, and is dimmed by the pupil as it is
seen from there. So each point has a pupil function, the same by rays and by waves.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ..camera import Vignetting
from ..lenses import Light, MainLens
from ..runtime import Doubles, Pair, Triple

_RADII = 24
_ANGLES = 48
"""Points of the pupil, as a mean over which the light that passes is estimated."""

_TOGETHER = 1024
"""Scene points whose light is estimated at a time."""


@dataclass(frozen=True)
class SeenPupil:
    """Vignetting of the light of points, given in the camera frame."""

    vignetting: Vignetting
    light: Light
    pupil_radius: Any

    def amplitude(self, pupil: Pair, point: Triple, soften: Callable[[Any], Any]) -> Any:
        """Return the amplitude of light behind points of the pupil.

        `soften` makes of distances in mm from the pupil's rim or the outline, positive inside, what an edge transmits.
        """
        landing = self.light.land(pupil, point)
        radius = self.pupil_radius
        outline, passed = self.vignetting.outline(pupil[0] / radius, pupil[1] / radius, *landing)
        return soften(dr.minimum(outline * radius, self.light.inside(pupil))) * dr.sqrt(passed)


def passed_part(vignetting: Vignetting | None, lens: MainLens, points: Doubles) -> Doubles:
    """Return the fraction (n,) of the light of scene points (n, 3) that vignetting passes, evenly over the pupil."""
    if vignetting is None:
        return np.ones(len(points))
    radius = np.sqrt((np.arange(_RADII) + 0.5) / _RADII)
    angle = 2 * np.pi * np.arange(_ANGLES)[:, None] / _ANGLES
    x, y = ((lens.pupil.radius * radius * turn).ravel() for turn in (np.cos(angle), np.sin(angle)))
    parts = []
    for first in range(0, len(points), _TOGETHER):
        some = points[first : first + _TOGETHER]
        landing = lens.bind(some).land((x, y), (some[:, :1], some[:, 1:2], some[:, 2:]))
        parts.append(vignetting.power(x / lens.pupil.radius, y / lens.pupil.radius, *landing).mean(1))
    return np.concatenate([np.zeros(0), *parts])
