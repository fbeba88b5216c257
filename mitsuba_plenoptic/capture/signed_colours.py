r"""The wavelengths at which captures by signed rays diffract light, and what rays bring to each.

Coefficients and kernels are those of a few wavelengths, the nodes. Light of a wavelength between two of them is shared
by both, as straight lines are drawn between values; beyond the outermost, these take all of it. So each channel has an
image at each node that it answers to, and records their sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..optics.phase_space import PhaseSpace


@dataclass(frozen=True)
class Node:
    """Light that is diffracted alike.

    Attributes
    ----------
    plan : PhaseSpace
        How: of the camera at one wavelength.
    channels : tuple of int
        Those of the capture that have an image of it.
    weights : float array (channels, values)
        For each of these channels, the factors on the values of a ray's light whose sum is added to the image.
    """

    plan: PhaseSpace
    channels: tuple[int, ...]
    weights: NDArray[np.float64]

    @classmethod
    def lines(cls, plans: list[PhaseSpace]) -> list[Node]:
        """Return the nodes of light that has a value for each channel, each with a plan; those of equal plans share."""
        return [
            cls(plan, own, np.eye(len(plans))[list(own)])
            for plan, own in (
                (plan, tuple(channel for channel, other in enumerate(plans) if other is plan))
                for plan in {id(plan): plan for plan in plans}.values()
            )
        ]

    def mixture(self) -> tuple[list[int], list[list[Any]]]:
        """Return which values count, and their weights, as numbers that do not compile the kernels again."""
        used = np.flatnonzero(self.weights.any(0)).tolist()
        return used, [[dr.opaque(mi.Float, weight) for weight in row] for row in self.weights[:, used].tolist()]
