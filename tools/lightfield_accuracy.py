"""Light fields against what they should show: the table quoted in the documentation.

Renders the letters and the still life with the plenoptic sensor and compares the centre view with Mitsuba's
`perspective`, the parallax of points with the formula, shift-and-add with the ray reconstruction, and the depth map
with the true depth; estimates a lens grid of unknown pitch, rotation and offset.

    python tools/lightfield_accuracy.py --output out/lightfield_accuracy [--spp 64]
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.lightfield import (
    LensGrid,
    decode,
    depth_map,
    disparity,
    epipolar_image,
    estimate_lens_grid,
    focal_stack,
    pick_views,
    view,
    white_image,
)
from mitsuba_plenoptic.lightfield.geometry import view_steps
from mitsuba_plenoptic.report.output_files import write_depth, write_epipolar_image, write_stack, write_views

SCENES = {"letters": (210.0, 240.0, 280.0), "still_life": (215.0, 240.0, 280.0)}
NEAR, FAR = 195.0, 310.0
POINTS = (205.0, 220.0, 240.0, 262.0, 290.0)


def pinhole(scene: object, camera: PlenopticCamera, integrator: dict, per_bin: int, spp: int) -> np.ndarray:
    """Render what the middle of the pupil sees, `per_bin` x `per_bin` pixels a bin."""
    columns, rows = camera.bin_count
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(columns * camera.mla_pitch / (2 * camera.mla_distance))),
            "film": {
                "type": "hdrfilm",
                "width": columns * per_bin,
                "height": rows * per_bin,
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
                "component_format": "float32",
            },
        }
    )
    return np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict(integrator), spp=spp), dtype=np.float64)


def true_depth(scene: object, camera: PlenopticCamera) -> np.ndarray:
    """Distance along the axis (not along the ray) that each bin sees from the middle of the pupil: the median."""
    fine = 5
    columns, rows = camera.bin_count
    z = pinhole(scene, camera, {"type": "aov", "aovs": "place:position"}, fine, 1)[..., -1]
    return np.median(z.reshape(rows, fine, columns, fine).swapaxes(1, 2).reshape(rows, columns, -1), axis=2)


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    """Peak signal-to-noise ratio in decibels, the peak being the reference's maximum."""
    return 10 * math.log10(float(reference.max()) ** 2 / float(np.mean((image - reference) ** 2)))


def points_scene(spp: int) -> Capture:
    """Render five small discs at five distances, spread so that no view brings two together."""
    places = ((0.0, 0.0), (-1.5, -1.5), (1.5, -1.5), (-1.5, 1.5), (1.5, 1.5))
    scene: dict = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": {
            "type": "plenoptic",
            "detector_width": 4.096,
            "film": {
                "type": "hdrfilm",
                "width": 2048,
                "height": 2048,
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
                "component_format": "float32",
            },
        },
    }
    place = mi.ScalarTransform4f()
    for index, (g, (x, y)) in enumerate(zip(POINTS, places, strict=True)):
        scene[f"disc_{index}"] = {
            "type": "disk",
            "to_world": place.translate([-x * g / 120, -y * g / 120, g]).scale(0.16).rotate([0, 1, 0], 180),
            "emitter": {"type": "area", "radiance": {"type": "spectrum", "value": 1.0}},
            "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.0}},
        }
    return render_capture(mi.load_dict(scene), spp=spp, seed=1)


def parallax_error(capture: Capture, index: int) -> tuple[float, float, int]:
    """Compare where fully lit views show a disc with the formula, relative to the middle view.

    Returns
    -------
    root mean square and largest error in pixels of a view, number of views
    """
    lf = decode(capture)
    g = POINTS[index]
    slope = disparity(lf, g)
    signs = ((0, 0), (-1, -1), (1, -1), (-1, 1), (1, 1))[index]
    middle = [sign * 1.5 / capture.camera.mla_pitch + (lf.sizes["s"] - 1) / 2 for sign in signs]
    bins = np.arange(lf.sizes["s"])
    errors = []
    for j, dv in enumerate(view_steps(lf, "v")):
        for i, du in enumerate(view_steps(lf, "u")):
            if lf.weight.values[j, i].min() < 0.999:
                continue
            expected = middle[0] + du * slope, middle[1] + dv * slope
            near = (np.abs(bins - expected[0]) < 5) & (np.abs(bins - expected[1]) < 5)[:, None]
            image = lf.values[j, i] * near
            found = (image.sum(0) @ bins) / image.sum(), (image.sum(1) @ bins) / image.sum()
            errors.append([a - b for a, b in zip(found, expected, strict=True)])
    size = np.array(errors)
    return float(np.sqrt(np.mean(size**2))), float(np.abs(size).max()), len(errors)


