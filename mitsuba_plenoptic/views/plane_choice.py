r"""The choice of a plane for each bin: probabilities from the agreement of views in the bin and its neighbours.

The evidence is the logarithm of a ratio :math:`r_d`, as in an analysis of variance: the variance that is left between
views moved for the plane d, over the variance to be explained. N independent samples of unknown deviation have a
likelihood proportional to :math:`r_d^{-N/2}`. For pure noise the ratio is 1 on every plane, with a deviation that
follows from the number of samples, so that the presence of any texture can be tested.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.special import erf, expit, logit

# A neighbour is on the same plane or, half as likely, on each of the next ones; with this probability on any.
_NEXT = 0.5
_ANY = 0.3

# A probability counts as no smaller, and no greater than one less that.
_SURE = 1e-3

# Neighbouring bins over which evidence is averaged: standard deviation of a Gaussian window.
_AVERAGED = 2.0

# Independent samples that the disagreement of a bin's surroundings counts for: of views, and of micro-images of focused
# cameras. Model errors, which most of them share, leave this few.
VIEWS = 20.0
LENSES = 6.0

# Fraction of a variance up to which that of noise is known.
_UNSURE = 0.05

# What `indications` are worth for the log odds that a depth is right, whatever the camera. Found by maximum likelihood
# without stripes of 1.3 and 2 lenses.
WEIGHTS = (-5.1, 0.5, -2.1, 0.7)


@dataclass(frozen=True)
class Choice:
    """Plane chosen for each bin, with its probability."""

    # Index of the plane, with fractions, (rows, columns).
    plane: np.ndarray
    # That the plane is right within the tolerance; 0 where it is at an end of what can be compared, as the right one
    # may lie beyond it. Where a fraction a of the neighbours agrees it is at most 1 - (1 - a)^2: several planes explain
    # repeated texture about as well, and model errors choose among them from bin to bin; and beside an edge the edge
    # may be all the evidence that a bin has.
    probability: np.ndarray
    # Where most neighbours agree.
    agreed: np.ndarray


@dataclass(frozen=True)
class Disagreement:
    """Disagreement of views on each plane of a search."""

    # Variance about each plane over the variance that is to be explained, 1 of noise, (planes, rows, columns); NaN
    # where nothing can be compared.
    ratio: np.ndarray
    # Of noise alone, the ratio has a variance of 1 over this.
    samples: np.ndarray
    # Deviation that is to be explained, over the brightness, (rows, columns).
    contrast: np.ndarray
    # Inverse distances of the planes, falling or rising.
    inverse: np.ndarray
    # Fraction of the variance that is to be explained which is noise, like `ratio`.
    noise: np.ndarray | float = 0.0


def disagreement(
    ratio: np.ndarray,
    total_variance: np.ndarray,
    samples: np.ndarray,
    brightness: np.ndarray,
    inverse: np.ndarray,
    noise: np.ndarray | float = 0.0,
) -> Disagreement:
    """Return the disagreement of views; deviations too small for the bins' brightness count as noise."""
    bright = np.maximum(brightness, 0.02 * brightness.mean()) + np.finfo(np.float32).tiny
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        contrast = np.sqrt(np.nan_to_num(np.nanmedian(total_variance, axis=0))) / bright
    floor = np.square(0.02 * bright)
    return Disagreement(
        (ratio * total_variance + floor) / (total_variance + floor),
        samples,
        contrast,
        inverse,
        noise / (total_variance + floor),
    )


