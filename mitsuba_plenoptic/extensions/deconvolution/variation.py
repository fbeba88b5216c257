r"""Total variation of planes of bins, by which an iteration prefers uniform areas with sharp borders.

.. math:: \mathrm{TV}(x) = \sum \sqrt{(\Delta_1 x)^2 + (\Delta_2 x)^2 + \epsilon^2}

(Rudin, Osher and Fatemi 1992, Physica D 60, 259), with the differences to the next bin along rows and columns. Its
gradient is :math:`-\mathrm{div}(\nabla x / |\nabla x|)`, at most :math:`2 + \sqrt 2`, by which Richardson's and Lucy's
step is divided (Dey et al. 2006, Microscopy Research and Technique 69, 260).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...runtime import Flags, Floats


@dataclass(frozen=True)
class TotalVariation:
    """The gradient of the total variation of planes of upright square bins, times a weight: a penalty on radiance."""

    # From all values to the bins (rows, columns) of each plane.
    planes_of: Callable[[NDArray], list[NDArray]]
    weight: float

    def __call__(self, values: Floats, inside: Flags) -> Floats:
        """Return the gradient at the values, 0 for bins that are not inside."""
        slopes = []
        for plane, mask in zip(self.planes_of(values), self.planes_of(inside), strict=True):
            # Steps to bins that are not inside do not count.
            neighbours = [mask[:, 1:] & mask[:, :-1], mask[1:] & mask[:-1]]
            right = np.zeros_like(plane)
            below = np.zeros_like(plane)
            right[:, :-1], below[:-1] = (np.diff(plane, axis=1 - axis) * neighbours[axis] for axis in (0, 1))
            # Largest step between bins, over their mean, that counts as even.
            even = 1e-3 * float(plane[mask].mean()) if mask.any() else 0.0
            length = np.sqrt(right**2 + below**2 + np.float32(even**2 + 1e-30))
            right = right / length
            below = below / length
            slope = -right - below
            slope[:, 1:] += right[:, :-1]
            slope[1:] += below[:-1]
            slopes.append(slope.ravel())
        return np.asarray(self.weight * np.concatenate(slopes), np.float32)
