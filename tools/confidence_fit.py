"""Fit what the disagreement of views is worth for the confidence of depth maps: the constants of `plane_choice`.

Depth is estimated in scenes that `tools/depth_accuracy.py` does not judge. The log odds of each bin, and how far its
views are apart at the chosen plane, are held against whether its depth is within 1 % of the truth, by logistic
regression: maximum likelihood, all scenes counted alike. Prints the weights, the rate of right depths by tenths of the
fitted confidence, and the likelihood of the constants that are in use.

    python tools/confidence_fit.py --output out/confidence_fit [--spp 16] [--samples 20]
"""

from __future__ import annotations

import argparse
from typing import Any

import accuracy
import mitsuba as mi
import numpy as np
from depth_accuracy import HALF, made
from scipy.optimize import minimize
from scipy.special import expit

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lightfield import disparity
from mitsuba_plenoptic.lightfield.depth import RIGHT, disagreement_of_planes
from mitsuba_plenoptic.lightfield.plane_choice import LENSES, VIEWS, Evidence, indications

PLANES = 64
RANGES = {"views": (195.0, 310.0), "lenses": (232.0, 250.0)}
SCENES: dict[str, tuple[str, ...]] = {
    "views": ("letters", "made 1", "made 2", "made 5", "made 6"),
    "lenses": ("galilean", "made 1", "made 2"),
}
"""What is fitted: `depth_accuracy` judges others. Heaps of tiles stand before an unfocused or the galilean camera."""

COLUMNS = {
    "kind": "{kind}",
    "samples": "{samples:g}",
    "weights of 1, both log odds, and the residual": "{weights}",
    "-log likelihood per bin": "{loss:.4f}",
    "of the constants in use": "{used:.4f}",
    "confidence and rate, by tenths": "{tenths}",
}


def load(kind: str, name: str) -> Any:
    """Return a scene with the kind's camera."""
    if not name.startswith("made"):
        return mp.load_scene(name, parameters=HALF)
    number = int(name.split()[1])
    if kind == "views":
        return made(number)
    camera = mp.load_scene("galilean", parameters=HALF).sensors()[0].camera
    return made(number, camera, 234, 247)


def observe(kind: str, name: str, spp: int, samples: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what tells of the depths of a scene's bins, (bins, 4), and which of them are right."""
    scene = load(kind, name)
    lf = mp.decode(mp.render_capture(scene, model="ray", spp=spp), truth=mp.ground_truth(scene, ["depth"]))
    near, far = RANGES[kind]
    found, _ = disagreement_of_planes(lf, np.linspace(disparity(lf, near), disparity(lf, far), PLANES))
    place, told = indications(found, samples, RIGHT)
    depth = 1 / np.interp(place, np.arange(PLANES), found.inverse)
    truth = lf.depth.sel(u=0.0, v=0.0, method="nearest").values
    inside = np.isfinite(truth) & (truth > near) & (truth < far)
    return told[:, inside].T, np.abs(depth / truth - 1)[inside] < RIGHT


def loss_of(weights: np.ndarray, scenes: list[tuple[np.ndarray, np.ndarray]]) -> tuple[float, np.ndarray]:
    """Return the negative log likelihood per bin, the mean over scenes, and its derivative by the weights."""
    loss, slope = 0.0, np.zeros_like(weights)
    for told, right in scenes:
        odds = told @ weights
        loss += float((np.logaddexp(0, odds) - right * odds).mean()) / len(scenes)
        slope += told.T @ (expit(odds) - right) / len(right) / len(scenes)
    return loss, slope


def fit(kind: str, evidence: Evidence, arguments: argparse.Namespace) -> accuracy.Row:
    """Fit the weights of one kind of evidence."""
    samples = arguments.samples or evidence.samples
    scenes = [observe(kind, name, arguments.spp, samples) for name in SCENES[kind]]
    weights = minimize(loss_of, np.zeros(scenes[0][0].shape[1]), args=(scenes,), jac=True).x
    told, right = (np.concatenate(parts) for parts in zip(*scenes, strict=True))
    stated = expit(told @ weights)
    tenth = np.minimum((10 * stated).astype(int), 9)
    tenths = [f"{stated[tenth == n].mean():.2f}: {right[tenth == n].mean():.2f}" for n in np.unique(tenth)]
    return {
        "kind": kind,
        "samples": samples,
        "weights": ", ".join(f"{weight:.2f}" for weight in weights),
        "loss": loss_of(weights, scenes)[0],
        "used": loss_of(np.array(evidence.weights), scenes)[0],
        "tenths": ", ".join(tenths),
    }


def main() -> None:
    """Fit both kinds and write the table."""
    parser = accuracy.options("confidence_fit", __doc__, spp=16)
    parser.add_argument("--kinds", nargs="*", choices=SCENES, default=list(SCENES))
    parser.add_argument("--samples", type=float, help="N of a bin alone; default: that in use")
    arguments = accuracy.start(parser)
    mi.set_log_level(mi.LogLevel.Error)
    used = {"views": VIEWS, "lenses": LENSES}
    rows = [fit(kind, used[kind], arguments) for kind in arguments.kinds]
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))


if __name__ == "__main__":
    main()
