r"""The scene that explains a part of a light field's pixels, by Richardson and Lucy's iteration with a prior.

.. math:: x \leftarrow \frac{x A^T \frac{y + \sigma^2}{A x + \sigma^2} + \beta L \bar x}{A^T 1 + \beta L}

where A has the pixels that are used, L is the light of an element on all pixels, and :math:`\bar x` the mean of x
nearby: a gamma prior of that mean (Lange, Bahn and Little 1987, IEEE Trans. Med. Imaging 6, 106), so that elements
which no used pixel sees are those around. Photons and read noise of variance :math:`\sigma^2` are a Poisson law of
shifted values (Snyder, Hammoud and White 1993, J. Opt. Soc. Am. A 10, 1014). Steps are extrapolated as in
`mitsuba_plenoptic.linear.solver`. Stray light, the part of a lens's mean light that all of its pixels get, is found by
least squares on the way.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from ...linear import Steps, solve
from ...runtime import Array, Progress
from .projector import SceneProjection


@dataclass(frozen=True)
class SceneFit:
    """A scene's elements (see `SceneProjection`), the stray light, and the pixels' light that they predict."""

    scene: Array
    stray: float
    predicted: Array


class _Near:
    """Mean of elements nearby, over those that are seen."""

    def __init__(self, projector: SceneProjection, seen: Array):
        self._projector = projector
        self._seen = seen
        self._whole = np.maximum(self._blurred(seen.astype(np.float32)), 1e-6)

    def _blurred(self, scene: Array) -> Array:
        parts = zip(self._projector.split(scene), self._projector.planes, strict=True)
        # Standard deviation, in pitches, of the mean nearby.
        return self._projector.join([gaussian_filter(image, 0.7 * plane.across) for image, plane in parts])

    def of(self, scene: Array) -> Array:
        """Return the mean nearby of each element."""
        return self._blurred(scene * self._seen) / self._whole


class _PriorSteps(Steps):
    """Steps of Richardson and Lucy with the prior, in some of which stray light is found."""

    def __init__(
        self, projector: SceneProjection, electrons: Array, mask: Array, dark_variance: float, strength: float
    ):
        self.operator = projector
        self.image = electrons
        self.stray = 0.0
        self._mask, self._shift, self._strength = mask.astype(np.float32), np.float32(dark_variance), strength
        self._shifted = np.maximum(electrons * self._mask + self._shift, 0).astype(np.float32)
        self._light, self._all_light = self._spread(self._mask), self._spread(np.ones_like(self._mask))
        # Light of an element over that of the brightest one of its plane, below which it is dark.
        self._seen = self._all_light > 1e-3 * self._all_light.max(axis=(0, 1), keepdims=True)
        self._near = _Near(projector, self._seen)
        self._done = 0
        self.first = projector.forward(self.start())

    def _spread(self, pixels: Array) -> Array:
        # Interpolation at sharp borders of micro-images goes below 0, where steps would multiply without bounds.
        return np.maximum(self.operator.adjoint(np.stack([pixels, np.float32(self.stray) * pixels])), 0)

    def start(self) -> Array:
        """Return an even scene with the light of the pixels that are used."""
        electrons = (self.image * self._mask).sum(dtype=np.float64)
        level = np.float32(electrons / self._light.sum(where=self._seen, dtype=np.float64))
        return np.where(self._seen, level, np.float32(0))

    def step(self, point: Array, model: Array) -> Array:
        """Return the scene after a step from a point whose direct light and glow are `model`."""
        # Steps before which stray light is found.
        if self._done in (2, 5, 9, 14, 19):
            # The part of the mean light that explains best what the direct light leaves, weighted by noise.
            direct, glow = model
            weight = self._mask / (np.maximum(direct, 0) + 1)
            explained = (weight * (self.image - direct) * glow).sum()
            fraction = float(explained / max(float((weight * glow * glow).sum()), 1e-20))
            self.stray = min(max(fraction, 0.0), 0.5)
            self._light, self._all_light = self._spread(self._mask), self._spread(np.ones_like(self._mask))
        self._done += 1
        back = self._spread(self._mask * self._shifted / (np.maximum(self.predicted(model), 0) + self._shift))
        prior = np.float32(self._strength) * self._all_light
        light = self._light + prior + np.float32(1e-20)
        return np.where(self._seen, (point * back + prior * self._near.of(point)) / light, 0).astype(np.float32)

    def predicted(self, model: Array) -> Array:
        """Return the pixels' light from their direct light and their glow."""
        return model[0] + np.float32(self.stray) * model[1]


def fit_scene(
    projector: SceneProjection,
    electrons: Array,
    used: Array,
    dark_variance: float,
    strength: float,
    iterations: int,
    progress: Progress | None = None,
) -> SceneFit:
    """Return the scene that explains electrons (m,) of the pixels that are used; the weight of the prior is beta."""
    steps = _PriorSteps(projector, electrons, used, dark_variance, strength)
    solution = solve(steps, iterations=iterations, accelerate=True, progress=progress)
    return SceneFit(solution.values, steps.stray, steps.predicted(projector.forward(solution.values)))
