"""Depth maps against ground truth, on scenes by which nothing was chosen: the table quoted in the documentation.

Renders captures with their ground truth, estimates depth, and compares it bin by bin: how far it is off where the scene
has texture, and how often the stated confidence keeps its word. Confidence is the probability that a depth is within
1 % of the distance. `made 1` to `made 4` are heaps of tiles with random patterns; those with `--tuning` are the ones by
which constants were chosen.

    python tools/depth_accuracy.py --output out/depth_accuracy [--spp 16] [--tuning] [--scenes NAME ...]
"""

from __future__ import annotations

import itertools
from typing import Any

import accuracy
import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lightfield import depth_map, distance_of, micro_images
from mitsuba_plenoptic.lightfield.depth import is_focused
from mitsuba_plenoptic.report.reference import pinhole_image

NEAR_BY = 0.01
"""Relative error of a depth that counts as right."""

TEXTURED = 0.05
"""Contrast, the deviation over the mean of about 5 x 5 bins of the middle view, from which a bin has texture."""

HALF = {"detector_width": "4.096", "resolution": "2048"}

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
    "confidence and rate of errors below 1 %, by tenths": "{tenths}",
    "worst tenth": "{worst:.2f}",
}


def made(number: int, camera: mp.PlenopticCamera | None = None, near: float = 205, far: float = 290) -> Any:
    """Heap tiles at random places, turned and textured at random, before a wall; a third of them without texture.

    Parameters
    ----------
    number : int
        Another one is another heap.
    camera : PlenopticCamera, optional
        Default: the paper's, with half the lenses along each axis.
    near, far : float
        Distances between which the tiles' middles are; the wall is some of that range farther.
    """
    random = np.random.default_rng(number)
    camera = camera or mp.PlenopticCamera(detector_width=4.096, resolution=(2048, 2048))
    field = camera.detector_width / camera.mla_distance
    # Tiles are as large as the field is, and as flat as the range of distances is small beside it.
    size = field * (near + far) / 2 / (4.096 / 120 * 247.5)
    steepest = 50 * min(1.0, (far - near) / size / 85)

    def tile(at: np.ndarray, half: float, tilt: float, plain: bool) -> dict[str, Any]:
        x, y, g = at
        axis = random.normal(size=3)
        place = mi.ScalarTransform4f().translate([x, y, g]).rotate(list(axis / np.linalg.norm(axis)), tilt)
        pattern = gaussian_filter(random.normal(size=(96, 96)), random.uniform(0.6, 2.5), mode="wrap")
        pattern = np.clip(0.45 + 0.22 * pattern / pattern.std(), 0.02, 0.95)
        if plain:
            pattern[:] = random.uniform(0.1, 0.8)
        texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(pattern[..., None].astype(np.float32))}
        return {
            "type": "rectangle",
            "to_world": place.rotate([0, 1, 0], 180).scale(half),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}},
        }

    objects = {"wall": tile(np.array([0, 0, far + (far - near) / 8.5]), 8.0 * size, 8.0 * steepest / 50, False)}
    for index in range(18):
        g = random.uniform(near, far)
        place = np.array([*(random.uniform(-0.5, 0.5, 2) * 4.096 * g / 120), g])
        objects[f"tile_{index}"] = tile(
            place, size * random.uniform(0.5, 1.6), random.uniform(0, steepest), index % 3 == 0
        )
    light = {"type": "point", "position": [30.0, 40.0, 100.0], "intensity": 4e4}
    return mp.load_scene(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "sensor": camera.to_sensor(),
            "sky": {"type": "constant", "radiance": 0.4},
            "lamp": light,
            **objects,
        }
    )


def tenths_of(confidence: np.ndarray, right: np.ndarray, weight: np.ndarray) -> dict[str, Any]:
    """Return the confidence and the rate of right depths, by tenths of the confidence that hold 40 bins at least."""
    tenths = []
    for low, high in itertools.pairwise(np.linspace(0, 1, 11)):
        within = (confidence >= low) & ((confidence < high) | (high == 1))
        if within.sum() >= 40:
            share = weight[within] / weight[within].sum()
            tenths.append((float(confidence[within] @ share), float(right[within] @ share)))
    return {
        "tenths": ", ".join(f"{stated:.2f}: {rate:.2f}" for stated, rate in tenths),
        "worst": max(abs(stated - rate) for stated, rate in tenths),
    }


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
    found_tenths = tenths_of(confidence[inside], error[inside] < NEAR_BY, np.ones(inside.sum()))
    told_of.append((confidence[inside], error[inside] < NEAR_BY))
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
        **found_tenths,
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
    together = tenths_of(confidence, right, weight)
    table = accuracy.markdown(COLUMNS, rows)
    table += f"\nConfidence and rate over all scenes, by tenths: {together['tenths']}; worst {together['worst']:.2f}\n"
    accuracy.finish(arguments, [*rows, {"scene": "all", **together}], table)


if __name__ == "__main__":
    main()
