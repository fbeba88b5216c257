r"""Richardson's and Lucy's iteration, plain or accelerated, stopped by the noise or after a given count.

.. math:: x \leftarrow \frac{x}{A^T 1} \, A^T \frac{y + \beta}{A x + \beta}

(Richardson 1972, J. Opt. Soc. Am. 62, 55; Lucy 1974, Astron. J. 79, 745). It keeps x positive and raises the likelihood
of Poisson counts. :math:`\beta` is the variance of a dark pixel over the value that counts one electron: with it a
Poisson law stands for photons and read noise together (Snyder, Hammoud and White 1993, J. Opt. Soc. Am. A 10, 1014).

Accelerated, each step starts from a point extrapolated along the last two (Biggs and Andrews 1997, Appl. Opt. 36,
1766):

.. math:: z_k = x_k + \alpha_k (x_k - x_{k-1}), \qquad
          \alpha_k = \frac{g_{k-1} \cdot g_{k-2}}{g_{k-2} \cdot g_{k-2}}, \qquad g_{k-1} = x_k - z_{k-1}

It ends where the residual, weighted by the variances of the pixels, is as large as noise: the discrepancy principle
(Morozov 1966; for Poisson counts Bertero et al. 2010, Inverse Problems 26, 105004). Further steps would fit the noise.
It ends as well where what is above that hardly falls any more, since it is then no light from these bins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Values = list[NDArray[np.float32]]
"""Radiance of the bins of each plane."""

_FLOOR = 1e-4
"""What is added to every pixel and its model at least, over the mean of those that are lit, so that none is 0."""

_LEAST_SEEN = 1e-4
"""Light of a bin on the detector, over that of the best one, below which it is taken for dark."""


_SPAN, _LEAST_FALL = 10, 0.95
"""Steps in which what is above the noise must fall below this fraction of itself."""

Misfit = Callable[[NDArray[np.float32], NDArray[np.float32]], float]
"""From pixels and what they should be to the squared residual over that of noise alone."""


class Linear(Protocol):
    """From the radiance of bins to pixels, and the transpose."""

    def forward(self, values: Values) -> NDArray[np.float32]:
        """Return the pixels of some bins."""

    def adjoint(self, image: NDArray[np.float32]) -> Values:
        """Return for each bin the pixels weighted by its light."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where an iteration has ended.

    Attributes
    ----------
    values : list of float32 arrays
        Radiance of the bins of each plane.
    seen : list of float32 arrays
        Light of each bin on the detector, over that of the best one.
    iterations : int
        Steps that were made.
    residual : float
        Root mean square of what is left of the pixels, over that of the pixels.
    stopped : bool
        Whether the noise has ended it.
    """

    values: Values
    seen: Values
    iterations: int
    residual: float
    stopped: bool


def richardson_lucy(
    response: Linear,
    image: NDArray[np.float32],
    *,
    iterations: int,
    accelerate: bool = True,
    misfit: Misfit | None = None,
    shift: float = 0.0,
    progress: Callable[[float], None] | None = None,
) -> Solution:
    r"""Find the radiance of bins that explains an image.

    Parameters
    ----------
    response : Linear
        The response A.
    image : float32 array (rows, columns)
        The pixels y.
    iterations : int
        Steps at most.
    accelerate : bool
        Whether steps start from extrapolated points.
    misfit : callable, optional
        Tells the squared residual over that of noise alone, which ends the iteration at 1.
    shift : float
        The number :math:`\beta`.
    progress : callable, optional
        Called with the fraction of the steps that is done.

    Returns
    -------
    Solution
    """
    total = float(np.maximum(image, 0).sum(dtype=np.float64))
    lit = float(image.max()) > 0 and total / max(1, int((image > 0).sum()))
    shift = max(shift, _FLOOR * float(lit))
    given = np.maximum(image + np.float32(shift), 0)
    light = response.adjoint(np.ones_like(image))
    best = max(float(part.max()) for part in light)
    seen: Values = [np.asarray(np.maximum(part, 0) / best, np.float32) for part in light]
    weight = [np.where(part > _LEAST_SEEN, 1 / np.maximum(part * best, 1e-30), 0).astype(np.float32) for part in seen]
    level = total / sum(
        float((part * (gain > 0)).sum(dtype=np.float64)) for part, gain in zip(light, weight, strict=True)
    )
    start = [np.where(gain > 0, np.float32(level), np.float32(0)) for gain in weight]
    last, found, steps = start, start, _Extrapolation() if accelerate else None
    scale = float(np.linalg.norm(image))
    done, misfits = 0, [np.inf]
    while True:
        point = found if steps is None else steps.start(found, last)
        model = response.forward(point)
        if misfit is not None:
            misfits.append(misfit(image, model))
        stopped = _explained(misfits)
        if stopped or done == iterations:
            break
        ratio = given / (np.maximum(model, 0) + np.float32(shift))
        back = response.adjoint(ratio)
        new = [z * np.maximum(part, 0) * gain for z, part, gain in zip(point, back, weight, strict=True)]
        if steps is not None:
            steps.note(new, point)
        last, found = found, new
        done += 1
        if progress:
            progress(done / iterations)
    return Solution(point, seen, done, float(np.linalg.norm(image - model)) / scale, stopped)


def _explained(misfits: list[float]) -> bool:
    """Whether what is left is noise, or will not become less."""
    above = [value - 1 for value in misfits[-1 - _SPAN :]]
    return above[-1] <= 0 or (len(above) > _SPAN and above[-1] > _LEAST_FALL * above[0])


class _Extrapolation:
    """Where the next step starts, from the last two."""

    def __init__(self) -> None:
        self._moves: list[Values] = []

    def note(self, found: Values, start: Values) -> None:
        """Keep how far a step has gone."""
        self._moves = [*self._moves[-1:], [a - b for a, b in zip(found, start, strict=True)]]

    def start(self, found: Values, last: Values) -> Values:
        """Return the point from which the next step is made, nowhere negative."""
        if len(self._moves) < 2:
            return found
        before, now = self._moves
        length = _dot(before, before)
        alpha = min(max(_dot(now, before) / length, 0.0), 1 - 1e-6) if length > 0 else 0.0
        return [np.maximum(x + np.float32(alpha) * (x - y), 0) for x, y in zip(found, last, strict=True)]


def _dot(first: Values, second: Values) -> float:
    return sum(float(np.vdot(a, b)) for a, b in zip(first, second, strict=True))
