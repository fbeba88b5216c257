"""What a relation is, and how it is judged on a draw."""

from __future__ import annotations

import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from camera_draws import OPTIONS, Draw, possible

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera.entry import Use

Judgement = tuple[float, float] | None
"""A deviation and its bound, or None where a draw says nothing."""


@dataclass(frozen=True)
class Relation:
    """A relation that cameras obey in one use, but for some options."""

    judge: Callable[[Draw], Judgement]
    use: Use
    without: frozenset[str]
    method: str
    first: Callable[[int], Sequence[str]] | None

    @property
    def name(self) -> str:
        """Name of the function."""
        return self.judge.__name__


RELATIONS: dict[str, Relation] = {}


def relation(
    use: Use, without: str = "", method: str = "", first: Callable[[int], Sequence[str]] | None = None
) -> Callable[[Callable[[Draw], Judgement]], Any]:
    """Add a function to the table of relations.

    It speaks of no camera with the options `without`; one option is drawn from those of `first`, by the seed.
    """
    excluded = frozenset(without.split())
    assert excluded <= set(OPTIONS)

    def add(judge: Callable[[Draw], Judgement]) -> Callable[[Draw], Judgement]:
        RELATIONS[judge.__name__] = Relation(judge, use, excluded, method or use.words, first)
        return judge

    return add


class TooLongError(Exception):
    """The time of a draw is over."""


class Outcome(NamedTuple):
    """What became of a draw: computed, silent (it says nothing), refused, warned, unfinished, or fails."""

    verdict: str
    words: str
    draw: Draw


@cache
def supported(use: Use) -> list[str]:
    """Return the options that the table of support does not refuse for a use."""
    return [name for name in OPTIONS if any(possible(seed, [name], use).options == (name,) for seed in (1, 2, 3))]


def draw_of(relation: Relation, seed: int, times: Callable[[str, str], int] | None = None) -> Draw:
    """Return two to four options at once, seldom fewer, among those that the relation speaks of.

    If `times` tells how often two options were computed, a pair of few times is among them.
    """
    rng = np.random.default_rng([seed, 2])
    allowed = [name for name in OPTIONS if name not in relation.without]
    names = rng.permutation(allowed)[: int(rng.choice([0, 1, 2, 3, 4], p=[0.04, 0.16, 0.3, 0.3, 0.2])) + 2]
    if times:
        both = [name for name in allowed if name in supported(relation.use)]
        pairs = [sorted(rng.choice(both, 2, replace=False), key=both.index) for _ in range(20) if len(both) > 1]
        names = [*min(pairs, key=lambda pair: times(*pair), default=[]), *names]
    if relation.first:
        first = rng.permutation([name for name in relation.first(seed) if name in allowed])
        names = [*first[[bool(possible(seed, [str(name)], relation.use).options) for name in first]][:1], *names]
    drawn = possible(seed, [str(name) for name in names], relation.use)
    return Draw(seed, [str(name) for name in names if name in drawn.options][:4])


def judged(relation: Relation, draw: Draw) -> Outcome:
    """Judge a relation on a draw."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warnings.simplefilter("error", RuntimeWarning)
        try:
            judgement = relation.judge(draw)
        except TooLongError:
            return Outcome("unfinished", "", draw)
        except mp.InputError as error:
            words = str(error)
            named = any(name in words for name in (*draw.options, *draw.parameters))
            return Outcome("refused" if named and "\n" not in words else "fails", f"refusal: {words}", draw)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            words = f"{type(error).__name__}: {str(error)[:200]} ({place.filename}:{place.lineno})"
            return Outcome("fails", words, draw)
    said = [str(warning.message) for warning in caught if issubclass(warning.category, mp.PhysicsWarning)]
    if judgement is None:
        return Outcome("silent", "", draw)
    deviation, bound = judgement
    words = f"{deviation:.3g}, at most {bound:.3g}"
    if deviation <= bound:
        return Outcome("computed", words, draw)
    return Outcome("warned", f"{words}: {said[0][:100]}", draw) if said else Outcome("fails", words, draw)


def shrunk(relation: Relation, outcome: Outcome, end: float) -> Outcome:
    """Return a failure with the fewest options that still fail, as far as found until `end`."""
    for name in outcome.draw.options:
        if time.monotonic() > end:
            break
        fewer = judged(relation, Draw(outcome.draw.seed, [each for each in outcome.draw.options if each != name]))
        if fewer.verdict == "fails":
            outcome = fewer
    return outcome


def off(image: Any, reference: Any) -> float:
    """Return the relative difference in the L2 norm; infinite if either has no light or is not finite."""
    image, reference = np.asarray(image, float), np.asarray(reference, float)
    size = float(np.linalg.norm(reference))
    difference = float(np.linalg.norm(image - reference))
    return difference / size if np.isfinite(difference) and size > 0 else float("inf")


def image_of(camera: mp.PlenopticCamera, points: Sequence[Any], wavelength: float, weights: Any = None) -> np.ndarray:
    """Return the capture of points, each with a point spread of its own."""
    operator = mp.CaptureOperator(camera, points, wavelength=wavelength, accuracy=0.0)
    return np.squeeze(operator.forward(np.ones(len(points)) if weights is None else weights)).astype(float)
