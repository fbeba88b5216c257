r"""Which of some planes each bin is on: probabilities from how well views agree, each with those of its neighbours.

The logarithm of the variance :math:`V_d` that views have about the plane d is the evidence: N independent samples of
one unknown deviation have a likelihood proportional to :math:`V_d^{-N/2}` (with that deviation taken out).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.special import expit, logit

# Deviations of a light field that are below this fraction of its brightness, which is at least this fraction of the
# mean, mean nothing.
_NOISE, _DARK = 0.02, 0.02

# A neighbour is on the same plane or, half as likely, on each of the next ones; with this probability on any.
_NEXT, _ANY = 0.5, 0.3

# Samples that the evidence is worth where neighbours take part in it: they share windows, and model errors are alike.
_SHARED = 2.0

# A probability counts as no smaller, and no greater than one less that.
_SURE = 1e-3


# Where views are apart by less than this fraction of the brightness, that no longer makes a depth surer.
_STILL = 0.06

# A valley of the disagreement is closed where it rises, on both sides, by this fraction of its depth.
_CLOSED = 0.15

# Neighbouring bins that are asked whether they are on the same plane, and over which evidence is averaged: standard
# deviations of Gaussian windows.
_ASKED, _AVERAGED = 3.0, 2.0


# Independent samples that the disagreement of a bin's surroundings counts for: of views, and of micro-images of focused
# cameras.
VIEWS, LENSES = 20.0, 3.0

# What `indications` are worth for the log odds that a depth is right, whatever the camera. Found by maximum likelihood
# on captures of the scenes that the case `depth.weights` of `tools/bench` lists, within its bounds, and rounded.
WEIGHTS = (-2.7, 0.7, 3.2, -1.0, -0.3)


@dataclass(frozen=True)
class Choice:
    """The plane of each bin.

    Attributes
    ----------
    place : (rows, columns) float64 array
        Index of the plane, with fractions.
    probability : (rows, columns) float64 array
        That the plane is right within the tolerance; 0 where it is the first or the last one that can be compared, as
        the right one may lie beyond it.
    """

    place: np.ndarray
    probability: np.ndarray


@dataclass(frozen=True)
class Disagreement:
    """How badly views agree about planes.

    Attributes
    ----------
    variance : (planes, rows, columns) array
        Disagreement about each plane; NaN where nothing can be compared.
    brightness : (rows, columns) array
        Of the bins.
    inverse : (planes,) array
        Inverse distances of the planes, falling or rising.
    """

    variance: np.ndarray
    brightness: np.ndarray
    inverse: np.ndarray


def noise_floor(brightness: np.ndarray) -> np.ndarray:
    """Return the variance of views below which differences mean nothing."""
    return np.square(_NOISE * np.maximum(brightness, _DARK * brightness.mean()))


def choose(found: Disagreement, samples: float, tolerance: float) -> Choice:
    """Choose the most probable plane of each bin.

    Parameters
    ----------
    found : Disagreement
        About all planes.
    samples : float
        N of the bin's surroundings: `VIEWS` or `LENSES`.
    tolerance : float
        Relative error of a distance that counts as right.
    """
    place, told = indications(found, samples, tolerance)
    return Choice(place, np.where(at_an_end(found.variance, place), 0, expit(np.tensordot(WEIGHTS, told, 1))))


def at_an_end(variance: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return where no valley of the disagreement is closed at the chosen plane: the right one may be beyond the last.

    On both sides, among the planes that can be compared, the logarithm of the deviation must rise by some of what the
    chosen plane is below the median of all.
    """
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        energy = 0.5 * np.log(variance + np.finfo(np.float32).tiny)
        typical = np.nanmedian(energy, axis=0)
    planes = np.arange(len(energy))[:, None, None]
    least = np.where(np.abs(planes - place) <= 1, np.nan_to_num(energy, nan=np.inf), np.inf).min(axis=0)
    # Planes that can be compared without a gap between them and the chosen one.
    gaps = np.cumsum(np.isnan(energy), axis=0)
    row, column = np.indices(place.shape)
    joined = np.isfinite(energy) & (gaps == gaps[np.rint(place).astype(np.int64), row, column])
    wall = np.minimum(
        *(np.where(joined & side, energy, -np.inf).max(axis=0) for side in (planes < place, planes > place))
    )
    return np.asarray(~(wall - least > _CLOSED * (typical - least)))


