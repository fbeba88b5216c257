"""Depth maps against ground truth, on scenes by which nothing was chosen: the table quoted in the documentation.

Renders captures with their ground truth, estimates depth, and compares it bin by bin: how far it is off where the scene
has texture, and how often the stated confidence keeps its word. Confidence is the probability that a depth is within
1 % of the distance; 0 states nothing, at the ends of what can be compared, and does not count. `made 1` to `made 4` are
heaps of tiles with random patterns; those with `--tuning` are the ones by which constants were chosen.

    python tools/depth_accuracy.py --output out/depth_accuracy [--spp 16] [--tuning] [--scenes NAME ...]
"""

from __future__ import annotations

from typing import Any

import accuracy
import numpy as np
from depth_scenes import HALF, made
from scipy.ndimage import gaussian_filter
from verdict import Verdict

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lightfield import depth_map, distance_of, micro_images
from mitsuba_plenoptic.lightfield.depth import is_focused
from mitsuba_plenoptic.report.experiment import pinhole_image

NEAR_BY = 0.01
"""Relative error of a depth that counts as right."""

TEXTURED = 0.05
"""Contrast, the deviation over the mean of about 5 x 5 bins of the middle view, from which a bin has texture."""

BLOCK, DRAWN = 8, 200
"""Bins along each side of the blocks that are drawn to tell what is chance, and how often."""

NEAR_RATE = 0.1
"""Within this the stated confidence is to be of the found rate, in each tenth of the bins of all scenes together."""

# Scenes with the parameters of their cameras, and the distances between which depth is sought.
JUDGED: dict[str, tuple[dict[str, str], float, float]] = {
    "still_life": (HALF, 195, 310),
    "chart": (HALF, 195, 310),
    "made 3": ({}, 195, 310),
    "made 4": ({}, 195, 310),
    "raytrix": ({"detector_width": "11.22", "resolution": "2040"}, 330, 400),
    "keplerian": (HALF, 232, 250),
}
SAMPLES = {"raytrix": 8}
"""Times as many samples a pixel: its lenses are stopped down to half, and each pixel tries those of four neighbours, so
that with 16 samples the noise of the render is 20 % of a pixel, more than any detector's."""

TUNING = {"letters": (HALF, 195, 310), "made 1": ({}, 195, 310), "made 2": ({}, 195, 310), "galilean": (HALF, 232, 250)}
COLUMNS = {
    "scene": "{scene}",
    "textured bins": "{textured:.0%}",
    "told of these": "{told:.0%}",
    "median error": "{median:.2%}",
    "90th percentile": "{high:.2%}",
    "median of the surer half of the textured": "{sure_median:.2%}",
    "90th percentile of it": "{sure_high:.2%}",
    "told of bins without texture": "{guessed:.0%}",
    "confidence and rate of errors below 1 %, by tenths of the bins": "{tenths}",
    "worst tenth": "{worst:.2f}",
    "chance": "{chance:.2f}",
}


def by_tenths(confidence: np.ndarray, right: np.ndarray, weight: np.ndarray) -> list[tuple[float, float]]:
    """Return the mean confidence and the rate of right depths in each tenth of the bins, from the least sure on."""
    order = np.argsort(confidence, kind="stable")
    before = np.cumsum(weight[order]) - weight[order] / 2
    tenth = np.minimum((10 * before / weight.sum()).astype(int), 9)
    parts = [order[tenth == number] for number in range(10)]
    return [
        (
            float(np.average(confidence[part], weights=weight[part])),
            float(np.average(right[part], weights=weight[part])),
        )
        for part in parts
        if part.size
    ]


def worst_tenth(tenths: list[tuple[float, float]]) -> float:
    """Return by how much the stated confidence is off the rate at most."""
    return max(abs(stated - rate) for stated, rate in tenths)


def shown_tenths(tenths: list[tuple[float, float]]) -> str:
    """Return the tenths as text."""
    return ", ".join(f"{stated:.2f}: {rate:.2f}" for stated, rate in tenths)


