"""Fit what tells of a depth's being right to what is found: the weights of `plane_choice`.

Depth is estimated in scenes that `tools/depth_accuracy.py` does not judge: letters, heaps of tiles and cards with
holes, before unfocused and focused cameras, of various noise. What `plane_choice.indications` returns of each bin is
held against whether its depth is within 1 % of the truth, by logistic regression: maximum likelihood, all scenes
counted alike, one set of weights for all cameras. Each scene is also judged by weights that were fitted to the others.

Prints the weights, the likelihood of those in use, and for each scene left out the stated confidence and the rate of
right depths by tenths of its bins.

    python tools/confidence_fit.py --output out/confidence_fit
"""

from __future__ import annotations

from typing import Any

import accuracy
import mitsuba as mi
import numpy as np
from depth_accuracy import by_tenths, shown_tenths, worst_tenth
from depth_scenes import HALF, cards, made
from scipy.optimize import minimize
from scipy.special import expit

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lightfield import disparity, micro_images
from mitsuba_plenoptic.lightfield.depth import RIGHT, disagreement_of_planes, is_focused
from mitsuba_plenoptic.lightfield.plane_choice import WEIGHTS, indications

PLANES = 64
SEARCHED = {"paper": (195.0, 310.0), "galilean": (232.0, 250.0), "keplerian": (232.0, 250.0), "raytrix": (330.0, 400.0)}
"""Distances between which depth is sought, in mm, by camera."""

PARAMETERS = {"raytrix": {"detector_width": "11.22", "resolution": "2040"}}
GENERATORS = {"made": made, "cards": cards}

FITTED: tuple[tuple[str, str, int, float, float], ...] = (
    ("letters", "paper", 16, 0, 0),
    ("galilean", "galilean", 16, 0, 0),
    ("made 5", "paper", 16, 205, 290),
    ("made 6", "paper", 16, 205, 290),
    ("made 7", "paper", 4, 205, 290),
    ("made 8", "paper", 64, 205, 290),
    ("made 9", "paper", 16, 205, 290),
    ("cards 1", "paper", 16, 205, 290),
    ("made 1", "galilean", 16, 234, 247),
    ("made 2", "galilean", 16, 234, 247),
    ("cards 2", "galilean", 16, 234, 247),
    ("made 11", "keplerian", 16, 234, 247),
    ("cards 4", "keplerian", 16, 234, 247),
    ("made 12", "raytrix", 128, 340, 372),
    ("made 13", "raytrix", 128, 340, 372),
    ("cards 3", "raytrix", 128, 345, 368),
)
"""Scene, camera, samples a pixel, and the distances in mm between which generated objects are."""

COLUMNS = {
    "scene left out": "{scene}",
    "bins": "{bins}",
    "right": "{right:.2f}",
    "confidence and rate, by tenths of the bins": "{tenths}",
    "worst tenth": "{worst:.2f}",
}

Observed = tuple[np.ndarray, np.ndarray]
"""What tells of the depths of a scene's bins, (bins, indications), and which of them are right, (bins,)."""


def load(name: str, camera: str, near: float, far: float) -> Any:
    """Return a scene before a camera."""
    kind, _, number = name.partition(" ")
    if kind not in GENERATORS:
        return mp.load_scene(name, parameters=HALF)
    # `made` and `cards` take the paper's camera by themselves.
    known = None
    if camera != "paper":
        known = mp.load_scene(camera, parameters=PARAMETERS.get(camera, HALF)).sensors()[0].camera
    return GENERATORS[kind](int(number), known, near, far)


def observe(name: str, camera: str, spp: int, near: float, far: float) -> Observed:
    """Return what tells of the depths of a scene's bins, and which are right."""
    scene = load(name, camera, near, far)
    capture = mp.render_capture(scene, model="ray", spp=spp)
    lf = mp.decode(capture, truth=mp.ground_truth(scene, ["depth"]))
    nearest, farthest = SEARCHED[camera]
    slopes = np.linspace(disparity(lf, nearest), disparity(lf, farthest), PLANES)
    images = micro_images(capture) if is_focused(lf) else None
    found, samples = disagreement_of_planes(lf, slopes, None, images)
    place, told = indications(found, samples, RIGHT)
    depth = 1 / np.interp(place, np.arange(PLANES), found.inverse)
    truth = lf.depth.sel(u=0.0, v=0.0, method="nearest").values
    inside = np.isfinite(truth) & (truth > nearest) & (truth < farthest)
    return told[:, inside].T, np.abs(depth / truth - 1)[inside] < RIGHT


def loss_of(weights: np.ndarray, scenes: list[Observed]) -> tuple[float, np.ndarray]:
    """Return the negative log likelihood per bin, the mean over scenes, and its derivative by the weights."""
    loss, slope = 0.0, np.zeros_like(weights)
    for told, right in scenes:
        odds = told @ weights
        loss += float((np.logaddexp(0, odds) - right * odds).mean()) / len(scenes)
        slope += told.T @ (expit(odds) - right) / len(right) / len(scenes)
    return loss, slope


def fit(scenes: list[Observed]) -> np.ndarray:
    """Return the most likely weights."""
    return np.asarray(minimize(loss_of, np.zeros(scenes[0][0].shape[1]), args=(scenes,), jac=True).x)


def judge(name: str, observed: Observed, others: list[Observed]) -> accuracy.Row:
    """Judge a scene by weights that were fitted to others."""
    told, right = observed
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
    arguments = accuracy.start(accuracy.options("confidence_fit", __doc__))
    mi.set_log_level(mi.LogLevel.Error)
    scenes = {f"{entry[0]}, {entry[1]}": observe(*entry) for entry in FITTED}
    rows = [
        judge(name, observed, [other for key, other in scenes.items() if key != name])
        for name, observed in scenes.items()
    ]
    everything = list(scenes.values())
    weights = fit(everything)
    loss, used = (loss_of(np.asarray(part), everything)[0] for part in (weights, WEIGHTS))
    text = f"Weights: {', '.join(f'{weight:.2f}' for weight in weights)}\n"
    text += f"-log likelihood per bin: {loss:.4f}, of the weights in use: {used:.4f}\n"
    accuracy.finish(arguments, {"weights": weights.tolist(), "loss": loss, "used": used, "left out": rows},
                    accuracy.markdown(COLUMNS, rows), text)  # fmt: skip


if __name__ == "__main__":
    main()