def choose(views: Disagreement, samples: float, tolerance: float) -> Choice:
    """Return the most probable plane of each bin, if its surroundings have enough samples of `VIEWS` or `LENSES`.

    `tolerance` is the relative error up to which a distance counts as right.
    """
    plane, evidence, agreeing, precise = indications(views, samples, tolerance)
    probability = expit(np.tensordot(WEIGHTS, evidence, 1))
    probability = np.minimum(probability, np.minimum(precise, 1 - np.square(1 - agreeing)))
    # A mask of bins whose true plane may lie beyond the last plane. These are bins within the tolerance of the first or
    # the last plane, and bins whose minimum of disagreement is not closed. In a closed minimum the logarithm of the
    # deviation rises on both sides by a part of its difference between the chosen plane and the median of all planes;
    # by less on a side that ends at planes without comparison.
    ratio = views.ratio
    low, high = _around(views.inverse, plane, tolerance)
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        energy = 0.5 * np.log(ratio)
        typical = np.nanmedian(energy, axis=0)
    planes = np.arange(len(energy))[:, None, None]
    least = np.where(np.abs(planes - plane) <= 1, np.nan_to_num(energy, nan=np.inf), np.inf).min(axis=0)
    # Planes that can be compared without a gap between them and the chosen one.
    gaps = np.cumsum(np.isnan(energy), axis=0)
    row, column = np.indices(plane.shape)
    joined = np.isfinite(energy) & (gaps == gaps[np.rint(plane).astype(np.int64), row, column])
    beyond = (low <= 0) | (high >= len(energy) - 1)
    for side in (planes < plane, planes > plane):
        wall = np.where(joined & side, energy, -np.inf).max(axis=0)
        before_gap = (np.isfinite(energy) & side & ~joined).any(axis=0)
        needed = np.where(before_gap, 0.06, 0.15)
        beyond |= ~(wall - least > needed * (typical - least))
    probability = np.where(np.asarray(beyond), 0, probability)
    return Choice(plane, probability, agreeing >= 0.5)


def indications(views: Disagreement, samples: float, tolerance: float) -> tuple[np.ndarray, ...]:
    """Return the most probable planes with fractions, evidence on whether they are right, and what limits it.

    The evidence, (4, rows, columns), is one, followed by logarithms. The second entry is the log odds that the plane is
    right, if the average evidence of the bin's surroundings is taken literally, since repeated texture agrees at
    several distances about as well. The third is the deviation on the best plane, without noise, over the brightness,
    or 0.06 where it is less: at edges of foreground objects, on gloss and on steep surfaces no plane explains the
    views. The fourth is by how many deviations of noise the surroundings' average ratio is below 1 on this plane,
    beyond what pure noise would leave on the best of all planes.

    The third result is the fraction of neighbours that, by their own evidence, are within twice the tolerance of this
    plane; the last the probability that noise moves the least disagreement by less than the tolerance, as it rises to
    planes at twice the tolerance.
    """
    # What cannot be compared agrees as badly as any.
    worst = np.fmax.reduce(views.ratio, axis=0)
    ratio = np.where(np.isnan(views.ratio), np.where(np.isnan(worst), 1, worst), views.ratio)
    energy = 0.5 * np.log(ratio)
    # The evidence is worth two samples where neighbours take part: they share windows, and model errors are alike.
    # The offset, -1/2 to 1/2, of the most probable plane, by a parabola through three logarithms.
    probability = _with_neighbours(_normalised(-2.0 * energy))
    best = probability.argmax(axis=0)
    inner = best.clip(1, len(probability) - 2)
    row, column = np.indices(best.shape)
    before, at, after = (np.log(probability[inner + step, row, column] + 1e-300) for step in (-1, 0, 1))
    bend = 2 * at - before - after
    offset = np.divide(after - before, 2 * bend, out=np.zeros_like(bend), where=bend > 0)
    plane = np.asarray(best + np.where(inner == best, offset.clip(-0.5, 0.5), 0))
    low, high = _around(views.inverse, plane, 2.0 * tolerance)
    best_of_bin = energy.argmin(axis=0) == np.arange(len(energy))[:, None, None]
    neighbours_best = scipy.ndimage.gaussian_filter(best_of_bin.astype(np.float32), (0, 3.0, 3.0), mode="nearest")
    # However far apart planes are, the next ones agree.
    low = np.minimum(low, plane - 1)
    high = np.maximum(high, plane + 1)
    agreeing = _mass(neighbours_best, low, high)
    del best_of_bin, neighbours_best
    # An average holds so many times the independent samples of a bin, whose window has a standard deviation of 1.
    averaged, explained, independent, noise = (
        scipy.ndimage.gaussian_filter(quantity, (0, _AVERAGED, _AVERAGED), mode="nearest")
        for quantity in (
            energy,
            1 - ratio,
            (1 + _AVERAGED**2) * views.samples,
            np.broadcast_to(np.nan_to_num(views.noise), ratio.shape),
        )
    )
    before, here, after = (np.rint(at.clip(0, len(ratio) - 1)).astype(np.int64)[None] for at in (low, plane, high))
    independent, noise, rise = (
        np.take_along_axis(quantity, here, 0)[0] for quantity in (independent, noise, 2 * explained)
    )
    significance = rise / 2 * np.sqrt(independent)
    for side in (before, after):
        rise -= np.take_along_axis(explained, side, 0)[0]
    # Samples share lenses and views, so that noise moves the minimum 1.3 times as far as if they were independent. Of
    # minima that noise hides about 0.3 are right.
    precise = np.maximum(erf(np.sqrt(0.015 * independent * np.maximum(rise, 0) / np.maximum(noise, 1e-6))), 0.3)
    # Noise, of many independent samples, is no error of the model: evidence is what it leaves of the variances.
    noise = noise * (1 - _UNSURE)
    averaged = averaged + 0.5 * np.log(np.maximum(1 - noise / np.maximum(1 - explained, 1e-6), _UNSURE))
    least = ratio.min(axis=0)
    misfit = 0.5 * np.log(np.maximum(least - noise, _UNSURE * least)) + np.log(views.contrast + 1e-30)
    mass = _mass(_normalised(-samples * averaged), *_around(views.inverse, plane, tolerance))
    # Where views are apart by less than 0.06 of the brightness, that no longer makes a depth surer. Noise alone leaves
    # the ratio below 1 by two deviations on the best plane.
    evidence = (
        np.ones_like(plane),
        logit(mass.clip(_SURE, 1 - _SURE)),
        misfit.clip(np.log(0.06)),
        np.log((significance - 2.0).clip(0.3, 30.0)),
    )
    return plane, np.stack(evidence), agreeing, precise


