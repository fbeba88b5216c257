"""Pixels and lenses of a part of the array that a fit does not see, and how well their light is predicted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import refuse_if
from ...runtime import Array
from .array_part import PartPixels

TESTS = ("pixels", "lenses")
"""Single pixels, and all pixels of single lenses."""


_BORDER = 2
"""Lenses from the part's border that are not judged: they see what lies outside."""

FEWEST = 110
_FEWEST_JUDGED = 36
"""Lenses of a part, and of them those that can be judged, that are needed so that several are withheld."""

_LEVEL = 0.95
"""Level of the interval that draws of lenses give."""


@dataclass(frozen=True)
class Withheld:
    """Pixels that a fit sees, and, by the names of `TESTS`, those that are predicted and those that choose a prior."""

    used: Array
    tested: dict[str, Array]
    choosing: dict[str, Array]

    @classmethod
    def drawn(cls, part: PartPixels, good: Array, seed: int) -> Withheld:
        """Draw pixels of a part at random, of those that are good."""
        generator = np.random.default_rng(seed)
        columns, rows = part.lenses
        within = np.zeros((rows, columns), bool)
        within[_BORDER:-_BORDER, _BORDER:-_BORDER] = True
        count = within.sum()
        refuse_if(
            count < _FEWEST_JUDGED,
            f"part: {count} of its lenses are not at its border: at least {_FEWEST_JUDGED} are needed to withhold 10 %",
        )
        inner = within.ravel()[part.lens_of]
        draw = {"pixels": generator.random(len(part.pixel)), "lenses": generator.random(columns * rows)[part.lens_of]}
        # Parts of the pixels, and of the lenses, that are predicted.
        test = {name: draw[name] < {"pixels": 0.2, "lenses": 0.1}[name] for name in TESTS}
        # Part of the pixels, and of the lenses, that choose the strength of the prior.
        third = {name: draw[name] > 0.95 for name in TESTS}
        remaining = good & ~np.any([*test.values(), *third.values()], axis=0)
        # Pixels of lenses that are withheld belong to their lens alone.
        alone = test["lenses"] | third["lenses"]
        kinds = {"pixels": ~alone & good & inner, "lenses": good & inner}
        return cls(remaining, *({name: some[name] & kinds[name] for name in TESTS} for some in (test, third)))


def misfit(electrons: Array, predicted: Array, dark_variance: float) -> Array:
    """Return the squared difference of each pixel over the variance of its noise, estimated from the pixel."""
    return (electrons - predicted) ** 2 / (np.maximum(electrons, 1) + dark_variance)


def by_lens(values: Array, chosen: Array, part: PartPixels) -> Array:
    """Return sums of chosen pixels' values, and their number, for each lens: (2, lenses)."""
    count = len(part.lens)
    lens = part.lens_of[chosen]
    return np.stack([np.bincount(lens, values[chosen], count), np.bincount(lens, minlength=count)])


@dataclass(frozen=True)
class Ratio:
    """Residual by rays over that by waves, with the interval that lenses drawn again give.

    Attributes
    ----------
    waves, rays : float
        Root mean square of differences over the noise.
    low, high : float
        Ends of the interval of the ratio.
    """

    waves: float
    rays: float
    low: float
    high: float

    @property
    def ratio(self) -> float:
        """Residual by rays over that by waves."""
        return self.rays / self.waves

    @property
    def better(self) -> str:
        """``waves`` or ``rays``, whichever predicts better, or ``neither`` where the interval holds 1."""
        return "waves" if self.low > 1 else "rays" if self.high < 1 else "neither"

    @classmethod
    def of(cls, waves: Array, rays: Array) -> Ratio:
        """Return the ratio of squared differences by lens (2, lenses), as `by_lens` sums them over all seeds."""
        judged = waves[1] > 0
        count = judged.sum()
        counts = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), 1000)
        ratios = np.sqrt((counts @ rays[0, judged]) / (counts @ waves[0, judged]))
        low, high = np.quantile(ratios, [(1 - _LEVEL) / 2, (1 + _LEVEL) / 2]).tolist()
        by_waves, by_rays = (float(np.sqrt(some[0].sum() / some[1].sum())) for some in (waves, rays))
        return cls(by_waves, by_rays, low, high)
