r"""The choice of a plane for each bin: probabilities from the agreement of views in the bin and its neighbours.

The evidence is the logarithm of a ratio :math:`r_d`, as in an analysis of variance: the variance that is left between
views moved for the plane d, over the variance to be explained. N independent samples of unknown deviation have a
likelihood proportional to :math:`r_d^{-N/2}`. For pure noise the ratio is 1 on every plane, with a deviation that
follows from the number of samples, so that the presence of any texture can be tested.
"""

import warnings
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.special import erf, expit, logit

from ..runtime import Array, Pair

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
    plane: Array
    # That the plane is right within the tolerance; 0 where it is at an end of what can be compared, as the right one
    # may lie beyond it. Where a fraction a of the neighbours agrees it is at most 1 - (1 - a)^2: several planes explain
    # repeated texture about as well, and model errors choose among them from bin to bin; and beside an edge the edge
    # may be all the evidence that a bin has.
    probability: Array
    # Where most neighbours agree.
    agreed: Array
    # Whether another valley of the disagreement is as deep: 0 up to half of the depth, 1 from three quarters on.
    rival: Array


@dataclass(frozen=True)
class Disagreement:
    """Disagreement of views on each plane of a search."""

    # Variance about each plane over the variance that is to be explained, 1 of noise, (planes, rows, columns); NaN
    # where nothing can be compared.
    ratio: Array
    # Of noise alone, the ratio has a variance of 1 over this.
    samples: Array
    # Deviation that is to be explained, over the brightness, (rows, columns).
    contrast: Array
    # Inverse distances of the planes, falling or rising.
    inverse: Array
    # Independent samples in a bin's window, like `ratio`, of the noise that moves the minimum.
    independent: Array
    # Fraction of the variance that is to be explained which is noise, like `ratio`.
    noise: Array | float = 0.0
    # Deviation of errors whatever the noise, over the tolerance, like `ratio`.
    off: Array | float = 0.0


def disagreement(
    ratio: Array,
    total_variance: Array,
    samples: Array,
    independent: Array,
    brightness: Array,
    inverse: Array,
    noise: Array | float,
    off: Array | float,
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
        independent,
        noise / (total_variance + floor),
        off,
    )


def choose(views: Disagreement, samples: float, tolerance: float) -> Choice:
    """Return the most probable plane of each bin, if its surroundings have enough samples of `VIEWS` or `LENSES`.

    `tolerance` is the relative error up to which a distance counts as right.
    """
    plane, evidence, agreeing, precise, rival = indications(views, samples, tolerance)
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
        energy = 0.5 * np.log(np.maximum(ratio - (1 - _UNSURE) * views.noise, _UNSURE * ratio))
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
    probability = np.where(beyond, 0, probability)
    return Choice(plane, probability, agreeing >= 0.5, rival)


