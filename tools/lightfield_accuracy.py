"""Light fields against what they should show: the table quoted in the documentation.

Renders the letters and the still life with the plenoptic sensor and compares the centre view with Mitsuba's
`perspective`, the parallax of points with the formula, shift-and-add with the ray reconstruction, and the depth map
with the true depth; estimates a lens grid of unknown pitch, rotation and offset.

    python tools/lightfield_accuracy.py --output out/lightfield_accuracy [--spp 64]
"""

from __future__ import annotations

import math
from argparse import Namespace

import accuracy
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree
from skimage.metrics import peak_signal_noise_ratio

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
# Distances of five small discs, and on which side of the middle each is.
POINTS = {205.0: (0, 0), 220.0: (-1, -1), 240.0: (1, -1), 262.0: (-1, 1), 290.0: (1, 1)}
COLUMNS = {"check": "{check}", "value": "{value:.4g}", "required": "{required}"}

Checks = dict[str, tuple[float, str]]
"""By the name of what is checked: its value, and what is required of it."""


def pinhole(scene: object, camera: PlenopticCamera, integrator: dict, per_bin: int, spp: int) -> np.ndarray:
    """Render what the middle of the pupil sees, `per_bin` x `per_bin` pixels a bin."""
    columns, rows = camera.bin_count
    fov = math.degrees(2 * math.atan(columns * camera.mla_pitch / (2 * camera.mla_distance)))
    film = camera.replace(resolution=(columns * per_bin, rows * per_bin)).to_sensor()["film"]
    sensor = mi.load_dict({"type": "perspective", "fov": fov, "film": film})
    return np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict(integrator), spp=spp), dtype=np.float64)


def true_depth(scene: object, camera: PlenopticCamera) -> np.ndarray:
    """Distance along the axis (not along the ray) that each bin sees from the middle of the pupil: the median."""
    fine = 5
    columns, rows = camera.bin_count
    z = pinhole(scene, camera, {"type": "aov", "aovs": "place:position"}, fine, 1)[..., -1]
    return np.median(z.reshape(rows, fine, columns, fine), axis=(1, 3))


def points_capture(spp: int) -> Capture:
    """Render the discs, spread so that no view brings two together."""
    camera = PlenopticCamera(detector_width=4.096, resolution=(2048, 2048))
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 1}, "sensor": camera.to_sensor()}
    place = mi.ScalarTransform4f()
    for g, (x, y) in POINTS.items():
        scene[f"disc_{g:g}"] = {
            "type": "disk",
            "to_world": place.translate([-1.5 * x * g / 120, -1.5 * y * g / 120, g]).scale(0.16).rotate([0, 1, 0], 180),
            "emitter": {"type": "area", "radiance": {"type": "spectrum", "value": 1.0}},
            "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 0.0}},
        }
    return render_capture(mi.load_dict(scene), spp=spp, seed=1)


def parallax_error(capture: Capture, g: float) -> tuple[float, float, int]:
    """Compare where fully lit views show a disc with the formula, relative to the middle view.

    Returns
    -------
    root mean square and largest error in pixels of a view, number of views
    """
    lf = decode(capture)
    slope = disparity(lf, g)
    middle = [sign * 1.5 / capture.camera.mla_pitch + (lf.sizes["s"] - 1) / 2 for sign in POINTS[g]]
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
    arguments = accuracy.start(accuracy.options("lightfield_accuracy", __doc__, spp=64))
    checks: Checks = {}
    for name in SCENES:
        checks |= check_scene(name, arguments)
    checks |= check_parallax(8 * arguments.spp) | check_lens_grids()
    rows = [{"check": check, "value": value, "required": required} for check, (value, required) in checks.items()]
    accuracy.finish(arguments, rows, accuracy.markdown(COLUMNS, rows))