def main() -> None:
    """Render, decode, compare, and write the table as Markdown and JSON with the pictures beside it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("out/lightfield_accuracy"))
    parser.add_argument("--spp", type=int, default=64, help="samples per detector pixel")
    arguments = parser.parse_args()
    out = arguments.output
    out.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_mono")
    rows: list[tuple[str, float, str]] = []

    for name, distances in SCENES.items():
        scene = load_scene(name)
        capture = render_capture(scene, spp=arguments.spp)
        lf = decode(capture)
        reference = pinhole(scene, capture.camera, {"type": "path", "max_depth": 6}, 1, 1024)[..., 0]
        centre = view(lf).values
        rows.append(
            (
                f"{name}: centre view at {arguments.spp} samples a pixel, correlation with perspective",
                float(np.corrcoef(centre.ravel(), reference.ravel())[0, 1]),
                # The still life's own noise limits it; see the window below.
                ">= 0.995" if name == "letters" else "",
            )
        )
        for method in ("shift", "fourier"):
            stack = focal_stack(lf, distances, method=method)
            for g, image in zip(distances, stack.values, strict=True):
                # The reconstruction darkens where light leaves the bins, a light field does not.
                inner = (slice(8, -8), slice(8, -8))
                ray = reconstruct(capture, g, footprint="lens").image
                required = ">= 40" if method == "shift" else ""
                rows.append(
                    (
                        f"{name}: {method} at {g:g} mm against ray footprints, dB",
                        psnr(image[inner], ray[inner]),
                        required,
                    )
                )
            write_stack(out / f"{name}_{method}.png", stack)
        write_views(out / f"{name}_views.png", pick_views(lf, 5))
        write_epipolar_image(out / f"{name}_epi.png", epipolar_image(lf, at=2.5 if name == "still_life" else 0.5))
        if name == "still_life":
            # Noise of the light paths, which the reference has not: a window at many more samples.
            window = {"crop_offset_x": 640, "crop_offset_y": 1792, "crop_width": 1024, "crop_height": 1024}
            rows.append(
                (
                    "still_life: the same in a window of 32 x 32 lenses at 16 times the samples",
                    window_correlation(window, 16 * arguments.spp, reference),
                    ">= 0.995",
                )
            )
            found = depth_map(lf, NEAR, FAR)
            write_depth(out / "still_life_depth.png", found)
            truth = true_depth(scene, capture.camera)
            span = float(truth.max() - truth.min())
            error = np.abs(found.depth.values - truth) / span * 100
            sure = found.confidence.values > 0.5
            rows += [
                (
                    "still_life: depth, median error where confidence above half, % of range",
                    float(np.median(error[sure])),
                    "<= 2",
                ),
                ("still_life: depth, 90th percentile of it, %", float(np.percentile(error[sure], 90)), ""),
                ("still_life: share of bins with confidence above half, %", 100 * float(sure.mean()), ""),
                ("still_life: depth, median error of all bins, %", float(np.median(error)), ""),
            ]

    capture = points_scene(8 * arguments.spp)
    for index, g in enumerate(POINTS):
        rms, largest, count = parallax_error(capture, index)
        rows.append((f"point at {g:g} mm: parallax in {count} views, RMS error in pixels", rms, "<= 0.05"))
        rows.append((f"point at {g:g} mm: largest error of a view, pixels", largest, ""))

    camera = PlenopticCamera(resolution=(2048, 2048))
    lattices = {
        "square": LensGrid((16.317, 16.317), (-21.3, -13.7), (140, 140), math.radians(0.3)),
        "hexagonal": LensGrid((17.231, 17.231 * math.sqrt(0.75)), (-21.3, -13.7), (150, 130), math.radians(0.3), 1),
    }
    for name, grid in lattices.items():
        image = white_image(camera, grid)
        image = image + np.random.default_rng(0).normal(0, 0.02, image.shape).astype(np.float32)
        truth = grid.centres().reshape(-1, 2)
        truth = truth[((truth > 0) & (truth < 2048)).all(1)]
        estimated = estimate_lens_grid(image).centres().reshape(-1, 2)
        distance = np.array([np.hypot(*(estimated - centre).T).min() for centre in truth])
        rows.append(
            (
                f"{name} grid turned by 0.3 degrees: centres, RMS error in pixels",
                float(np.sqrt((distance**2).mean())),
                "<= 0.05",
            )
        )

    (out / "lightfield_accuracy.json").write_text(
        json.dumps(
            [{"check": check, "value": value, "required": required} for check, value, required in rows], indent=1
        )
    )
    lines = ["| check | value | required |", "|---|---|---|"]
    lines += [f"| {check} | {value:.4g} | {required} |" for check, value, required in rows]
    table = "\n".join(lines) + "\n"
    (out / "lightfield_accuracy.md").write_text(table)
    print(table)


def window_correlation(window: dict[str, int], spp: int, reference: np.ndarray) -> float:
    """Render a crop window of the still life and compare its centre view with that part of the reference."""
    scene = load_scene("still_life")
    full = scene.sensors()[0]
    camera = PlenopticCamera.from_sensor(full)
    values = {
        name: getattr(camera, name)
        for name in (
            "focal_length",
            "aperture_radius",
            "mla_distance",
            "mla_focal_length",
            "mla_pitch",
            "detector_width",
        )
    }
    sensor = mi.load_dict(
        {
            "type": "plenoptic",
            **values,
            "film": {
                "type": "hdrfilm",
                "width": camera.resolution[0],
                "height": camera.resolution[1],
                **window,
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
                "component_format": "float32",
            },
        }
    )
    cropped = PlenopticCamera.from_sensor(sensor)
    # In passes, whose memory does not grow with the number of samples.
    passes = -(-spp // 8)
    image = sum(np.array(mi.render(scene, sensor=sensor, spp=8, seed=seed))[..., 0] for seed in range(passes)) / passes
    lf = decode(Capture(image, cropped))
    columns, rows = camera.bin_count
    size = camera.bin_size(camera.focus_distance)
    column = np.round(columns / 2 - 0.5 - lf.s.values / size).astype(int)
    row = np.round(rows / 2 - 0.5 - lf.t.values / size).astype(int)
    return float(np.corrcoef(view(lf).values.ravel(), reference[np.ix_(row, column)].ravel())[0, 1])


if __name__ == "__main__":
    main()