def indications(views: Disagreement, samples: float, tolerance: float) -> tuple[Array, ...]:
    """Return the most probable planes with fractions, evidence on whether they are right, and what limits it.

    The evidence, (4, rows, columns), is one, followed by logarithms. The second entry is the log odds that the plane,
    or its valley, is right, if the average evidence of the bin's surroundings is taken literally, since repeated
    texture agrees at several distances about as well. The third is the deviation on the best plane, without noise, over
    the brightness, or 0.06 where it is less: at edges of foreground objects, on gloss and on steep surfaces no plane
    explains the views. The fourth is by how many deviations of noise the surroundings' average ratio is below 1 on this
    plane, beyond what pure noise would leave on the best of all planes.

    The third result is the fraction of neighbours that, by their own evidence, are within twice the tolerance of this
    plane, or as far as noise moves them; the fourth the probability that noise and errors whatever the noise move the
    least disagreement by less than the tolerance; the last the rival of `Choice`.
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
    plane = best + np.where(inner == best, offset.clip(-0.5, 0.5), 0)
    # An average holds so many times the independent samples of a bin, whose window has a standard deviation of 1.
    averaged, explained, samples_near, independent, noise = (
        scipy.ndimage.gaussian_filter(quantity, (0, _AVERAGED, _AVERAGED), mode="nearest")
        for quantity in (
            energy,
            1 - ratio,
            (1 + _AVERAGED**2) * views.samples,
            (1 + _AVERAGED**2) * views.independent,
            np.broadcast_to(np.nan_to_num(views.noise), ratio.shape),
        )
    )
    here = np.rint(plane).astype(np.int64)[None]
    samples_near, independent, noise_here, least = (
        np.take_along_axis(quantity, here, 0)[0] for quantity in (samples_near, independent, noise, 1 - explained)
    )
    significance = (1 - least) * np.sqrt(samples_near)
    # Noise, of many independent samples, is no error of the model: evidence is what it leaves of the variances.
    noise = noise_here * (1 - _UNSURE)
    unexplained = np.exp(2 * averaged)
    averaged = averaged + 0.5 * np.log(np.maximum(1 - noise / np.maximum(1 - explained, 1e-6), _UNSURE))
    # The valley: planes about this one on which evidence is at least halfway from that of the typical plane.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        typical = np.nanmedian(np.where(np.isnan(views.ratio), np.nan, averaged), axis=0)
    height = np.maximum(typical - np.take_along_axis(averaged, here, 0)[0], 1e-6)
    depth = np.where(np.isnan(views.ratio), 0, (typical - averaged) / height)
    gaps = np.cumsum(depth < 0.5, axis=0)
    valley = (depth >= 0.5) & (gaps == np.take_along_axis(gaps, here, 0))
    rival = (4 * np.where(valley, 0, depth).max(axis=0) - 2).clip(0, 1)
    bottom = valley.argmax(axis=0)
    top = len(valley) - 1 - valley[::-1].argmax(axis=0)
    low, high = _around(views.inverse, plane, 2.0 * tolerance)
    # The variance that is left rises as a parabola up to the ends of the valley, where noise hides it least.
    rise = np.zeros_like(plane)
    for end in (np.minimum(low, bottom), np.maximum(high, top)):
        at = np.rint(end.clip(0, len(ratio) - 1)).astype(np.int64)
        away = np.abs(views.inverse[at] / np.interp(plane, np.arange(len(ratio)), views.inverse) - 1)
        left = np.take_along_axis(unexplained, at[None], 0) - np.take_along_axis(unexplained, here, 0)
        rise += left[0] / np.maximum(away / tolerance, 2) ** 2
    # Noise of variance s^2 in n samples, whose squared derivatives have the mean g^2, moves the minimum by a deviation
    # of s / (g sqrt(n)); the variance that is left rises by g^2 on each side. Errors whatever the noise add theirs.
    certain = np.sqrt(independent * np.maximum(rise, 0) / (4 * np.maximum(noise_here, 1e-6)))
    off = np.take_along_axis(np.broadcast_to(views.off, ratio.shape), here, 0)[0]
    precise = erf(certain / np.sqrt(1 + 2 * np.square(off * certain)))
    # Neighbours agree within the deviation by which noise moves their minima, which have a fifth of these samples, as
    # far as the valley reaches; but where another valley is as deep they may disagree about that. However far apart
    # planes are, the next ones agree.
    noisy = _around(views.inverse, plane, tolerance * np.sqrt(4 + 2.5 * (1 - rival) / np.maximum(certain, 0.1) ** 2))
    low = np.minimum(np.minimum(low, plane - 1), np.maximum(noisy[0], bottom))
    high = np.maximum(np.maximum(high, plane + 1), np.minimum(noisy[1], top))
    best_of_bin = energy.argmin(axis=0) == np.arange(len(energy))[:, None, None]
    neighbours_best = scipy.ndimage.gaussian_filter(best_of_bin.astype(np.float32), (0, 3.0, 3.0), mode="nearest")
    agreeing = _mass(neighbours_best, low, high)
    least = ratio.min(axis=0)
    misfit = 0.5 * np.log(np.maximum(least - noise, _UNSURE * least)) + np.log(views.contrast + 1e-30)
    within = _around(views.inverse, plane, tolerance)
    mass = _mass(_normalised(-samples * averaged), np.minimum(within[0], bottom), np.maximum(within[1], top))
    # Where views are apart by less than 0.06 of the brightness, that no longer makes a depth surer. Noise alone leaves
    # the ratio below 1 by two deviations on the best plane.
    evidence = (
        np.ones_like(plane),
        logit(mass.clip(_SURE, 1 - _SURE)),
        misfit.clip(np.log(0.06)),
        np.log((significance - 2.0).clip(0.3, 30.0)),
    )
    return plane, np.stack(evidence), agreeing, precise, rival


def _around(inverse: Array, plane: Array, tolerance: Array | float) -> Pair:
    """Return the planes, with fractions, that bound the distances within the tolerance of a plane, or the ends."""
    planes = np.arange(len(inverse))
    order = np.argsort(inverse)
    at = np.interp(plane, planes, inverse)
    ends = [np.interp(at / (1 + sign * tolerance), inverse[order], planes[order]) for sign in (-1, 1)]
    return np.minimum(*ends), np.maximum(*ends)


def _normalised(logarithm: Array) -> Array:
    """Return normalised probabilities over the planes, from logarithms of relative ones."""
    values = np.exp(logarithm - logarithm.max(axis=0))
    return values / values.sum(axis=0)


def _with_neighbours(probability: Array) -> Array:
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


def _mass(probability: Array, low: Array, high: Array) -> Array:
    """Return the probability between two planes; each plane's probability is spread over its neighbourhood."""
    below = np.concatenate([np.zeros((1, *low.shape)), np.cumsum(probability, axis=0)])
    row, column = np.indices(low.shape)

    def up_to(plane: Array) -> Array:
        plane = (plane + 0.5).clip(0, len(probability))
        index = np.minimum(plane.astype(np.int64), len(probability) - 1)
        left = below[index, row, column]
        right = below[index + 1, row, column]
        return left + (plane - index) * (right - left)

    return up_to(high) - up_to(low)