def check_scene(name: str, arguments: Namespace) -> Checks:
    """Compare a scene's light field with what Mitsuba's pinhole sees and with reconstructions by rays."""
    scene, out, distances = load_scene(name), arguments.output, SCENES[name]
    capture = render_capture(scene, spp=arguments.spp)
    lf = decode(capture)
    reference = pinhole(scene, capture.camera, {"type": "path", "max_depth": 6}, 1, 1024)[..., 0]
    # The still life's own noise limits it; see the window below.
    required = ">= 0.995" if name == "letters" else ""
    what = f"{name}: centre view at {arguments.spp} samples a pixel, correlation with perspective"
    checks = {what: (correlation(view(lf).values, reference), required)}
    for method, required in {"shift": ">= 40", "fourier": ""}.items():
        stack = focal_stack(lf, distances, method=method)
        for g, image in zip(distances, stack.values, strict=True):
            # The reconstruction darkens where light leaves the bins, a light field does not.
            image, ray = (whole[8:-8, 8:-8] for whole in (image, reconstruct(capture, g, footprint="lens").image))
            psnr = peak_signal_noise_ratio(ray, image, data_range=ray.max())
            checks[f"{name}: {method} at {g:g} mm against ray footprints, dB"] = float(psnr), required
        write_stack(out / f"{name}_{method}.png", stack)
    write_views(out / f"{name}_views.png", pick_views(lf, 5))
    write_epipolar_image(out / f"{name}_epi.png", epipolar_image(lf, at=2.5 if name == "still_life" else 0.5))
    if name == "still_life":
        # Noise of the light paths, which the reference has not: a window at many more samples.
        window = "still_life: the same in a window of 32 x 32 lenses at 16 times the samples"
        checks[window] = window_correlation(scene, capture.camera, 16 * arguments.spp, reference), ">= 0.995"
        found = depth_map(lf, NEAR, FAR)
        write_depth(out / "still_life_depth.png", found)
        truth = true_depth(scene, capture.camera)
        error = np.abs(found.depth.values - truth) / (truth.max() - truth.min()) * 100
        sure = found.confidence.values > 0.5
        what = "still_life: depth, median error where confidence above half, % of range"
        checks[what] = float(np.median(error[sure])), "<= 2"
        checks["still_life: depth, 90th percentile of it, %"] = float(np.percentile(error[sure], 90)), ""
        checks["still_life: share of bins with confidence above half, %"] = 100 * float(sure.mean()), ""
        checks["still_life: depth, median error of all bins, %"] = float(np.median(error)), ""
    return checks


def check_parallax(spp: int) -> Checks:
    """Compare where the views show the discs with the formula."""
    capture = points_capture(spp)
    checks = {}
    for g in POINTS:
        rms, largest, count = parallax_error(capture, g)
        checks[f"point at {g:g} mm: parallax in {count} views, RMS error in pixels"] = rms, "<= 0.05"
        checks[f"point at {g:g} mm: largest error of a view, pixels"] = largest, ""
    return checks


def check_lens_grids() -> Checks:
    """Estimate lens grids from noisy white images."""
    camera, angle = PlenopticCamera(resolution=(2048, 2048)), math.radians(0.3)
    checks = {}
    for name, grid in {
        "square": LensGrid((16.317, 16.317), (-21.3, -13.7), (140, 140), angle),
        "hexagonal": LensGrid((17.231, 17.231 * math.sqrt(0.75)), (-21.3, -13.7), (150, 130), angle, 1),
    }.items():
        image = white_image(camera, grid)
        image = image + np.random.default_rng(0).normal(0, 0.02, image.shape).astype(np.float32)
        truth = grid.centres().reshape(-1, 2)
        truth = truth[((truth > 0) & (truth < 2048)).all(1)]
        distance, _ = cKDTree(estimate_lens_grid(image).centres().reshape(-1, 2)).query(truth)
        rms = float(np.sqrt((distance**2).mean()))
        checks[f"{name} grid turned by 0.3 degrees: centres, RMS error in pixels"] = rms, "<= 0.05"
    return checks


def window_correlation(scene: object, camera: PlenopticCamera, spp: int, reference: np.ndarray) -> float:
    """Render a crop window of a scene and compare its centre view with that part of the reference."""
    cropped = camera.replace(crop_offset=(640, 1792), crop_size=(1024, 1024))
    sensor = mi.load_dict(cropped.to_sensor())
    # In passes, whose memory does not grow with the number of samples.
    passes = -(-spp // 8)
    image = sum(np.array(mi.render(scene, sensor=sensor, spp=8, seed=seed))[..., 0] for seed in range(passes)) / passes
    lf = decode(Capture(image, cropped))
    columns, rows = camera.bin_count
    size = camera.bin_size(camera.focus_distance)
    column = np.round(columns / 2 - 0.5 - lf.s.values / size).astype(int)
    row = np.round(rows / 2 - 0.5 - lf.t.values / size).astype(int)
    return correlation(view(lf).values, reference[np.ix_(row, column)])


def correlation(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the coefficient of correlation of two images' values."""
    return float(np.corrcoef(image.ravel(), reference.ravel())[0, 1])


if __name__ == "__main__":
    main()
