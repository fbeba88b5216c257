"""Stated depths and their confidence against the truth, where depth is hard to see: a table of the documentation.

Renders the scenes of `depth_scenes.SCENES` before four small cameras, records each without noise, with 2000 and with
500 photons in a pixel of value 1, and estimates depth by the default search. In a plane mirror the true depth is that
of the mirrored object; bins that show curved mirrors have none and do not count. The limits:

- of the depths stated with a confidence above 0.9, at least 85 % are within 1 % of the truth, in each capture;
- the confidence is the found rate within 0.1 in each tenth (0 to 0.1, ...) of all bins together, and within 0.2 in each
  tenth of one capture that holds at least 300 bins of at least 5 objects; a confidence of 0, at the ends of what can be
  compared, states nothing and does not count;
- given the results of an earlier version, at least 90 % of the bins that it stated rightly are still stated, in each
  capture of a scene with texture.

    python tools/depth_confidence.py --output out/depth_confidence [--captures FOLDER] [--before FILE.npz]

Captures are kept in the folder and read from there again. Results are written to depth_confidence.npz.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import accuracy
import mitsuba as mi
import numpy as np
from depth_scenes import CAMERAS, SCENES, stage
from verdict import Verdict

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lightfield import depth_map, distance_of, micro_images

PHOTONS = (0, 2000, 500)
"""Photons in a pixel of value 1; 0 without noise of a detector."""

SPP = {"square": 32, "hexagonal": 32, "focused": 32, "multi-focus": 64}
TEXTURED = ("two planes", "slanted plane", "occluding edges", "weak texture", "plane mirror", "balls")
"""Scenes with texture, of which the bins that an earlier version stated rightly must be kept."""

NEAR_BY, SURE, RIGHT, KEPT = 0.01, 0.9, 0.85, 0.9
TOGETHER, APART, FEWEST, OBJECTS = 0.1, 0.2, 300, 5

Result = dict[str, np.ndarray]
"""Arrays over the bins: depth, confidence, guess, truth, objects."""

COLUMNS = {
    "scene": "{scene}",
    "photons": "{photons}",
    **{camera: "{" + camera.replace("-", "_") + "}" for camera in CAMERAS},
}


def captured(name: str, camera: str, folder: Path | None, fitted: bool = False) -> tuple[mp.Capture, Result]:
    """Render a scene, or read it from a folder; return it with the true depth and the object that each bin sees."""
    path = folder / f"{'fitted ' if fitted else ''}{name}, {camera}.npz" if folder else None
    if path is not None and path.exists():
        with np.load(path) as kept:
            return mp.Capture(kept["image"], CAMERAS[camera][0]), {key: kept[key] for key in ("truth", "objects")}
    built = stage(name, camera, fitted)
    scene = built.scene()
    capture = mp.render_capture(scene, model="ray", spp=SPP[camera])
    truth = mp.ground_truth(scene, ["depth", "shape_index"])
    middle = mp.decode(capture, truth=truth).sel(u=0.0, v=0.0, method="nearest")
    depth, objects = middle.depth.values.astype(np.float64), middle.shape_index.values
    for thing, distance in built.depth_of.items():
        depth[objects == 1 + truth.shapes.index(thing)] = distance
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, image=capture.image, truth=depth, objects=objects)
    return capture, {"truth": depth, "objects": objects}


def exposed(capture: mp.Capture, photons: int, seed: int) -> mp.Capture:
    """Record a capture with the default detector; as it is for 0 photons."""
    return mp.expose(capture, mp.Detector(), photons=photons, seed=seed) if photons else capture


def estimated(capture: mp.Capture, known: Result) -> Result:
    """Estimate depth by the default search."""
    lf = mp.decode(capture)
    images = micro_images(capture) if "unfocused" not in mp.design.focus_types(capture.camera) else None
    found = depth_map(lf, micro_images=images)
    guess = distance_of(lf, found.disparity.values)
    return {"depth": found.depth.values, "confidence": found.confidence.values, "guess": guess, **known}


def rates(confidence: np.ndarray, right: np.ndarray, objects: np.ndarray) -> list[dict[str, float]]:
    """Return confidence and found rate of each tenth, with how many bins and objects are in it."""
    tenth = np.where(confidence > 0, np.minimum((10 * confidence).astype(int), 9), -1)
    return [
        {
            "stated": float(confidence[here].mean()),
            "found": float(right[here].mean()),
            "bins": int(here.sum()),
            "objects": int((np.unique(objects[here], return_counts=True)[1] >= 20).sum()),
        }
        for here in (tenth == number for number in range(10))
        if here.any()
    ]


def judged(result: Result, before: Result | None) -> dict[str, Any]:
    """Return the figures of one capture."""
    known = np.isfinite(result["truth"])
    depth, confidence, guess, truth, objects = (
        result[key][known] for key in ("depth", "confidence", "guess", "truth", "objects")
    )
    right, stated = np.abs(guess / truth - 1) < NEAR_BY, np.isfinite(depth)
    sure = stated & (confidence > SURE)
    figures = {
        "stated": float(stated.mean()),
        "right": float(right[stated].mean()) if stated.any() else np.nan,
        "sure": float(sure.mean()),
        "sure_right": float(right[sure].mean()) if sure.any() else np.nan,
        "tenths": rates(confidence, right, objects),
        "kept": np.nan,
    }
    if before is not None:
        had = np.abs(before["depth"][known] / truth - 1) < NEAR_BY
        figures["kept"] = float((had & stated & right).sum() / had.sum()) if had.any() else np.nan
    return figures


def main() -> None:
    """Measure all captures and write the table."""
    parser = accuracy.options("depth_confidence", __doc__)
    parser.add_argument("--captures", type=Path, help="folder that keeps the rendered captures")
    parser.add_argument("--scenes", nargs="*", choices=SCENES, default=list(SCENES), help="these alone")
    parser.add_argument("--before", type=Path, help="depth_confidence.npz of an earlier version")
    arguments = accuracy.start(parser)
    mi.set_log_level(mi.LogLevel.Error)
    earlier = dict(np.load(arguments.before)) if arguments.before else None
    results: dict[str, Result] = {}
    rows: dict[tuple[str, int], dict[str, Any]] = {}
    figures = {}
    for name in arguments.scenes:
        for camera in CAMERAS:
            capture, known = captured(name, camera, arguments.captures)
            for photons in PHOTONS:
                key = f"{name}, {camera}, {photons}"
                found = results[key] = estimated(exposed(capture, photons, 7), known)
                before = None if earlier is None else {"depth": earlier[f"{key}, depth"]}
                one = figures[key] = judged(found, before)
                row = rows.setdefault((name, photons), {"scene": name, "photons": photons or "no noise"})
                texts = [f"{100 * one[part]:.0f}" for part in ("stated", "right", "sure", "sure_right", "kept")]
                row[camera.replace("-", "_")] = " / ".join("-" if text == "nan" else text for text in texts)
                print(key, row[camera.replace("-", "_")], flush=True)
    np.savez(
        arguments.output / "depth_confidence.npz",
        **{f"{key}, {part}": values for key, found in results.items() for part, values in found.items()},
    )
    known = [np.isfinite(found["truth"]) for found in results.values()]
    confidence, guess, truth = (
        np.concatenate([found[part][here] for found, here in zip(results.values(), known, strict=True)])
        for part in ("confidence", "guess", "truth")
    )
    together = rates(confidence, np.abs(guess / truth - 1) < NEAR_BY, np.zeros(len(truth)))
    shown = ", ".join(f"{tenth['stated']:.2f}: {tenth['found']:.2f} ({tenth['bins']})" for tenth in together)
    text = f"\nConfidence and rate over all captures, by tenths of the confidence (bins): {shown}\n"
    accuracy.finish(
        arguments, {"captures": figures, "together": together}, accuracy.markdown(COLUMNS, rows.values()), text
    )
    verdict = Verdict()
    for key, one in figures.items():
        # NaN, where nothing is stated so surely or nothing was stated rightly before, breaks no limit.
        if one["sure_right"] == one["sure_right"]:
            verdict.judge(f"{key}: wrong of those above 0.9", 1 - one["sure_right"], 1 - RIGHT)
        if key.split(",")[0] in TEXTURED and one["kept"] == one["kept"]:
            verdict.judge(f"{key}: right before, lost", 1 - one["kept"], 1 - KEPT)
        for tenth in one["tenths"]:
            if tenth["bins"] >= FEWEST and tenth["objects"] >= OBJECTS:
                verdict.judge(f"{key}: tenth at {tenth['stated']:.2f}", abs(tenth["stated"] - tenth["found"]), APART)
    for tenth in together:
        verdict.judge(f"all: tenth at {tenth['stated']:.2f}", abs(tenth["stated"] - tenth["found"]), TOGETHER)
    if not verdict.kept:
        raise SystemExit("a limit is broken")


if __name__ == "__main__":
    main()
