"""Depth maps against ground truth, on scenes by which nothing was chosen and where depth is hard to see."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.report.experiment import pinhole_image
from mitsuba_plenoptic.views import depth_map, distance_of, micro_images
from mitsuba_plenoptic.views.depth import is_focused

from .. import Pivot, Row, at_least, at_most, case, pick
from ..scenes.depth import CAMERAS, HALF, SCENES, made, stage

NEAR_BY = 0.01
"""Relative error of a depth that counts as right."""

CONTRAST = 0.05
"""Contrast, the deviation over the mean of about 5 x 5 bins of the middle view, from which a bin has texture."""

BLOCK, DRAWN = 8, 200
"""Bins along each side of the blocks that are drawn to find what chance is, and how often."""

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


@case(
    "depth.maps",
    "Depth maps against ground truth where the scene has texture, errors in fractions of the distance, and confidence "
    "against the rate of errors below 1 %",
    {
        "scene": "{scene}", "textured bins": "{textured:.0%}", "stated of these": "{stated:.0%}",
        "median error": "{median:.2%}", "90th percentile": "{high:.2%}",
        "median of the surer half": "{sure_median:.2%}",
        "90th percentile of it": "{sure_high:.2%}", "stated of bins without texture": "{guessed:.0%}",
        "confidence: rate, by tenths of the bins": "{tenths}", "worst tenth": "{worst:.2f}", "chance": "{chance:.2f}",
    },
    (at_most("sure_median", 0.005), at_most("sure_high", 0.02), at_most("all_worst", NEAR_RATE)),
    page="docs/theory/depth.md",
    quick={"scenes": ("made 3",), "spp": 4},
)  # fmt: skip
def maps(*, spp: int = 16, tuning: bool = False, scenes: tuple[str, ...] = ()) -> Iterator[Row]:
    """Measure the scenes, or with ``tuning`` those by which constants were chosen; then all together, counted alike.

    `made 1` to `made 4` are heaps of tiles with random patterns. A confidence of 0, at the ends of what can be
    compared, states nothing and does not count.
    """
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for name, settings in pick(TUNING if tuning else JUDGED, scenes).items():
        yield measure(name, *settings, spp, found)
    confidence, right = (np.concatenate(parts) for parts in zip(*found, strict=True))
    tenths = by_tenths(confidence, right, np.concatenate([np.full(len(one), 1 / len(one)) for one, _ in found]))
    worst = worst_tenth(tenths)
    yield {
        "scene": "all", "tenths": shown_tenths(tenths), "worst": worst,
        "all_worst": worst if len(found) == len(JUDGED) else None,
    }  # fmt: skip


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
    name: str, parameters: dict[str, str], near: float, far: float, spp: int, found_of: list[tuple[Any, Any]]
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
    textured = inside & (contrast > CONTRAST)
    is_stated = np.isfinite(depth)
    # The best guess, also where the depth counts as unknown.
    error = np.abs(distance_of(lf, found.disparity.values) / truth - 1)
    # At the ends of what can be compared nothing is stated.
    stating = inside & (confidence > 0)
    stated, right = confidence[stating], error[stating] < NEAR_BY
    found_of.append((stated, right))
    tenths = by_tenths(stated, right, np.ones(len(right)))
    there = error[textured & is_stated]
    sure = error[textured & (confidence >= np.median(confidence[textured]))]
    return {
        "scene": name,
        "textured": float(textured.mean()),
        "stated": float((textured & is_stated).sum() / textured.sum()),
        "median": float(np.median(there)) if there.size else np.nan,
        "high": float(np.percentile(there, 90)) if there.size else np.nan,
        "sure_median": float(np.median(sure)),
        "sure_high": float(np.percentile(sure, 90)),
        "guessed": float((inside & ~textured & is_stated).sum() / max(1, (inside & ~textured).sum())),
        "tenths": shown_tenths(tenths),
        "worst": worst_tenth(tenths),
        "chance": chance(stated, right, stating),
    }


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
    output: Path,
    *,
    scenes: tuple[str, ...] = (),
    cameras: tuple[str, ...] = (),
    captures: str = "",
    before: str = "",
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
