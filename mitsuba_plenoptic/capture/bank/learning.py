"""Kernels from patterns: the first singular vectors of some, and all others projected on them.

Patterns of many depths, distances from the pupil's rim and directions are nearly of low rank. Sums over many points are
to be met best, so the means of neighbouring patterns are learnt from, too, and a projection keeps the power.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .patterns import LensPatterns, Nodes
from .radial import RadialFields
from .symmetry import mirrors_of, orbits

_BATCH = 32
"""Patterns that are computed together."""

_RUNS, _RUN = 100, 8
"""Runs of neighbouring nodes, at different distances from the rim, that are learnt from, and the nodes of each."""

_MEAN = 3.0
"""Weight of the mean of a run over that of each of its patterns."""

_SETTLED = 8
"""Nodes farthest inside the rim over which the ripples are averaged: from there on they are left out."""


class Learner:
    """Patterns at the nodes of a table.

    Parameters
    ----------
    patterns : LensPatterns
        Computes them.
    fields : RadialFields
        The light on the array.
    nodes : Nodes
        All nodes, flat.
    shape : (int, int, int)
        Nodes of depth, edge and angle.
    """

    def __init__(self, patterns: LensPatterns, fields: RadialFields, nodes: Nodes, shape: tuple[int, int, int]) -> None:
        self._patterns, self._fields, self._nodes, self._shape = patterns, fields, nodes, shape
        self._mirrors = mirrors_of(patterns.window)
        generator = np.random.default_rng(0)
        depths, edges, angles = shape
        self._runs = []
        for run in range(_RUNS):
            first = (run % depths * edges + generator.integers(edges - _RUN + 1)) * angles + generator.integers(angles)
            self._runs.append((first + np.arange(_RUN) * angles, self._mirrors[generator.integers(len(self._mirrors))]))

    def kernels(self, error: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return as many kernels as leave an error (L2) of what they learn from.

        Returns
        -------
        kernels : float32 array (rank, samples, samples)
            Orthonormal.
        mixing : float32 array (rank, learnt)
            The combinations of what was learnt from that they are.
        """
        learnt = self._learnt(self._patterns)
        values, vectors = np.linalg.eigh((learnt @ learnt.T).astype(np.float64))
        values, vectors = np.maximum(values[::-1], 0), vectors[:, ::-1]
        left = 1 - np.cumsum(values) / values.sum()
        rank = int(np.argmax(left <= error**2)) + 1
        mixing = (vectors[:, :rank] / np.sqrt(values[:rank])).T.astype(np.float32)
        return _square(mixing @ learnt), mixing

    def wider(self, mixing: NDArray[np.float32], patterns: LensPatterns) -> NDArray[np.float32]:
        """Return the same combinations of other patterns, (rank, samples, samples)."""
        return _square(mixing @ self._learnt(patterns))

    def _learnt(self, patterns: LensPatterns) -> NDArray[np.float32]:
        """Return the patterns of runs and their weighted means, mirrored, (learnt, samples^2)."""
        rows = []
        for which, mirror in self._runs:
            some = patterns.compute(self._fields, self._nodes.take(which))
            rows.append(mirror.apply(np.concatenate([some, _MEAN * some.mean(0)[None]])).reshape(len(some) + 1, -1))
        return np.concatenate(rows)

    def coefficients(self, kernels: NDArray[np.float32]) -> NDArray[np.float32]:
        """Project the patterns of all nodes on kernels, (rank, samples, samples).

        Returns
        -------
        float32 array (depths, edges, angles, rank)
        """
        depths, edges, angles = self._shape
        rank = len(kernels)
        found = np.empty((depths * edges, angles, rank), np.float32)
        sums = kernels.sum((1, 2))
        kept = sums / (sums @ sums)
        for first, others in orbits(angles, self._mirrors).items():
            duals = np.concatenate([mirror.apply(kernels, inverse=True).reshape(rank, -1) for _, mirror in others])
            for start in range(0, depths * edges, _BATCH):
                lines = np.arange(start, min(start + _BATCH, depths * edges))
                patterns = self._patterns.compute(self._fields, self._nodes.take(lines * angles + first))
                flat = patterns.reshape(len(lines), -1)
                part = (flat @ duals.T).reshape(len(lines), len(others), rank)
                part += (flat.sum(1)[:, None] - part @ sums)[..., None] * kept
                found[lines[:, None], [other for other, _ in others]] = part
        result = found.reshape(depths, edges, angles, rank)
        result[:, -1] = result[:, -_SETTLED:].mean(1)
        return result


def _square(rows: NDArray[np.float32]) -> NDArray[np.float32]:
    side = math.isqrt(rows.shape[1])
    return rows.reshape(-1, side, side)
