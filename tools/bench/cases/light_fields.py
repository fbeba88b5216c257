"""Decoded light fields against what they should show."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree
from skimage.metrics import peak_signal_noise_ratio

from mitsuba_plenoptic import Capture, PlenopticCamera, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.report.output_files import write_depth, write_epipolar_image, write_stack, write_views
from mitsuba_plenoptic.views import (
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
from mitsuba_plenoptic.views.coordinates import view_steps

from .. import Row, case, figure, pick

SCENES = {"letters": (210.0, 240.0, 280.0), "still_life": (215.0, 240.0, 280.0)}

NEAR, FAR = 195.0, 310.0

# Distances of five small discs, and on which side of the middle each is.
POINTS = {205.0: (0, 0), 220.0: (-1, -1), 240.0: (1, -1), 262.0: (-1, 1), 290.0: (1, 1)}


@case(
    "light-fields.scenes",
    "The letters and the still life decoded: the centre view against `perspective`, shift-and-add against the ray "
    "reconstruction, the depth map against the true depth",
    quick={"spp": 2, "reference_spp": 16, "scenes": ("letters",)},
)
def scenes(output: Path, *, spp: int = 64, reference_spp: int = 1024, scenes: tuple[str, ...] = ()) -> Iterator[Row]:
    """Compare each scene's light field with what Mitsuba's pinhole sees and with reconstructions by rays."""
    for name, distances in pick(SCENES, scenes).items():
        scene = load_scene(name)
        capture = render_capture(scene, spp=spp)
        lf = decode(capture)
        reference = pinhole(scene, capture.camera, {"type": "path", "max_depth": 6}, 1, reference_spp)[..., 0]
        # The still life's own noise limits it, see the window below, and that of few samples.
        least = 0.995 if name == "letters" and spp >= 64 else None
        found = correlation(view(lf).values, reference)
        yield figure(f"{name}: centre view, correlation with perspective", found, at_least=least)
        for method, least in {"shift": 40.0, "fourier": None}.items():
            stack = focal_stack(lf, distances, method=method)
            for g, image in zip(distances, stack.values, strict=True):
                # The reconstruction darkens where light leaves the bins, a light field does not.
                image, ray = (whole[8:-8, 8:-8] for whole in (image, reconstruct(capture, g, footprint="lens").image))
                psnr = peak_signal_noise_ratio(ray, image, data_range=ray.max())
                yield figure(f"{name}: {method} at {g:g} mm against ray footprints", psnr, at_least=least, unit="dB")
            write_stack(output / f"{name}_{method}.png", stack)
        write_views(output / f"{name}_views.png", pick_views(lf, 5))
        write_epipolar_image(output / f"{name}_epi.png", epipolar_image(lf, at=2.5 if name == "still_life" else 0.5))
        if name != "still_life":
            continue
        # Noise of the light paths, which the reference has not: a window at many more samples.
        found = window_correlation(scene, capture.camera, 16 * spp, reference)
        yield figure(f"{name}: the same, 32 x 32 lenses at 16 times the samples", found, at_least=0.995)
        depths = depth_map(lf, NEAR, FAR)
        write_depth(output / "still_life_depth.png", depths)
        truth = true_depth(scene, capture.camera)
        error = np.abs(depths.depth.values - truth) / (truth.max() - truth.min()) * 100
        sure = depths.confidence.values > 0.5
        what = f"{name}: depth, error where confidence is above half,"
        yield figure(f"{what} median", np.median(error[sure]), at_most=2, unit="% of range")
        yield figure(f"{what} 90th percentile", np.percentile(error[sure], 90), unit="% of range")
        yield figure(f"{name}: bins with confidence above half", 100 * sure.mean(), unit="%")
        yield figure(f"{name}: depth, median error of all bins", np.median(error), unit="% of range")


@case("light-fields.parallax", "Where views show small discs against the formula", quick={"spp": 16})
def parallax(*, spp: int = 512) -> Iterator[Row]:
    """Compare all views that are fully lit."""
    capture = points_capture(spp)
    for g in POINTS:
        rms, largest, count = parallax_error(capture, g)
        yield figure(f"point at {g:g} mm: {count} views, RMS error", rms, at_most=0.05, unit="pixels")
        yield figure(f"point at {g:g} mm: largest error of a view", largest, unit="pixels")


@case("light-fields.grids", "Lens grids of unknown pitch, rotation and offset, estimated from noisy white images")
def grids() -> Iterator[Row]:
    """Estimate a square and a hexagonal grid."""
    camera, angle = PlenopticCamera(resolution=(2048, 2048)), math.radians(0.3)
    for name, grid in {
        "square": LensGrid((16.317, 16.317), (-21.3, -13.7), (140, 140), angle),
        "hexagonal": LensGrid((17.231, 17.231 * math.sqrt(0.75)), (-21.3, -13.7), (150, 130), angle, 1),
    }.items():
        image = white_image(camera, grid)
        image = image + np.random.default_rng(0).normal(0, 0.02, image.shape).astype(np.float32)
        truth = grid.centres().reshape(-1, 2)
        truth = truth[((truth > 0) & (truth < 2048)).all(1)]
        distance, _ = cKDTree(estimate_lens_grid(image).centres().reshape(-1, 2)).query(truth)
        rms = np.sqrt((distance**2).mean())
        yield figure(f"{name} grid turned by 0.3 degrees: centres, RMS error", rms, at_most=0.05, unit="pixels")


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
