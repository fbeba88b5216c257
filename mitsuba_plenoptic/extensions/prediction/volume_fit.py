r"""The volume that explains a part of a light field's pixels, by Richardson and Lucy's iteration with a prior.

.. math:: x \leftarrow \frac{x A^T \frac{y + \sigma^2}{A x + \sigma^2} + \beta L \bar x}{A^T 1 + \beta L}

where A has the pixels that are used, L is the light of a voxel on all pixels, and :math:`\bar x` the mean of x nearby:
a gamma prior of that mean (Lange, Bahn and Little 1987, IEEE Trans. Med. Imaging 6, 106), so that voxels which no used
pixel sees are those around. Photons and read noise of variance :math:`\sigma^2` are a Poisson law of shifted values
(Snyder, Hammoud and White 1993, J. Opt. Soc. Am. A 10, 1014). Steps are extrapolated as in
`deconvolution.solver`. Stray light, the part of a lens's mean light that all of its pixels get, is found by least
squares on the way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from .projector import VolumeProjection

_NEAR = 0.7
"""Standard deviation, in pitches, of the mean nearby."""

_UNSEEN = 1e-3
"""Light of a voxel over that of the brightest one of its plane, below which it is dark."""

_STRAY_STEPS, _MOST_STRAY = frozenset((2, 5, 9, 14, 19)), 0.5
"""Steps before which stray light is found, and its largest value."""


@dataclass(frozen=True)
class VolumeFit:
    """A volume of voxels (see `VolumeProjection`), the stray light, and the pixels' light that they predict."""

    volume: np.ndarray
    stray: float
    predicted: np.ndarray


class _Near:
    """Mean of voxels nearby, over those that are seen."""

    def __init__(self, projector: VolumeProjection, seen: np.ndarray) -> None:
        self._projector, self._seen = projector, seen
        self._whole = np.maximum(self._blurred(seen.astype(np.float32)), 1e-6)

    def _blurred(self, volume: np.ndarray) -> np.ndarray:
        parts = zip(self._projector.split(volume), self._projector.planes, strict=True)
        return self._projector.join([gaussian_filter(image, _NEAR * plane.across) for image, plane in parts])

    def of(self, volume: np.ndarray) -> np.ndarray:
        """Return the mean nearby of each voxel."""
        return self._blurred(volume * self._seen) / self._whole


def fit_volume(
    projector: VolumeProjection,
    electrons: np.ndarray,
    used: np.ndarray,
    *,
    dark_variance: float,
    strength: float,
    iterations: int,
    progress: Callable[[int, int], None],
) -> VolumeFit:
    """Fit a volume to the pixels that are used.

    Parameters
    ----------
    projector : VolumeProjection
        The volume and its part of the array.
    electrons : (m,) array
        Recorded electrons of the pixels.
    used : (m,) bool array
        Pixels that the fit sees.
    dark_variance : float
        Variance of a dark pixel, in electrons squared.
    strength : float
        Weight of the prior, beta.
    iterations : int
        Number of steps.
    progress : callable
        Called with the finished and the whole number of steps.
    """
    mask, shift = used.astype(np.float32), np.float32(dark_variance)
    given = np.maximum(electrons * mask + shift, 0).astype(np.float32)
    stray = 0.0

    def spread(pixels: np.ndarray) -> np.ndarray:
        # Interpolation at sharp borders of micro-images goes below 0, where steps would multiply without bounds.
        return np.maximum(projector.adjoint(pixels, stray), 0)

    all_light = spread(np.ones_like(mask))
    seen = all_light > _UNSEEN * all_light.max(axis=(0, 1), keepdims=True)
    near = _Near(projector, seen)
    light = spread(mask)
    level = np.float32((electrons * mask).sum(dtype=np.float64) / light.sum(where=seen, dtype=np.float64))
    found = np.where(seen, level, np.float32(0))
    last, momentum = found, 0
    for step in range(iterations):
        progress(step, iterations)
        point = found
        if momentum:
            point = np.maximum(found + np.float32(momentum / (momentum + 3)) * (found - last), np.float32(0.5) * found)
        direct, glow = recorded(projector, point)
        if step in _STRAY_STEPS:
            stray = _stray(electrons, mask, direct, glow)
            light, all_light = spread(mask), spread(np.ones_like(mask))
        back = spread(mask * given / (np.maximum(direct + stray * glow, 0) + shift))
        prior = np.float32(strength) * all_light
        new = np.where(seen, (point * back + prior * near.of(point)) / (light + prior + np.float32(1e-20)), 0)
        momentum = 0 if float(np.vdot(new - point, new - found)) < 0 else momentum + 1
        last, found = found, new.astype(np.float32)
    direct, glow = recorded(projector, found)
    progress(iterations, iterations)
    return VolumeFit(found, stray, direct + np.float32(stray) * glow)


def recorded(projector: VolumeProjection, volume: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels' direct light, and the mean light of their lenses."""
    cells = projector.cells(volume)
    even = np.broadcast_to(cells.mean(1, keepdims=True), cells.shape)
    return projector.record(cells), projector.record(even)


def _stray(electrons: np.ndarray, mask: np.ndarray, direct: np.ndarray, glow: np.ndarray) -> float:
    """Return the part of the mean light that explains best what the direct light leaves, weighted by noise."""
    weight = mask / (np.maximum(direct, 0) + 1)
    part = float((weight * (electrons - direct) * glow).sum() / max(float((weight * glow * glow).sum()), 1e-20))
    return min(max(part, 0.0), _MOST_STRAY)
