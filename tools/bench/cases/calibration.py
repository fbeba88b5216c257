"""Calibrations against a real camera, COMPOTE's result for it, and white images.

Data of the real camera (Raytrix R12, Labussiere et al. 2020) are taken from the folder that MITSUBA_PLENOPTIC_DATA
names, in ``raytrix_r12a``.

Boards that are rendered and detected, and the cameras calibrated by them against those that rendered them.
"""

from __future__ import annotations

import functools
import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from mitsuba_plenoptic import InputError, PlenopticCamera, calibrate, render_capture
from mitsuba_plenoptic.calibration import (
    Board,
    Calibration,
    LensIndex,
    Table,
    board_scene,
    camera_centres,
    concatenate,
    cross_validate,
    detect_corners,
    find_centres,
    read_camera,
    read_centres,
    read_corners,
)
from mitsuba_plenoptic.extensions.calibrate.board_model import NAMES, Observations, numbers_of, predict, predict_centres
from mitsuba_plenoptic.extensions.calibrate.observations import observations
from mitsuba_plenoptic.views import LensGrid, white_image

from .. import Row, case, figure
from ..scenes.light_paths import facing, radiating, scene_of
from ..timing import once

BOARD = Board(9, 5, 10.0)


class Compote:
    """COMPOTE's own model with the parameters that it found: points are distorted, not rays; written from its paper."""

    def __init__(self, values: dict) -> None:
        def numbers(entry: list) -> np.ndarray:
            return np.array(entry, dtype=float)

        self.f = float(values["main_lens"]["f"])
        mesh = values["mla"]["mesh"]
        self.turn, self.shift = numbers(mesh["pose"]["rotation"]), numbers(mesh["pose"]["translation"][0])
        self.pitch = numbers(mesh["pitch"][0])
        self.sensor = numbers(values["sensor"]["pose"]["translation"][0])
        distortions = values["distortions"]
        self.k, self.p = numbers(distortions["radial"][0]), numbers(distortions["tangential"][0])

    def pixels(self, table: Table, pose: np.ndarray) -> np.ndarray:
        """Where the lenses of a table see its corners, from a pose in COMPOTE's frame."""
        corner = np.concatenate([BOARD.places(table["cluster"]), np.zeros((len(table["k"]), 1))], axis=1)
        X = Rotation.from_rotvec(pose[:3]).apply(corner) + pose[3:]
        q = X * (-self.f / (X[:, 2] - self.f))[:, None]
        x, y = q[:, 0], q[:, 1]
        square = x * x + y * y
        radial = 1 + square * (self.k[0] + square * (self.k[1] + square * self.k[2]))
        qx = x * radial + self.p[0] * (square + 2 * x * x) + 2 * self.p[1] * x * y
        qy = y * radial + self.p[1] * (square + 2 * y * y) + 2 * self.p[0] * x * y
        i, j = 175 - table["k"], 151 - table["l"]
        centre = np.stack([(i + 0.5 * ((j + 1) % 2)) * self.pitch[0], j * self.pitch[1] * 0.75**0.5, 0 * i], axis=-1)
        c = centre @ self.turn.T + self.shift
        along = ((self.sensor[2] - c[:, 2]) / (c[:, 2] - q[:, 2]))[:, None]
        at = c[:, :2] + along * (c[:, :2] - np.stack([qx, qy], axis=-1))
        return np.array([4079, 3067]) - (at - self.sensor[:2]) / 0.0055

    def refit(self, table: Table, pose: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the RMS error of one pose, refitted, and the pose."""
        found = least_squares(lambda p: (self.pixels(table, p) - table.pixel).ravel(), pose, x_scale="jac", method="lm")
        return float(np.sqrt(2 * found.cost / len(table["k"]))), found.x


def data_folder() -> Path:
    """Return the folder with the data of the real camera."""
    folder = Path(os.environ.get("MITSUBA_PLENOPTIC_DATA", "")) / "raytrix_r12a"
    if not (folder / "corners.csv").is_file():
        raise InputError(f"no data of a real camera in {folder}: set MITSUBA_PLENOPTIC_DATA")
    return folder


@functools.cache
def calibrated() -> tuple[Table, Table, Calibration, float]:
    """Return corners and centres of the real camera, its calibration, and the processor time."""
    folder, start = data_folder(), PlenopticCamera.preset("raytrix")
    corners = read_corners(folder / "corners.csv", BOARD, start.crop_size)
    centres = read_centres(folder / "centres.csv")
    found, _, processor = once(lambda: calibrate(corners, BOARD, start, centres))
    return corners, centres, found, processor


@case("calibration.real", "The calibration of a real Raytrix R12 against COMPOTE's", page="docs/guides/calibration.md")
def real_camera() -> Iterator[Row]:
    """Compare errors over all corners, by poses that are left out, and the cameras' figures in deviations."""
    values = json.loads((data_folder() / "compote_intrinsics.json").read_text())
    corners, centres, found, processor = calibrated()
    result = found.evaluation
    yield figure("processor time of the calibration", processor, at_most=20.0, unit="s")
    yield figure("RMS over every row", result.error, at_most=0.965, unit="px")
    yield figure("centres of micro-images from the camera", found.centre_error or math.nan, at_most=0.30, unit="px")
    affine, tilted = grid_errors(found.index.unit(centres["k"], centres["l"]), centres.pixel)
    yield figure("centres from an affine grid", affine, unit="px")
    yield figure("centres from a tilted grid", tilted, at_most=0.26, unit="px")
    assert found.blur is not None
    theirs_f = sorted(float(values["d"]) / float(f) for f in values["mla"]["focal_lengths"])
    ours_f = sorted(found.numbers["detector_distance"] / f for f in found.blur.focal_lengths)
    apart = max(abs(ours / other - 1) for ours, other in zip(ours_f, theirs_f, strict=True))
    yield figure("z over focal lengths of microlenses from COMPOTE's, relative", apart, at_most=0.02)
    yield from displaced_by_type(corners, centres, found)
    left_out = cross_validate(corners, BOARD, found, centres)
    compote, theirs, depths = Compote(values), [], []
    # Their x and y are ours reversed.
    flip = Rotation.from_rotvec([0, 0, np.pi])
    all_corners = np.concatenate([BOARD.places(np.arange(45)), np.zeros((45, 1))], axis=1)
    for index, frame in enumerate(result.frames):
        mine, pose = corners.keep(corners["frame"] == frame), result.poses[index]
        first = np.concatenate([(flip * Rotation.from_rotvec(pose[:3])).as_rotvec(), pose[3:] * [-1, -1, 1]])
        error, refitted = compote.refit(mine, first)
        theirs.append((error, len(mine["k"])))
        depths.append([(Rotation.from_rotvec(p[:3]).apply(all_corners) + p[3:])[:, 2] for p in (pose, refitted)])
        yield figure(f"frame {frame}, {theirs[-1][1]} rows: ours", result.pose_errors[index], unit="px")
        yield figure(f"frame {frame}: left out", left_out[int(frame)], unit="px")
        yield figure(f"frame {frame}: COMPOTE", error, unit="px")
    errors, rows = np.array(theirs).T
    overall = math.sqrt((errors**2 * rows).sum() / rows.sum())
    yield figure("COMPOTE over every row (1.0858 is published)", overall, unit="px")
    yield figure("mean of left-out poses", np.mean(list(left_out.values())), at_most=float(errors.mean()), unit="px")
    difference = np.array([ours - compotes for ours, compotes in depths])
    yield figure("depth of the board's corners against COMPOTE's, mean", difference.mean(), unit="mm")
    yield figure("... and RMS about that", (difference - difference.mean()).std(), unit="mm")
    for name, other in zip(NAMES, numbers_of(read_camera(data_folder() / "compote_intrinsics.json")[0]), strict=True):
        if not name.startswith("offset"):  # of another lens
            value, deviation = found.numbers[name], found.deviations[name]
            what = f"{name}, ours {value:.6g}, COMPOTE's {other:.6g}: deviations apart"
            yield figure(what, (value - other) / deviation)


@case(
    "calibration.corners",
    "The calibration of a real Raytrix R12 from corners alone, against that with centres",
    page="docs/guides/calibration.md",
)
def corners_alone() -> Iterator[Row]:
    """Compare the focal length, the centres of micro-images and the errors of poses that are left out."""
    corners, centres, both, _ = calibrated()
    found = calibrate(corners, BOARD, PlenopticCamera.preset("raytrix"))
    f, deviation = found.numbers["focal_length"], found.deviations["focal_length"]
    yield figure("focal length", f, unit="mm")
    yield figure("its deviation", deviation, unit="mm")
    yield figure("deviations from that with centres", abs(f - both.numbers["focal_length"]) / deviation, at_most=2.0)
    yield figure("RMS over every row", found.evaluation.error, unit="px")
    left_out = cross_validate(corners, BOARD, found)
    yield figure("mean of left-out poses", np.mean(list(left_out.values())), at_most=1.12, unit="px")
    yield figure("boards in other poses, as stated", found.prediction_deviation, at_most=1.0, unit="px")
    geometry = {"pixel_size": found.camera.pixel_size, "row_ratio": found.camera.lattice.row_ratio}
    unit = found.index.unit(centres["k"], centres["l"])
    apart = predict_centres(np.array(list(found.numbers.values())), unit, **geometry)[0] - centres.pixel
    yield figure("centres of micro-images", np.sqrt((apart**2).sum(1).mean()), at_most=1.2, unit="px")


@case(
    "calibration.rendered",
    "Boards rendered in fitted poses through the calibrated real camera, detected, against the corners observed",
    page="docs/guides/calibration.md",
)
def rendered_boards(*, frames: tuple[int, ...] = (0, 11, 14), spp: int = 128, renderings: int = 5) -> Iterator[Row]:
    """Compare with the lenses' whole aperture, whose blur the main lens's rim cuts, and with small ones.

    With 16 samples a pixel the rendering's own noise displaces the blurred corners of whole lenses by 0.4 px.
    """
    corners, _, found, _ = calibrated()
    for frame in frames:
        pose = int(np.flatnonzero(found.evaluation.frames == frame)[0])
        mine = corners.keep(corners["frame"] == frame)
        fit = found.evaluation.residuals[found.evaluation.pose == pose]
        # What is recorded about the board is enough.
        low = np.maximum(mine.pixel.min(0).astype(int) - 400, 0)
        high = np.minimum(mine.pixel.max(0).astype(int) + 400, found.camera.crop_size)
        start = np.array(found.camera.crop_offset) + low
        window = found.camera.replace(crop_offset=tuple(start.tolist()), crop_size=tuple((high - low).tolist()))
        place = {key: row for row, key in enumerate(zip(mine["k"], mine["l"], mine["cluster"], strict=True))}
        for fill in (1.0, 0.2):
            camera = window if fill == 1 else window.replace(mla_aperture="circle", mla_fill=fill)
            scene, given = board_scene(BOARD, found.evaluation.poses[pose], camera), camera_centres(camera, found.index)
            parts = [render_capture(scene, spp=spp, seed=seed).image for seed in range(renderings)]
            detected = detect_corners(np.mean(parts, axis=0), white_image(camera), given, BOARD, camera=camera)
            keys = list(zip(detected["k"], detected["l"], detected["cluster"], strict=True))
            rendered, real = np.array([(row, place[key]) for row, key in enumerate(keys) if key in place]).T
            apart = detected.pixel[rendered] + low - mine.pixel[real]
            error, fitted = (float(np.sqrt((each**2).sum(1).mean())) for each in (apart, fit[real]))
            what = f"frame {frame}, lenses filled to {fill:g}: {error:.4f} px over the fit's {fitted:.4f} px"
            yield figure(what, error / fitted, at_most=1.05)


def displaced_by_type(corners: Table, centres: Table, found: Calibration) -> Iterator[Row]:
    """Yield how far corners lie outwards of their prediction, by type of lens, over their distance from its centre.

    Then what errors would be with that displacement, which for each pose is taken from the others; and how far the
    micro-images' centres would lie outwards, were the types of lenses at heights that displace the corners so.
    """
    rows, _ = observations(corners, BOARD, found.index)
    lattice = found.camera.lattice
    geometry = {"pixel_size": found.camera.pixel_size, "row_ratio": lattice.row_ratio}
    residuals = -found.evaluation.residuals
    predicted = predict_centres(np.array(list(found.numbers.values())), rows.lens, **geometry)[0]
    arm = rows.pixel - residuals - predicted

    def types(unit: np.ndarray) -> np.ndarray:
        row = np.round(unit[:, 1])
        return np.asarray(lattice.lens_type(np.round(unit[:, 0] - lattice.unit_centre(0.0, row)[0]), row), dtype=int)

    kind, near = types(rows.lens), np.hypot(*residuals.T) < 3

    def outwards(chosen: np.ndarray) -> float:
        return float((residuals[chosen] * arm[chosen]).sum() / (arm[chosen] ** 2).sum())

    left, displaced = [], []
    for out in range(-1, rows.poses):
        others, rest = near & (rows.pose != out), residuals.copy()
        for number in range(lattice.lens_types):
            part = outwards(others & (kind == number))
            rest[kind == number] -= part * arm[kind == number]
            if out < 0:
                yield figure(f"lenses of type {number}: corners farther from the centre by", 100 * part, unit="%")
                displaced.append(part)
        chosen = (rows.pose == out) | (out < 0)
        left.append(float(np.sqrt((rest[chosen] ** 2).sum(1).mean())))
    yield figure("without that: RMS", left[0], unit="px")
    yield figure("without that: mean over poses", np.mean(left[1:]), unit="px")
    yield figure("with it: mean over poses", found.evaluation.pose_errors.mean(), unit="px")
    # A lens that is nearer to the main lens by h has its micro-image farther out by h / b.
    unit = found.index.unit(centres["k"], centres["l"])
    matrix = np.column_stack([np.ones(len(unit)), unit])
    fitted = matrix @ np.linalg.lstsq(matrix, centres.pixel)[0]
    place, edge = fitted - fitted.mean(0), math.hypot(*found.camera.crop_size) / 2
    for number, part in enumerate(displaced):
        mine = types(unit) == number
        scale = ((centres.pixel - fitted)[mine] * place[mine]).sum() / (place[mine] ** 2).sum()
        would = part * found.numbers["detector_distance"] / found.numbers["mla_distance"]
        yield figure(f"centres of type {number} at the detector's corners, outwards", edge * scale, unit="px")
        yield figure("... and at such heights", edge * would, unit="px")
    arms = np.hypot(*arm.T)
    for name, chosen in (("within 6 px", arms < 6), ("beyond 8 px", arms > 8)):
        for number in range(lattice.lens_types):
            part = outwards(chosen & near & (kind == number))
            yield figure(f"corners predicted {name} of the centre, type {number}: outwards", 100 * part, unit="%")
    yield figure("farthest observed from the centre", np.hypot(*(arm + residuals)[near].T).max(), unit="px")


def grid_errors(unit: np.ndarray, pixel: np.ndarray) -> tuple[float, float]:
    """RMS distance of centres from the affine grid that fits best, and from one whose pitch changes along a tilt."""
    matrix = np.column_stack([np.ones(len(unit)), unit])
    affine = matrix @ np.linalg.lstsq(matrix, pixel)[0]
    x, y = (affine - affine.mean(0)).T
    zero = np.zeros_like(matrix)
    along = np.concatenate([matrix, zero, np.stack([x * x, x * y], axis=-1)], axis=1)
    across = np.concatenate([zero, matrix, np.stack([x * y, y * y], axis=-1)], axis=1)
    both = np.concatenate([along, across])
    tilted = (both @ np.linalg.lstsq(both, pixel.T.ravel())[0]).reshape(2, -1).T
    rms = [float(np.sqrt(((pixel - fitted) ** 2).sum(1).mean())) for fitted in (affine, tilted)]
    return rms[0], rms[1]


@case(
    "calibration.white",
    "Centres, pitch and rotation found in white images with the noise of 2000 photons, drawn and captured",
    page="docs/guides/calibration.md",
    quick={"lattices": ("square",), "models": ()},
)
def white_images(
    *, lattices: tuple[str, ...] = ("square", "hexagonal"), models: tuple[str, ...] = ("ray", "wave")
) -> Iterator[Row]:
    """Compare with where centres are."""
    for lattice in lattices:
        pitch, turn, size = 16.37, 0.3, 1536
        row = pitch if lattice == "square" else pitch * math.sqrt(0.75)
        shifted = None if lattice == "square" else 0
        grid = LensGrid((pitch, row), (-20.3, -25.6), (130, 110), math.radians(turn), shifted)
        centres = grid.centres().reshape(-1, 2)
        image, window = np.zeros((size, size)), np.arange(-9, 10)
        for cx, cy in centres:
            x, y = int(cx) + window, int(cy) + window
            if min(x[0], y[0]) >= 0 and max(x[-1], y[-1]) < size:
                distance = np.hypot(x + 0.5 - cx, (y + 0.5 - cy)[:, None])
                image[np.ix_(y, x)] += np.clip(7.5 - distance, 0, 1)
        yield from white(f"drawn, {lattice}", 0.01 + 0.99 * image, centres, pitch, turn)
        camera = PlenopticCamera(
            resolution=(640, 480), detector_width=1.28, mla_lattice=lattice, mla_rotation=turn, aperture_radius=4.5
        )
        for model in models:
            wall = facing(camera.focus_distance, 40, **radiating())
            image = render_capture(scene_of(camera.to_sensor(), wall=wall), model=model, spp=64).image
            centres = camera_centres(camera).pixel + 0.5
            pitch = camera.micro_image_pitch / camera.pixel_size
            yield from white(f"{model} capture, {lattice}", image.clip(0), centres, pitch, turn)


def white(name: str, light: np.ndarray, centres: np.ndarray, pitch: float, turn: float) -> Iterator[Row]:
    """Add the noise of 2000 photons in a full pixel, find the centres, and compare them with where they are."""
    found = find_centres(np.random.default_rng(1).poisson(2000 * light) / 2000)
    nearest = np.array([np.hypot(*(centres - place - 0.5).T).argmin() for place in found.pixel])
    error = found.pixel + 0.5 - centres[nearest]
    yield figure(f"{name}: centres, RMS", np.sqrt((error**2).sum(1).mean()), at_most=0.05, unit="px")
    yield figure(f"{name}: pitch, relative", abs(found.grid.spacing[0] / pitch - 1), at_most=1e-5)
    turned = abs(math.degrees(found.grid.rotation) - turn)
    yield figure(f"{name}: rotation", turned, at_most=1e-3, unit="degrees")


ROUND_TRIP_BOARD = Board(8, 6, 2.5)

ROUND_TRIP_CAMERA = PlenopticCamera.preset("raytrix").replace(
    resolution=(1440, 1050),
    crop_size=(1400, 1050),
    crop_offset=(30, 0),
    detector_width=1440 * 0.0055,
    mla_pitch=(0.12744, 0.1275),
    mla_rotation=0.3,
    mla_offset=(0.02, -0.03),
    mla_tilt=(0.05, -0.04),
    distortion=(3e-4, -2e-6, 1e-8, -1e-4, 5e-5),
    # Small lenses, whose blur the main lens's rim does not cut.
    mla_aperture="circle",
    mla_fill=0.2,
)

ROUND_TRIP_POSES = np.array(
    [
        [0.10, 0.05, 3.10, 12, 8, 330],
        [0.45, -0.10, 3.15, 6, 3, 310],
        [-0.15, 0.50, 3.05, 12, 3, 295],
        [-0.40, -0.40, 3.20, 7, 8, 280],
        [0.05, -0.45, 3.12, 12, 7, 265],
        [0.30, 0.30, 3.00, 7, 4, 255],
        [0.40, 0.20, 3.20, 11, 4, 290],
        [-0.30, 0.35, 3.14, 8, 7, 245],
    ]
)

ROUND_TRIP_PHOTONS = 300

# Combinations of the 17 parameters that 8 poses determine well.
ROUND_TRIP_TOLD = 12

# By how much boards of one pose differ from seed to seed: radians, and mm, so that corners lie anywhere in a pixel.
ROUND_TRIP_MOVED = np.array([0.005, 0.005, 0.005, 0.5, 0.5, 1.0])


@case(
    "calibration.round-trip",
    "Boards rendered by a tilted camera that distorts, with photon noise, detected and calibrated: squared errors of "
    "combinations of parameters over their variances",
    page="docs/guides/calibration.md",
    quick={"seeds": 2, "spp": 16},
)
def round_trip(*, seeds: int = 40, spp: int = 128) -> Iterator[Row]:
    """Move the boards a little, render them, draw all photons, detect all corners and calibrate, for each seed.

    Pictures that seeds shared would err alike, which is no noise of a seed. The error of a combination of parameters is
    taken by what it changes of the corners' pixels: corners alone leave some combinations so open that the others are
    not linear in the parameters over them.
    """
    camera, board = ROUND_TRIP_CAMERA, ROUND_TRIP_BOARD
    size = camera.crop_size
    start = PlenopticCamera.preset("raytrix").replace(
        resolution=size, crop_size=size, crop_offset=(0, 0), detector_width=size[0] * camera.pixel_size
    )
    white, centres = white_image(camera), camera_centres(camera)
    errors: list[CombinedErrors] = []
    for seed in range(seeds):
        generator = np.random.default_rng(seed)
        poses = ROUND_TRIP_POSES + ROUND_TRIP_MOVED * generator.uniform(-1, 1, ROUND_TRIP_POSES.shape)
        tables = []
        for frame, pose in enumerate(poses):
            scene = board_scene(board, pose, camera)
            picture = render_capture(scene, spp=spp, seed=seed * len(poses) + frame).image
            noisy = generator.poisson(ROUND_TRIP_PHOTONS * picture.clip(0).astype(float)) / ROUND_TRIP_PHOTONS
            tables.append(detect_corners(noisy, white, centres, board, frame=frame))
        corners = concatenate(tables)
        found = calibrate(corners, board, start)
        rows, _ = observations(corners, board, LensIndex(0.5, 1, (0, 0)))
        errors.append(combined_errors(rows, found.evaluation.residuals, poses, errors[0] if errors else None))
        yield figure(f"seed {seed}, {len(rows)} corners: RMS", found.evaluation.error, unit="px")
    yield from combinations(np.array([error.values for error in errors]))


def combinations(errors: np.ndarray) -> Iterator[Row]:
    """Judge the squares of errors over their deviations, (seeds, combinations), by what the seeds can resolve.

    The mean of n squares of normal deviates times n has the chi-squared distribution of n degrees of freedom. A
    combination is beyond 1 +- 0.3 where its interval of 95 %, for all combinations at once, has nothing of that.
    """
    seeds, count = errors.shape
    ratios = (errors**2).mean(0)
    low, high = (seeds * ratios / chi2.ppf(q, seeds) for q in (1 - 0.025 / count, 0.025 / count))
    shared, variance = errors.mean(0), errors.var(0, ddof=1)
    for number, row in enumerate(zip(low, high, shared, variance, ratios, strict=True)):
        what = "combination {}, 95 % {:.2f} to {:.2f}, shared error {:+.2f}, variance {:.2f}".format(number, *row)
        yield figure(f"{what}: mean square", row[-1])
    # Of a few seeds nothing follows.
    enough = seeds >= 40
    mean, about = abs(float(ratios.mean()) - 1), abs(float(variance.mean()) - 1)
    yield figure("mean over combinations from 1", mean, at_most=0.3 if enough else None)
    yield figure("variance about the shared error, mean from 1", about, at_most=0.15 if enough else None)
    yield figure("combinations beyond 1 +- 0.3", ((low > 1.3) | (high < 0.7)).sum(), at_most=0)


@case(
    "calibration.waves",
    "Corners of a board in a wave capture, by the round trip's camera without tilt and distortion, against the model",
    page="docs/guides/calibration.md",
)
def board_by_waves(*, spp: int = 128) -> Iterator[Row]:
    """Render and detect."""
    board, pose = Board(4, 3, 3.0), np.array([0.45, -0.10, 3.15, 4, 3, 280])
    camera = ROUND_TRIP_CAMERA.replace(
        resolution=(1000, 760), crop_size=(960, 760), crop_offset=(20, 0), detector_width=5.5, mla_tilt=(0.0, 0.0),
        distortion=(0.0,) * 5,
    )  # fmt: skip
    waves = mi.load_dict({"type": "plenoptic_wave"})
    image = np.array(mi.render(board_scene(board, pose, camera), integrator=waves, spp=spp))[..., 0].clip(0)
    noisy = np.random.default_rng(0).poisson(ROUND_TRIP_PHOTONS * image) / ROUND_TRIP_PHOTONS
    found = detect_corners(noisy, white_image(camera), camera_centres(camera), board)
    rows, _ = observations(found, board, LensIndex(0.5, 1, (0, 0)))
    geometry = {"pixel_size": camera.pixel_size, "row_ratio": camera.lattice.row_ratio}
    error = rows.pixel - predict(numbers_of(camera), pose[None], rows, **geometry)[0]
    yield figure("corners not found", 12 - len(np.unique(found["cluster"])), at_most=0)
    yield figure("corners from the model, RMS", np.sqrt((error**2).sum(1).mean()), at_most=0.25, unit="px")
    yield figure("mean of that", np.hypot(*error.mean(0)), at_most=0.05, unit="px")


@dataclass(frozen=True)
class CombinedErrors:
    """Errors of combinations of parameters, over their deviations, and the combinations by what they change."""

    values: np.ndarray
    directions: np.ndarray


def combined_errors(
    seen: Observations, residuals: np.ndarray, poses: np.ndarray, like: CombinedErrors | None
) -> CombinedErrors:
    """Return errors of the combinations that a fit determines best, with the signs of those of `like`."""
    camera = ROUND_TRIP_CAMERA
    geometry = {"pixel_size": camera.pixel_size, "row_ratio": camera.lattice.row_ratio}
    true, by_numbers, by_pose = predict(numbers_of(camera), poses, seen, **geometry)
    for pose in range(seen.poses):
        # What a pose makes up for is no property of the camera.
        mine = seen.pose == pose
        own = np.linalg.qr(by_pose[mine].reshape(-1, 6))[0]
        rest = by_numbers[mine].reshape(len(own), -1)
        by_numbers[mine] = (rest - own @ (own.T @ rest)).reshape(by_numbers[mine].shape)
    columns = by_numbers.reshape(2 * len(seen), -1)
    patterns, _, directions = np.linalg.svd(columns / np.linalg.norm(columns, axis=0), full_matrices=False)
    patterns, directions = patterns[:, :ROUND_TRIP_TOLD], directions[:ROUND_TRIP_TOLD]
    variance = (residuals**2).sum() / (2 * len(seen) - columns.shape[1] - 6 * seen.poses)
    values = patterns.T @ (seen.pixel + residuals - true).ravel() / math.sqrt(variance)
    if like is not None:
        signs = np.sign((like.directions * directions).sum(1))
        values, directions = values * signs, directions * signs[:, None]
    return CombinedErrors(values, directions)