def _around(inverse: np.ndarray, plane: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the planes, with fractions, that bound the distances within the tolerance of a plane, or the ends."""
    planes = np.arange(len(inverse))
    order = np.argsort(inverse)
    at = np.interp(plane, planes, inverse)
    ends = [np.interp(at / (1 + sign * tolerance), inverse[order], planes[order]) for sign in (-1, 1)]
    return np.minimum(*ends), np.maximum(*ends)


def _normalised(logarithm: np.ndarray) -> np.ndarray:
    """Return normalised probabilities over the planes, from logarithms of relative ones."""
    values = np.exp(logarithm - logarithm.max(axis=0))
    return np.asarray(values / values.sum(axis=0))


def _with_neighbours(probability: np.ndarray) -> np.ndarray:
    """Return probabilities of planes multiplied by the messages from the bins on the four sides.

    Belief propagation (Pearl 1988) along rows and columns, each line a chain.
    """
    total = np.log(probability)
    for axis in (1, 2):
        for step in (1, -1):
            lines = np.moveaxis(probability, axis, 0)[::step]
            evidence = np.moveaxis(total, axis, 0)[::step]
            message = np.full(lines.shape[1:], 1 / len(probability))
            for index in range(1, len(lines)):
                belief = lines[index - 1] * message
                belief /= belief.sum(axis=0)
                spread = belief.copy()
                spread[1:] += _NEXT * belief[:-1]
                spread[:-1] += _NEXT * belief[1:]
                message = (1 - _ANY) * spread / spread.sum(axis=0) + _ANY / len(probability)
                evidence[index] += np.log(message)
    return _normalised(total)


def _mass(probability: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the probability between two planes; each plane's probability is spread over its neighbourhood."""
    below = np.concatenate([np.zeros((1, *low.shape)), np.cumsum(probability, axis=0)])
    row, column = np.indices(low.shape)

    def up_to(plane: np.ndarray) -> np.ndarray:
        plane = (plane + 0.5).clip(0, len(probability))
        index = np.minimum(plane.astype(np.int64), len(probability) - 1)
        left = below[index, row, column]
        right = below[index + 1, row, column]
        return np.asarray(left + (plane - index) * (right - left))

    return up_to(high) - up_to(low)
