r"""Standard deviations of a calibration's numbers, the model's own misfit included.

Were the residuals independent, the covariance of the numbers would be :math:`V_0 = \sigma^2 A^{-1}`, with the
information A of all rows. What the model misses is shared by many rows of one frame, which then tell less than their
count. Whether that is so is tested: fitted alone, each frame would move the numbers by more than its own scatter
explains. Their squared moves over that scatter, over the degrees of freedom, are the squared disagreement of the frames
(R. T. Birge's ratio, 1932), which is 1 on average for independent residuals.

If it is more than chance allows, the frames are what is independent: the delete-one-frame jackknife,

.. math:: V = V_0 + \frac{G - 1}{G} \sum_g (\theta_g - \bar\theta) (\theta_g - \bar\theta)^T,

with the numbers :math:`\theta_g` that all frames but g give, to first order (the cluster-robust covariance CR3: A. C.
Cameron and D. L. Miller, "A practitioner's guide to cluster-robust inference", 2015). The second part is multiplied by
(G - 1) / (G - 3), the variance of Student's distribution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from .adjustment import Problem, Solution
from .model import NAMES

# A disagreement that independent residuals exceed this rarely is taken for the model's misfit.
_CHANCE = 1e-3

# Degrees of freedom from which on a frame's own scatter is well known.
_MANY = 100


@dataclass(frozen=True)
class Deviations:
    """How well the numbers are known."""

    # Of the numbers' errors; (17, 17).
    covariance: np.ndarray
    # By how much the frames disagree about the numbers, over what their residuals' scatter explains.
    disagreement: float
    # Whether that is more than chance allows, so that the covariance is that of leaving out frames.
    by_frames: bool

    @property
    def values(self) -> np.ndarray:
        """Standard deviations, (17,)."""
        return np.sqrt(np.diag(self.covariance))


def deviations(problem: Problem, found: Solution, weights: np.ndarray) -> Deviations:
    """Return how well a fit's numbers are known, all of them free.

    Shapes: `weights` (n,).
    """
    count = len(NAMES)
    _, parts = problem.blocks(found.numbers, found.poses, weights, np.arange(count))
    rows = np.concatenate(parts)
    scale = np.sqrt((rows[:, :count] ** 2).sum(0))
    parts = [part / np.append(scale, 1.0) for part in parts]
    used = 2 * np.bincount(problem.corners.pose, weights > 0)
    squares = (weights[:, None] * problem.residuals(found.numbers, found.poses) ** 2).sum()
    variance = float(squares) / max(1, used.sum() - count - found.poses.size)
    inverse = np.linalg.pinv(np.linalg.qr(np.concatenate(parts)[:, :count], mode="r"))
    covariance = variance * inverse @ inverse.T
    frames = len(used)
    moved, freedom = 0.0, -count
    for part, values in zip(parts, used, strict=False):
        # The triangle's last column: what the numbers can take of the frame's residuals, and what is left of them.
        own = int(values) - found.poses.shape[1] - count
        if own > 0:
            scatter = float(part[count, -1] ** 2) / own
            moved += float((part[:count, -1] ** 2).sum()) / (scatter if own > _MANY else max(scatter, variance))
            freedom += count
    disagreement = max(1.0, moved / freedom) if freedom > 0 else 1.0
    by_frames = freedom > 0 and disagreement > chi2.ppf(1 - _CHANCE, freedom) / freedom
    if by_frames:
        others = [np.concatenate(parts[:g] + parts[g + 1 :]) for g in range(frames)]
        without = np.array([np.linalg.lstsq(each[:, :count], each[:, -1])[0] for each in others])
        without -= without.mean(0)
        # From few frames the variance itself is uncertain, and errors over it follow Student's distribution.
        student = (frames - 1) / max(frames - 3, 0.5)
        covariance = covariance + student * (frames - 1) / frames * without.T @ without
    else:
        covariance = covariance * disagreement
    return Deviations(covariance / np.outer(scale, scale), float(np.sqrt(disagreement)), bool(by_frames))


def moved_solutions(problem: Problem, found: Solution, weights: np.ndarray, covariance: np.ndarray) -> list[Solution]:
    """Return solutions a standard deviation away along each independent combination of numbers, the poses refitted.

    The squared changes of anything else that follows from numbers and poses add up to its variance.
    """
    heads, _ = problem.blocks(found.numbers, found.poses, weights, np.arange(len(NAMES)))
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    moved = []
    for step in (vectors * np.sqrt(values.clip(0))).T * scale:
        poses = [-np.linalg.solve(head[:, :6], head[:, 6:-1] @ step) for head in heads]
        moved.append(Solution(found.numbers + step, found.poses + poses, found.cost, 0))
    return moved
