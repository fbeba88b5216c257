"""Depth maps against ground truth, on scenes by which nothing was chosen and where depth is hard to see."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import numpy as np

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.views import depth_map, distance_of, micro_images

from .. import Pivot, Row, at_least, at_most, case, pick
from ..scenes.depth_scenes import CAMERAS, SCENES, stage

NEAR_BY = 0.01
"""Relative error of a depth that counts as right."""


PHOTONS = (0, 2000, 500)
"""Photons in a pixel of value 1; 0 without noise of a detector."""

SPP = {"square": 32, "hexagonal": 32, "focused": 32, "multi-focus": 64}

TEXTURED = ("two planes", "slanted plane", "occluding edges", "weak texture", "plane mirror", "balls")
"""Scenes with texture, of which the bins that an earlier version stated rightly must still be stated."""

SURE = 0.9

Result = dict[str, np.ndarray]
"""Arrays over the bins: depth, confidence, guess, truth, objects."""


@case(
    "depth.confidence",
    "Depths stated by the default search where depth is hard to see: of all bins, those with a stated depth, and of "
    "the depths stated with a confidence above 0.9 those within 1 % (both in %)",
    {
        "scene": "{scene}", "camera": "{camera}", "photons": "{photons}", "stated": "{stated:.0%}",
        "right of these": "{right:.0%}", "confidence above 0.9": "{sure:.0%}",
        "right of these sure": "{sure_right:.0%}",
        "still stated of those right before": "{still:.0%}", "worst tenth": "{worst_apart:.2f}",
        "confidence: rate (bins)": "{tenths}",
    },
    (
        at_least("sure_right", 0.85),
        at_least("still", 0.9),
        at_most("worst_apart", 0.2),
        at_most("all_apart", 0.1),
    ),
    page="docs/theory/depth.md",
    pivot=Pivot("{scene}", "{camera}", "{stated_percent}, {sure_percent}", lambda row: row["camera"] != "all"),
    quick={"scenes": ("two planes",), "cameras": ("square",)},
)  # fmt: skip
def confidence(
    output: Path, *, scenes: tuple[str, ...] = (), cameras: tuple[str, ...] = (), captures: str = "", before: str = ""
) -> Iterator[Row]:
    """Record each scene without noise, with 2000 and with 500 photons in a pixel of value 1.

    In a plane mirror the true depth is that of the mirrored object; bins that show curved mirrors have none and do not
    count. The confidence must be the found rate in each tenth of one capture that holds at least 300 bins of at least 5
    objects, and in each tenth of all bins together. ``captures`` is a folder for rendered captures, which are read from
    there again, ``before`` a ``depths.npz`` of an earlier version: 90 % of what it stated rightly of scenes with
    texture must still be stated.
    """
    mi.set_log_level(mi.LogLevel.Error)
    earlier = dict(np.load(before)) if before else None
    results: dict[str, Result] = {}
    for name in pick(SCENES, scenes):
        for camera in pick(CAMERAS, cameras):
            capture, known = captured(name, camera, Path(captures) if captures else None)
            for photons in PHOTONS:
                key = f"{name}, {camera}, {photons}"
                found = results[key] = estimated(exposed(capture, photons, 7), known)
                old = {"depth": earlier[f"{key}, depth"]} if earlier and name in TEXTURED else None
                yield {"scene": name, "camera": camera, "photons": photons or "no noise", **judged(found, old)}
    arrays = {f"{key}, {part}": values for key, found in results.items() for part, values in found.items()}
    np.savez(output / "depths.npz", **arrays)
    inside = [np.isfinite(found["truth"]) for found in results.values()]
    sure, guess, truth = (
        np.concatenate([found[part][here] for found, here in zip(results.values(), inside, strict=True)])
        for part in ("confidence", "guess", "truth")
    )
    tenths = rates(sure, np.abs(guess / truth - 1) < NEAR_BY, np.zeros(len(truth)))
    apart = max(abs(tenth["stated"] - tenth["found"]) for tenth in tenths)
    whole = not scenes and not cameras
    yield {"scene": "all", "camera": "all", "tenths": shown_rates(tenths), "all_apart": apart if whole else None}


def captured(name: str, camera: str, folder: Path | None, purpose: str = "judged") -> tuple[mp.Capture, Result]:
    """Render a scene, or read it from a folder; return it with the true depth and the object that each bin sees."""
    path = folder / f"{'' if purpose == 'judged' else purpose + ' '}{name}, {camera}.npz" if folder else None
    if path is not None and path.exists():
        with np.load(path) as stored:
            return mp.Capture(stored["image"], CAMERAS[camera][0]), {key: stored[key] for key in ("truth", "objects")}
    built = stage(name, camera, purpose)
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


def shown_rates(tenths: list[dict[str, float]]) -> str:
    """Return confidence, rate and bins of tenths as text."""
    return ", ".join(f"{tenth['stated']:.2f}: {tenth['found']:.2f} ({tenth['bins']})" for tenth in tenths)


def judged(result: Result, before: Result | None) -> Row:
    """Return the figures of one capture; a rate of nothing is None."""
    known = np.isfinite(result["truth"])
    depth, confidence, guess, truth, objects = (
        result[key][known] for key in ("depth", "confidence", "guess", "truth", "objects")
    )
    right, stated = np.abs(guess / truth - 1) < NEAR_BY, np.isfinite(depth)
    sure = stated & (confidence > SURE)
    tenths = rates(confidence, right, objects)
    enough = [each for each in tenths if each["bins"] >= 300 and each["objects"] >= 5]
    of_sure = float(right[sure].mean()) if sure.any() else None
    figures: Row = {
        "stated": float(stated.mean()),
        "right": float(right[stated].mean()) if stated.any() else None,
        "sure": float(sure.mean()),
        "sure_right": of_sure,
        "stated_percent": f"{100 * stated.mean():.0f}",
        "sure_percent": "-" if of_sure is None else f"{100 * of_sure:.0f}",
        "tenths": shown_rates(tenths),
        "worst_apart": max((abs(each["stated"] - each["found"]) for each in enough), default=None),
    }
    if before is not None:
        had = np.abs(before["depth"][known] / truth - 1) < NEAR_BY
        figures["still"] = float((had & stated & right).sum() / had.sum()) if had.any() else None
    return figures
