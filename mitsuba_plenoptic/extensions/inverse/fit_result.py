"""The result of a fit, its uncertainty, and reasons to doubt it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ...camera import PlenopticCamera
from ...errors import refuse_if
from ...runtime import Doubles, Pair
from .fit_light import Pixels, View

_BRIGHTER = 3.0
"""Factor between the light of captures and model above which their units are doubted."""


@dataclass(frozen=True)
class Direction:
    """A joint change of all parameters, with its standard deviation, that is independent of other such changes.

    Attributes
    ----------
    deviation : float
        Standard deviation along the direction, in the units of `Fit.scales`.
    parts : dict
        Component of the direction by parameter; the squares add to 1.
    """

    deviation: float
    parts: dict[str, float]


@dataclass(frozen=True)
class Fit:
    """Camera, parameters and deviations that a fit has found.

    Attributes
    ----------
    values, deviations : dict
        Fitted parameters and their standard deviations by name; parameters with several values are numbered from 1:
        ``mla_offset.1``.
    covariance : float64 array (numbers, numbers)
        Covariance of the parameters, in the order of `values`, from the captures' derivatives: the inverse of Fisher's
        information, with pixels weighted by their variance. For a parameter at a bound, the square of its deviation
        alone.
    scales : dict
        The unit of each parameter in `directions`: a hundredth of it, a degree, a pitch, a wave.
    directions : tuple of Direction
        Directions from the worst determined on: parameters with large parts in a direction of a large deviation cannot
        be separated.
    at_bounds : dict
        Parameters that lie at a bound, nearer than a hundredth of their deviation: by name "lowest" or "highest". Their
        deviations are one-sided: the distance from the bound at which the weighted squares sum to 1 more, with the
        other parameters fitted anew. Other deviations hold for parameters fixed at the bound.
    chi_square, chi_square_deviation : float
        Sum of the weighted squared residuals over its expectation, and its standard deviation: 1 where the model and
        the noise are right.
    pixels : int
        Number of pixels that are neither masked nor saturated.
    steps : int
        Number of cameras tried.
    """

    camera: PlenopticCamera
    values: dict[str, float]
    deviations: dict[str, float]
    covariance: Doubles
    scales: dict[str, float]
    directions: tuple[Direction, ...]
    at_bounds: dict[str, str]
    chi_square: float
    chi_square_deviation: float
    pixels: int
    steps: int


def summary(
    camera: PlenopticCamera,
    labels: list[str],
    x: Doubles,
    unit: Doubles,
    limits: Pair,
    rows: Doubles,
    residuals: Doubles,
    pixels: Pixels,
    steps: int,
) -> Fit:
    """Return the result of a fit; `rows` are weighted derivatives per unit of `Fit.scales`."""
    for label, sensitivity in zip(labels, np.abs(rows).max(axis=0).tolist(), strict=True):
        refuse_if(not sensitivity, f"{label}: the captures do not depend on it, so that it cannot be fitted")
    slope = residuals @ rows
    low = (x - limits[0]) / unit
    high = (limits[1] - x) / unit
    gap = np.where(slope > 0, low, high)
    # A parameter is at a bound if it is nearer than this part of its deviation, or of what lies between its bounds.
    at_bound = gap <= np.maximum(1e-2 * _one_sided(rows, slope, range(len(x))), 1e-6 * (low + high))
    free = np.flatnonzero(~at_bound)
    covariance = np.zeros((len(x), len(x)))
    effective = 0.0
    directions = []
    if len(free):
        # The deviations of an estimate whose weights are not all those of the noise (a "sandwich").
        left, singular, right = np.linalg.svd(rows[:, free], full_matrices=False)
        left *= np.sqrt(pixels.share.reshape(-1, 1))
        effective = float((left**2).sum())
        spread = left / singular @ right
        covariance[np.ix_(free, free)] = spread.T @ spread
        _, deviations, vectors = np.linalg.svd(spread, full_matrices=False)
        for deviation, vector in zip(deviations.tolist(), vectors, strict=True):
            parts = np.zeros(len(x))
            parts[free] = vector
            directions.append(Direction(deviation, dict(zip(labels, parts.tolist(), strict=True))))
    for index in np.flatnonzero(at_bound):
        with_it = np.append(free, index)
        deviation = float(_one_sided(rows[:, with_it], slope[with_it], [len(free)])[0])
        covariance[index, index] = deviation**2
        directions.append(Direction(deviation, {label: float(label == labels[index]) for label in labels}))
    covariance *= np.outer(unit, unit)

    def by_label(values: Doubles) -> dict[str, float]:
        return dict(zip(labels, values.tolist(), strict=True))

    expected = float(pixels.share.sum()) - effective
    refuse_if(
        expected <= 0, f"photons: too few are expected in the pixels that count to fit {len(x)} parameters to them"
    )
    return Fit(
        camera,
        by_label(x),
        by_label(np.sqrt(np.diag(covariance))),
        covariance,
        by_label(unit),
        tuple(sorted(directions, key=lambda direction: -direction.deviation)),
        {labels[index]: "lowest" if slope[index] > 0 else "highest" for index in np.flatnonzero(at_bound)},
        float(residuals @ residuals) / expected,
        float(np.sqrt(pixels.spread.sum())) / expected,
        int(np.isfinite(pixels.weight).sum()),
        steps,
    )


def _one_sided(rows: Doubles, slope: Doubles, components: Sequence[int]) -> Doubles:
    """Return the distances of parameters from their bounds at which the sum of squares is larger by 1."""
    information = np.linalg.pinv(rows.T @ rows)
    steep = np.abs(slope[list(components)])
    return 1 / (steep + np.sqrt(steep**2 + 1 / np.diag(information)[list(components)]))


def steps_along(result: Fit) -> Doubles:
    """Return a step along each direction: one deviation, at most a unit of `Fit.scales`, (directions, parameters)."""
    lengths = np.fmin([direction.deviation for direction in result.directions], 1.0)
    parts = np.array([list(direction.parts.values()) for direction in result.directions])
    return lengths[:, None] * parts * list(result.scales.values())


def doubts(result: Fit, views: Sequence[View], expected: Doubles) -> Iterator[str]:
    """Yield reasons to doubt a fit, one sentence each."""
    if result.at_bounds:
        named = ", ".join(f"{name} = {result.values[name]:.6g} (its {side})" for name, side in result.at_bounds.items())
        yield (
            f"at a bound: {named}: the best camera may lie beyond it; its deviation is one-sided, and those of the "
            "others hold it there"
        )
    # Written so that NaN is also doubted.
    # 5.0: Standard deviations of chi-square by which it may differ from 1.
    if abs(result.chi_square - 1) <= 5.0 * result.chi_square_deviation:
        return
    hints = ""
    lit, modelled = (
        sum(float(image[view.used].sum()) for image, view in zip(images, views, strict=True))
        for images in ([view.image for view in views], expected)
    )
    if not 1 / _BRIGHTER < lit / modelled < _BRIGHTER:
        hints = f"; the captures are {lit / modelled:.3g} times as bright as the model: are both in the same unit?"
    for view in views:
        top = view.image[view.used].max()
        same = int((view.image == top).sum())
        # Pixels of the same highest value above which saturation is suspected.
        if view.saturation is None and same > 10:
            hints += f"; {same} pixels have the same highest value, {top:g}: if they are saturated, give saturation"
    yield (
        f"chi-square is {result.chi_square:.4g} +- {result.chi_square_deviation:.2g} a pixel, not 1: camera, light or "
        f"noise are not those of the captures, and the deviations are not right{hints}"
    )
