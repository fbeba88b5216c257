"""Fit what tells of a depth's being right to what is found: the weights of `plane_choice`.

Depth is estimated in scenes that no table judges, `depth_scenes.FITTED_SCENES`, before four cameras, without noise and
with 500 photons in a pixel of value 1. What `plane_choice.indications` returns of each bin with which most neighbours
agree is held against whether its depth is within 1 % of the truth, by logistic regression: maximum likelihood, all bins
counted alike, one set of weights for all cameras, none with the sign that it cannot have. Each scene is also judged by
weights that were fitted to the others.

Prints the weights, the likelihood of those in use, and for each scene left out the stated confidence and the rate of
right depths by tenths of its bins.

    python tools/confidence_fit.py --output out/confidence_fit [--captures FOLDER]
"""

from __future__ import annotations

from pathlib import Path

import accuracy
import mitsuba as mi
import numpy as np
from depth_accuracy import by_tenths, shown_tenths, worst_tenth
from depth_confidence import captured, exposed
from depth_scenes import CAMERAS, FITTED_SCENES
from scipy.optimize import minimize
from scipy.special import expit

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lightfield import micro_images
from mitsuba_plenoptic.lightfield.agreement import finer_stripes
from mitsuba_plenoptic.lightfield.depth import RIGHT, default_slopes, disagreement_of_planes, is_focused
from mitsuba_plenoptic.lightfield.plane_choice import MAJORITY, WEIGHTS, at_an_end, indications

PHOTONS = (0, 500)
MAY_BE_FINER = 0.25
"""Bins of which `finer_stripes` returns more are left out: what it returns is no matter of weights."""

FINER = {"stripes of 1.15 lenses": tuple(CAMERAS), "stripes of 1.3 lenses": ("square", "hexagonal")}
"""Scenes that are left out likewise before some cameras. Of focused ones nothing returns how fine stripes are."""

BOUNDS = [(None, None), (0, None), (None, 0), (0, None)]
"""Of each weight: the sign that it can have."""

COLUMNS = {
    "scene left out": "{scene}",
    "bins": "{bins}",
    "right": "{right:.2f}",
    "confidence and rate, by tenths of the bins": "{tenths}",
    "worst tenth": "{worst:.2f}",
}

Observed = tuple[np.ndarray, np.ndarray]
"""What tells of the depths of a capture's bins, (bins, indications), and which of them are right, (bins,)."""


def observe(capture: mp.Capture, truth: np.ndarray) -> Observed:
    """Return what tells of the depths of a capture's bins, and which are right."""
    lf = mp.decode(capture)
    images = micro_images(capture) if is_focused(lf) else None
    found, samples = disagreement_of_planes(lf, default_slopes(lf), None, images)
    place, told, agreeing = indications(found, samples, RIGHT)
    depth = 1 / np.interp(place, np.arange(len(found.inverse)), found.inverse)
    inside = np.isfinite(truth) & ~at_an_end(found, place, RIGHT) & (agreeing >= MAJORITY)
    if not is_focused(lf):
        inside &= finer_stripes(lf.sel(u=0.0, v=0.0, method="nearest").values) < MAY_BE_FINER
    return told[:, inside].T, np.abs(depth / truth - 1)[inside] < RIGHT


def loss_of(weights: np.ndarray, scenes: list[Observed]) -> tuple[float, np.ndarray]:
    """Return the negative log likelihood per bin, and its derivative by the weights."""
    loss, slope, bins = 0.0, np.zeros_like(weights), sum(len(right) for _, right in scenes)
    for told, right in scenes:
        odds = told @ weights
        loss += float((np.logaddexp(0, odds) - right * odds).sum()) / bins
        slope += told.T @ (expit(odds) - right) / bins
    return loss, slope


def fit(scenes: list[Observed]) -> np.ndarray:
    """Return the most likely weights."""
    start = np.zeros(scenes[0][0].shape[1])
    return np.asarray(minimize(loss_of, start, args=(scenes,), jac=True, bounds=BOUNDS, method="L-BFGS-B").x)


def judge(name: str, observed: list[Observed], others: list[Observed]) -> accuracy.Row:
    """Judge a scene by weights that were fitted to others."""
    told, right = (np.concatenate(parts) for parts in zip(*observed, strict=True))
    tenths = by_tenths(expit(told @ fit(others)), right, np.ones(len(right)))
    return {
        "scene": name,
        "bins": len(right),
        "right": float(right.mean()),
        "tenths": shown_tenths(tenths),
        "worst": worst_tenth(tenths),
    }


def main() -> None:
    """Fit the weights, judge each scene by the others, and write the table."""
    parser = accuracy.options("confidence_fit", __doc__)
    parser.add_argument("--captures", type=Path, help="folder that keeps the rendered captures")
    arguments = accuracy.start(parser)
    mi.set_log_level(mi.LogLevel.Error)
    scenes: dict[str, list[Observed]] = {}
    for name in FITTED_SCENES:
        for camera in (camera for camera in CAMERAS if camera not in FINER.get(name, ())):
            capture, known = captured(name, camera, arguments.captures, fitted=True)
            for photons in PHOTONS:
                observed = observe(exposed(capture, photons, 8), known["truth"])
                if len(observed[1]):
                    scenes.setdefault(name, []).append(observed)
    everything = [one for observed in scenes.values() for one in observed]
    rows = [
        judge(name, observed, [one for key, other in scenes.items() if key != name for one in other])
        for name, observed in scenes.items()
    ]
    weights = fit(everything)
    loss, used = (loss_of(np.asarray(part), everything)[0] for part in (weights, WEIGHTS))
    text = f"Weights: {', '.join(f'{weight:.2f}' for weight in weights)}\n"
    text += f"-log likelihood per bin: {loss:.4f}, of the weights in use: {used:.4f}\n"
    accuracy.finish(arguments, {"weights": weights.tolist(), "loss": loss, "used": used, "left out": rows},
                    accuracy.markdown(COLUMNS, rows), text)  # fmt: skip


if __name__ == "__main__":
    main()
