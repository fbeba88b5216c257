"""Crosstalk of photodiodes: light that the walls between pixels let through to the four neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def mix_pixels(image: NDArray[Any], fraction: float) -> NDArray[Any]:
    """Return an image with a fraction of each pixel moved to each neighbour; `image` is (rows, columns[, channels]).

    Light that would leave across the edge stays, so that the sum is unchanged. The operation is self-adjoint.
    """
    if not fraction:
        return image
    result = (1 - 4 * fraction) * image
    for axis in (0, 1):
        for step, edge in ((1, slice(0, 1)), (-1, slice(-1, None))):
            neighbour = np.roll(image, step, axis)
            at_edge = (slice(None),) * axis + (edge,)
            neighbour[at_edge] = image[at_edge]
            result += fraction * neighbour
    return np.asarray(result, image.dtype)


def mix_deviations(deviation: NDArray[Any], fraction: float) -> NDArray[Any]:
    """Return the standard deviations after `mix_pixels`, given the deviations of independent pixels before."""
    own, given = (1 - 4 * fraction) ** 2, fraction**2
    variance = deviation**2
    # Squared weights: the sum of all is less than 1, because neighbours average each other.
    total = own + 4 * given
    return np.asarray(np.sqrt(total * mix_pixels(variance, given / total)), deviation.dtype)