def chance(confidence: np.ndarray, right: np.ndarray, inside: np.ndarray) -> float:
    """Return the standard deviation that chance gives the rates of tenths, the root mean square over them.

    Neighbouring bins see the same thing, and are right or wrong together. So blocks of bins are drawn anew, with
    repetition (the bootstrap by blocks, Künsch 1989).
    """
    random = np.random.default_rng(0)
    row, column = np.nonzero(inside)
    blocks = [
        np.flatnonzero(part)
        for part in (
            (row // BLOCK == r) & (column // BLOCK == c)
            for r in range(inside.shape[0] // BLOCK + 1)
            for c in range(inside.shape[1] // BLOCK + 1)
        )
        if part.any()
    ]
    differences = []
    for _ in range(DRAWN):
        drawn = np.concatenate([blocks[index] for index in random.integers(len(blocks), size=len(blocks))])
        tenths = by_tenths(confidence[drawn], right[drawn], np.ones(len(drawn)))
        differences.append([rate - stated for stated, rate in tenths])
    return float(np.sqrt(np.var(differences, axis=0).mean()))


def measure(
    name: str, parameters: dict[str, str], near: float, far: float, spp: int, told_of: list[tuple[Any, Any]]
) -> dict[str, Any]:
    """Estimate the depth of a scene, return a row of the table, and append confidences and which depths are right."""
    scene = made(int(name.split()[1])) if name.startswith("made") else mp.load_scene(name, parameters=parameters)
    capture = mp.render_capture(scene, model="ray", spp=spp * SAMPLES.get(name, 1))
    lf = mp.decode(capture, truth=mp.ground_truth(scene, ["depth"]))
    found = depth_map(lf, near, far, micro_images=micro_images(capture) if is_focused(lf) else None)
    truth, depth, confidence = (found[key].values for key in ("truth", "depth", "confidence"))
    # Rendered anew, since noise is no texture.
    image = pinhole_image(scene, capture.camera, lf.sizes["s"], 256)
    mean = gaussian_filter(image, 1.2)
    contrast = np.sqrt(np.maximum(gaussian_filter(image**2, 1.2) - mean**2, 0)) / np.maximum(mean, 1e-6)
    inside = np.isfinite(truth) & (truth > near) & (truth < far)
    textured = inside & (contrast > TEXTURED)
    told = np.isfinite(depth)
    # The best guess, also where the depth counts as unknown.
    error = np.abs(distance_of(lf, found.disparity.values) / truth - 1)
    # At the ends of what can be compared nothing is stated.
    stating = inside & (confidence > 0)
    stated, right = confidence[stating], error[stating] < NEAR_BY
    told_of.append((stated, right))
    tenths = by_tenths(stated, right, np.ones(len(right)))
    there = error[textured & told]
    sure = error[textured & (confidence >= np.median(confidence[textured]))]
    return {
        "scene": name,
        "textured": float(textured.mean()),
        "told": float((textured & told).sum() / textured.sum()),
        "median": float(np.median(there)) if there.size else np.nan,
        "high": float(np.percentile(there, 90)) if there.size else np.nan,
        "sure_median": float(np.median(sure)),
        "sure_high": float(np.percentile(sure, 90)),
        "guessed": float((inside & ~textured & told).sum() / max(1, (inside & ~textured).sum())),
        "tenths": shown_tenths(tenths),
        "worst": worst_tenth(tenths),
        "chance": chance(stated, right, stating),
    }


def main() -> None:
    """Measure all scenes and write the table."""
    parser = accuracy.options("depth_accuracy", __doc__, spp=16)
    parser.add_argument("--tuning", action="store_true", help="the scenes by which constants were chosen, instead")
    parser.add_argument("--scenes", nargs="*", choices=[*JUDGED, *TUNING], help="these alone")
    arguments = accuracy.start(parser)
    chosen = TUNING if arguments.tuning else JUDGED
    if arguments.scenes:
        chosen = {name: (JUDGED | TUNING)[name] for name in arguments.scenes}
    told_of: list[tuple[np.ndarray, np.ndarray]] = []
    rows = [measure(name, *settings, arguments.spp, told_of) for name, settings in chosen.items()]
    # All scenes counted alike.
    confidence, right = (np.concatenate(parts) for parts in zip(*told_of, strict=True))
    weight = np.concatenate([np.full(len(one), 1 / len(one)) for one, _ in told_of])
    together = by_tenths(confidence, right, weight)
    table = accuracy.markdown(COLUMNS, rows)
    table += f"\nConfidence and rate over all scenes, by tenths of the bins: {shown_tenths(together)}\n"
    accuracy.finish(arguments, [*rows, {"scene": "all", "tenths": together}], table)
    verdict = Verdict()
    for row in rows:
        verdict.judge(f"{row['scene']}: median error of the surer half", 100 * row["sure_median"], 0.5, "% ")
        verdict.judge(f"{row['scene']}: 90th percentile of it", 100 * row["sure_high"], 2.0, "% ")
    verdict.judge("confidence off the rate, worst tenth of all scenes", worst_tenth(together), NEAR_RATE)
    if not verdict.kept:
        raise SystemExit("a limit is broken")


if __name__ == "__main__":
    main()