def indications(found: Disagreement, samples: float, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable planes, and what tells whether they are right.

    Parameters
    ----------
    found, samples, tolerance
        As for `choose`.

    Returns
    -------
    place : (rows, columns) array
        Index of the plane, with fractions.
    told : (5, rows, columns) array
        What tells whether the plane is right, logarithms but for the first and those about neighbours and valleys:

        - one;
        - the log odds that it is, if the evidence of the bin's surroundings, on average, is taken at its word: noise
          hides the evidence of weak texture in a bin alone;
        - the fraction of the neighbours which by their own evidence are within the tolerance of this plane: without
          evidence they are scattered;
        - the deviation on the best plane over the brightness, or 0.06 where it is less: at edges of what is in front,
          on gloss and on steep surfaces no plane explains the views;
        - how deep the deepest other valley of the deviation is beside this one: `_rivalry`.
    """
    inverse = found.inverse
    bright = np.maximum(found.brightness, _DARK * found.brightness.mean())
    # A light field that is black everywhere has no evidence either.
    tiny = np.finfo(np.float32).tiny
    # What cannot be compared agrees as badly as any.
    worst = np.nan_to_num(np.fmax.reduce(found.variance, axis=0))
    variance = np.where(np.isnan(found.variance), worst, found.variance)
    energy = 0.5 * np.log(variance + noise_floor(found.brightness) + tiny)
    together = _with_neighbours(_normalised(-_SHARED * energy))
    place = _summit(together)
    planes = np.arange(len(inverse))
    order = np.argsort(inverse)
    at = np.interp(place, planes, inverse)
    ends = [np.interp(at / (1 + sign * tolerance), inverse[order], planes[order]) for sign in (-1, 1)]
    low, high = np.minimum(*ends), np.maximum(*ends)
    floor = energy.min(axis=0) - np.log(bright + tiny)
    averaged = scipy.ndimage.gaussian_filter(energy, (0, _AVERAGED, _AVERAGED), mode="nearest")
    own = energy.argmin(axis=0) == planes[:, None, None]
    asked = scipy.ndimage.gaussian_filter(own.astype(np.float64), (0, _ASKED, _ASKED), mode="nearest")
    told = (
        np.ones_like(place),
        logit(_mass(_normalised(-samples * averaged), low, high).clip(_SURE, 1 - _SURE)),
        _mass(asked, low, high),
        floor.clip(np.log(_STILL)),
        _rivalry(averaged, low, high),
    )
    return place, np.stack(told)


def _rivalry(energy: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return how deep the deepest valley of the energy outside of two places is, as a fraction of the one between them.

    Depths are taken from the median over all planes. Repeated texture agrees at several distances about as well, and
    noise at any: the fraction is near 1 then, and above it where the chosen plane is not the best of the bin alone.
    """
    planes = np.arange(len(energy))[:, None, None]
    inside = (planes >= low - 0.5) & (planes <= high + 0.5)
    around = np.pad(energy, ((1, 1), (0, 0), (0, 0)), constant_values=np.inf)
    lowest = (energy <= around[:-2]) & (energy <= around[2:])
    typical = np.median(energy, axis=0)
    own = typical - np.where(inside, energy, np.inf).min(axis=0)
    rival = typical - np.where(lowest & ~inside, energy, np.inf).min(axis=0)
    return np.divide(rival.clip(0), own, out=np.full(own.shape, 2.0), where=own > 0).clip(0, 2)


def _normalised(logarithm: np.ndarray) -> np.ndarray:
    """Return probabilities over the planes from their logarithms, but for a factor."""
    values = np.exp(logarithm - logarithm.max(axis=0))
    return np.asarray(values / values.sum(axis=0))


def _with_neighbours(own: np.ndarray) -> np.ndarray:
    """Multiply the probabilities of each bin with what the bins on its four sides tell, each from those beyond it.

    Belief propagation (Pearl 1988) along rows and columns, each line a chain.
    """
    total = np.log(own)
    for axis in (1, 2):
        for step in (1, -1):
            lines = np.moveaxis(own, axis, 0)[::step]
            told = np.moveaxis(total, axis, 0)[::step]
            message = np.full(lines.shape[1:], 1 / len(own))
            for index in range(1, len(lines)):
                belief = lines[index - 1] * message
                belief /= belief.sum(axis=0)
                spread = belief.copy()
                spread[1:] += _NEXT * belief[:-1]
                spread[:-1] += _NEXT * belief[1:]
                message = (1 - _ANY) * spread / spread.sum(axis=0) + _ANY / len(own)
                told[index] += np.log(message)
    return _normalised(total)


def _summit(probability: np.ndarray) -> np.ndarray:
    """Place of the most probable plane, by a parabola through its logarithm and its neighbours', -1/2 to 1/2 off."""
    best = probability.argmax(axis=0)
    inner = best.clip(1, len(probability) - 2)
    row, column = np.indices(best.shape)
    before, at, after = (np.log(probability[inner + step, row, column] + 1e-300) for step in (-1, 0, 1))
    bend = 2 * at - before - after
    offset = np.divide(after - before, 2 * bend, out=np.zeros_like(bend), where=bend > 0)
    return np.asarray(best + np.where(inner == best, offset.clip(-0.5, 0.5), 0))


def _mass(probability: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the probability between two places; each plane's own is spread evenly over its neighbourhood."""
    below = np.concatenate([np.zeros((1, *low.shape)), np.cumsum(probability, axis=0)])
    row, column = np.indices(low.shape)

    def up_to(place: np.ndarray) -> np.ndarray:
        place = (place + 0.5).clip(0, len(probability))
        whole = np.minimum(place.astype(np.int64), len(probability) - 1)
        left, right = below[whole, row, column], below[whole + 1, row, column]
        return np.asarray(left + (place - whole) * (right - left))

    return up_to(high) - up_to(low)
