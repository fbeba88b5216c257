"""The weights of `plane_choice`, fitted to which depths are right."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views import micro_images
from mitsuba_plenoptic.views.agreement import finer_stripes
from mitsuba_plenoptic.views.depth import RIGHT, default_slopes, disagreement_of_planes, is_focused
from mitsuba_plenoptic.views.plane_choice import WEIGHTS, at_an_end, indications
from mitsuba_plenoptic.views.repetition import wrong_by_repetition

from .. import Row, case
from ..scenes.depth import CAMERAS, FITTED_SCENES
from .depth import by_tenths, captured, exposed, shown_tenths, worst_tenth

PHOTONS = (0, 500)

AMBIGUOUS, MAJORITY = 0.25, 0.5
"""Bins of which `finer_stripes` or `wrong_by_repetition` returns more than the first, or with which a smaller fraction
of the neighbours agrees than the second, are left out: what these take off a probability is no matter of weights."""

FINER = {"stripes of 1.15 lenses": ("square", "hexagonal"), "stripes of 1.3 lenses": ("square", "hexagonal")}
"""Scenes that are left out likewise before some cameras, as the middle view alone does not show that they are finer."""

BOUNDS = [(None, None), (0, None), (None, 0), (0, None)]
"""Of each weight: the sign that it can have."""

Observed = tuple[np.ndarray, np.ndarray]
"""Indications of the depths of a capture's bins, (bins, indications), and which of them are right, (bins,)."""


@case(
    "depth.weights",
    "Weights of a depth's indications, fitted to which depths are right, and each scene judged by weights fitted to "
    "the others",
    {
        "scene left out": "{scene}", "bins": "{bins}", "right": "{right:.2f}",
        "confidence: rate, by tenths of the bins": "{tenths}", "worst tenth": "{worst:.2f}", "weights": "{weights}",
        "-log likelihood per bin": "{loss:.4f}", "of the weights in use": "{used:.4f}",
    },
    page="docs/theory/depth.md",
    quick={"cameras": ("square",), "scenes": 4},
)  # fmt: skip
def weights(*, captures: str = "", cameras: tuple[str, ...] = (), scenes: int = 20) -> Iterator[Row]:
    """Fit scenes that no table judges, before four cameras, without noise and with 500 photons in a pixel of value 1.

    By logistic regression: maximum likelihood, all bins counted alike, one set of weights for all cameras, none with
    the sign that it cannot have.
    """
    mi.set_log_level(mi.LogLevel.Error)
    found: dict[str, list[Observed]] = {}
    for name in list(FITTED_SCENES)[:scenes]:
        for camera in [each for each in cameras or CAMERAS if each not in FINER.get(name, ())]:
            capture, known = captured(name, camera, Path(captures) if captures else None, "fitted")
            for photons in PHOTONS:
                observed = observe(exposed(capture, photons, 8), known["truth"])
                if len(observed[1]):
                    found.setdefault(name, []).append(observed)
    for name, observed in found.items():
        yield judge(name, observed, [one for key, other in found.items() if key != name for one in other])
    everything = [one for observed in found.values() for one in observed]
    fitted = fit(everything)
    loss, used = (loss_of(np.asarray(part), everything)[0] for part in (fitted, WEIGHTS))
    yield {"scene": "none", "weights": ", ".join(f"{each:.2f}" for each in fitted), "loss": loss, "used": used}


def observe(capture: mp.Capture, truth: np.ndarray) -> Observed:
    """Return the indications of the depths of a capture's bins, and which are right."""
    lf = mp.decode(capture)
    slopes, images = default_slopes(lf), micro_images(capture) if is_focused(lf) else None
    found, samples = disagreement_of_planes(lf, slopes, None, images)
    place, indicated, agreeing = indications(found, samples, RIGHT)
    depth = 1 / np.interp(place, np.arange(len(found.inverse)), found.inverse)
    if images:
        ambiguous = wrong_by_repetition(images, slopes)
    else:
        view = lf.sel(u=0.0, v=0.0, method="nearest").values
        ambiguous = finer_stripes(view, np.zeros(view.shape, dtype=bool))
    inside = np.isfinite(truth) & ~at_an_end(found, place, RIGHT) & (agreeing >= MAJORITY) & (ambiguous < AMBIGUOUS)
    return indicated[:, inside].T, np.abs(depth / truth - 1)[inside] < RIGHT


def loss_of(weights: np.ndarray, scenes: list[Observed]) -> tuple[float, np.ndarray]:
    """Return the negative log likelihood per bin, and its derivative by the weights."""
    loss, slope, bins = 0.0, np.zeros_like(weights), sum(len(right) for _, right in scenes)
    for indicated, right in scenes:
        odds = indicated @ weights
        loss += float((np.logaddexp(0, odds) - right * odds).sum()) / bins
        slope += indicated.T @ (expit(odds) - right) / bins
    return loss, slope


def fit(scenes: list[Observed]) -> np.ndarray:
    """Return the most likely weights."""
    start = np.zeros(scenes[0][0].shape[1])
    return np.asarray(minimize(loss_of, start, args=(scenes,), jac=True, bounds=BOUNDS, method="L-BFGS-B").x)


def judge(name: str, observed: list[Observed], others: list[Observed]) -> Row:
    """Judge a scene by weights that were fitted to others."""
    indicated, right = (np.concatenate(parts) for parts in zip(*observed, strict=True))
    tenths = by_tenths(expit(indicated @ fit(others)), right, np.ones(len(right)))
    return {
        "scene": name,
        "bins": len(right),
        "right": float(right.mean()),
        "tenths": shown_tenths(tenths),
        "worst": worst_tenth(tenths),
    }
