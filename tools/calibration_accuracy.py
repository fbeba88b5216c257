"""Calibrations against a real camera, what COMPOTE found of it, simulated boards and white images.

Every figure stands beside its limit; the exit status is 1 if one is beyond it. The data of the real camera (Raytrix
R12, Labussiere et al. 2020) are taken from the folder that MITSUBA_PLENOPTIC_DATA names, in ``raytrix_r12a``.

    MITSUBA_PLENOPTIC_DATA=data python tools/calibration_accuracy.py

Boards and white images are rendered and detected, which takes about an hour; ``--only real`` and others judge a part.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Collection
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from simulated_boards import board_by_waves, round_trip
from verdict import Verdict

from mitsuba_plenoptic import PlenopticCamera, render_capture
from mitsuba_plenoptic.calibration import (
    Board,
    Calibration,
    Table,
    calibrate,
    camera_centres,
    cross_validate,
    detect_corners,
    find_centres,
    read_camera,
    read_centres,
    read_corners,
)
from mitsuba_plenoptic.calibration import boards as board_scene
from mitsuba_plenoptic.calibration.model import NAMES, predict_centres
from mitsuba_plenoptic.calibration.numbers import numbers_of
from mitsuba_plenoptic.calibration.observations import observations
from mitsuba_plenoptic.lightfield import LensGrid, white_image
from mitsuba_plenoptic.runtime.variant import set_variant

BOARD = Board(9, 5, 10.0)


class Compote:
    """COMPOTE's own model with the numbers that it found: points are distorted, not rays; written from its paper."""

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


def real_camera(folder: Path, verdict: Verdict, parts: Collection[str]) -> None:
    """Calibrate the real camera and compare with COMPOTE."""
    values = json.loads((folder / "compote_intrinsics.json").read_text())
    start = PlenopticCamera.preset("raytrix")
    corners = read_corners(folder / "corners.csv", BOARD, start.crop_size)
    centres = read_centres(folder / "centres.csv")
    before = time.process_time()
    found = calibrate(corners, BOARD, start, centres)
    if "rendered" in parts:
        for frame in RENDERED_FRAMES:
            rendered_board(verdict, corners, found, frame)
    if "real" not in parts:
        return
    verdict.judge("R12-A, processor time of the calibration", time.process_time() - before, 20.0, "s ")
    seen = found.evaluation
    verdict.judge("R12-A, RMS over every row", seen.error, 0.965, "px ")
    verdict.judge("R12-A, centres of micro-images from the camera", found.centre_error or math.inf, 0.30, "px ")
    affine, tilted = grid_errors(found.index.unit(centres["k"], centres["l"]), centres.pixel)
    print(f"R12-A, centres from an affine grid: {affine:.5g} px")
    verdict.judge("R12-A, centres from a tilted grid", tilted, 0.26, "px ")
    assert found.blur is not None
    theirs_f = sorted(float(values["d"]) / float(f) for f in values["mla"]["focal_lengths"])
    ours_f = sorted(found.numbers["detector_distance"] / f for f in found.blur.focal_lengths)
    apart = max(abs(ours / other - 1) for ours, other in zip(ours_f, theirs_f, strict=True))
    verdict.judge("R12-A, z over focal lengths of microlenses from COMPOTE's, relative", apart, 0.02)
    displaced_by_type(corners, centres, found)
    left_out = cross_validate(corners, BOARD, found, centres)
    compote, theirs, depths = Compote(values), [], []
    print(f"{'frame':>6} {'rows':>6} {'ours':>8} {'left out':>9} {'COMPOTE':>8}   px")
    for place, frame in enumerate(seen.frames):
        mine = corners.keep(corners["frame"] == frame)
        # Their x and y are ours reversed.
        pose = seen.poses[place]
        flip = Rotation.from_rotvec([0, 0, np.pi])
        first = np.concatenate([(flip * Rotation.from_rotvec(pose[:3])).as_rotvec(), pose[3:] * [-1, -1, 1]])
        error, refitted = compote.refit(mine, first)
        theirs.append((error, len(mine["k"])))
        all_corners = np.concatenate([BOARD.places(np.arange(45)), np.zeros((45, 1))], axis=1)
        depths.append([(Rotation.from_rotvec(p[:3]).apply(all_corners) + p[3:])[:, 2] for p in (pose, refitted)])
        print(f"{frame:6d} {theirs[-1][1]:6d} {seen.pose_errors[place]:8.4f} {left_out[int(frame)]:9.4f} {error:8.4f}")
    errors, rows = np.array(theirs).T
    print(f"COMPOTE over every row: {math.sqrt((errors**2 * rows).sum() / rows.sum()):.4f} px (1.0858 is known)")
    verdict.judge("R12-A, mean of left-out poses", float(np.mean(list(left_out.values()))), errors.mean(), "px ")
    difference = np.array([ours - compotes for ours, compotes in depths])
    print(
        f"depth of the board's corners beside COMPOTE's: {difference.mean():+.2f} mm, of which the camera's origin; "
        f"{(difference - difference.mean()).std():.3f} mm RMS about that"
    )
    known = numbers_of(read_camera(folder / "compote_intrinsics.json")[0])
    print(f"{'number':>18} {'ours':>13} {'deviation':>10} {'COMPOTE':>13}  deviations apart")
    for name, other in zip(NAMES, known, strict=True):
        if name.startswith("offset"):
            continue  # of another lens
        value, deviation = found.numbers[name], found.deviations[name]
        apart = (value - other) / deviation
        print(f"{name:>18} {value:13.6g} {deviation:10.2g} {other:13.6g} {apart:8.1f} {'*' if abs(apart) > 3 else ''}")


RENDERED_FRAMES = (0, 11, 14)
# With 16 samples a pixel the rendering's own noise displaces the blurred corners of whole lenses by 0.4 px.
SAMPLES, RENDERINGS = 128, 5


def rendered_board(verdict: Verdict, corners: Table, found: Calibration, frame: int) -> None:
    """Render the board in a fitted pose through the calibrated camera, detect it, and compare with what was observed.

    With the lenses' whole aperture, whose blur the main lens's rim cuts, and with small ones.
    """
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
        parts = [render_capture(scene, spp=SAMPLES, seed=seed).image for seed in range(RENDERINGS)]
        seen = detect_corners(np.mean(parts, axis=0), white_image(camera), given, BOARD, camera=camera)
        keys = list(zip(seen["k"], seen["l"], seen["cluster"], strict=True))
        both = [(row, place[key]) for row, key in enumerate(keys) if key in place]
        rendered, real = np.array(both).T
        apart = seen.pixel[rendered] + low - mine.pixel[real]
        error, fitted = (float(np.sqrt((each**2).sum(1).mean())) for each in (apart, fit[real]))
        name = f"R12-A, frame {frame} rendered, lenses filled to {fill:g}"
        print(f"{name}: {error:.4f} px from {len(both)} real corners, the fit {fitted:.4f} px")
        verdict.judge(f"{name}: over the fit's error", error / fitted, 1.05)


def displaced_by_type(corners: Table, centres: Table, found: Calibration) -> None:
    """Print how far corners lie outwards of where they are predicted, by type of lens, over their distance from it.

    What errors would be with that displacement, which for each pose is taken from the others; and how far the
    micro-images' centres would lie outwards, were the types of lenses at heights that displace the corners so.
    """
    seen, _ = observations(corners, BOARD, found.index)
    lattice = found.camera.lattice
    numbers = np.array(list(found.numbers.values()))
    geometry = {"pixel_size": found.camera.pixel_size, "row_ratio": lattice.row_ratio}
    residuals = -found.evaluation.residuals
    arm = seen.pixel - residuals - predict_centres(numbers, seen.lens, **geometry)[0]
    row = np.round(seen.lens[:, 1])
    column, _ = lattice.unit_centre(0.0, row)
    kind = types = np.asarray(lattice.lens_type(np.round(seen.lens[:, 0] - column), row), dtype=int)
    near = np.hypot(*residuals.T) < 3
    left, displaced = [], []
    for out in range(-1, seen.poses):
        others, rest = near & (seen.pose != out), residuals.copy()
        for number in range(lattice.lens_types):
            mine = others & (kind == number)
            outwards = (residuals[mine] * arm[mine]).sum() / (arm[mine] ** 2).sum()
            rest[kind == number] -= outwards * arm[kind == number]
            if out < 0:
                print(f"R12-A, lenses of type {number}: corners {outwards:+.2%} farther from the micro-image's centre")
                displaced.append(outwards)
        chosen = (seen.pose == out) | (out < 0)
        left.append(float(np.sqrt((rest[chosen] ** 2).sum(1).mean())))
    errors = found.evaluation.pose_errors
    print(f"R12-A without that: {left[0]:.4f} px RMS; by poses {np.mean(left[1:]):.4f} px, {errors.mean():.4f} with it")
    # A lens that is nearer to the main lens by h has its micro-image farther out by h / b.
    unit = found.index.unit(centres["k"], centres["l"])
    row = np.round(unit[:, 1])
    kind = np.asarray(lattice.lens_type(np.round(unit[:, 0] - lattice.unit_centre(0.0, row)[0]), row), dtype=int)
    matrix = np.column_stack([np.ones(len(unit)), unit])
    fitted = matrix @ np.linalg.lstsq(matrix, centres.pixel)[0]
    place = fitted - fitted.mean(0)
    edge = math.hypot(*found.camera.crop_size) / 2
    for number, outwards in enumerate(displaced):
        mine = kind == number
        scale = ((centres.pixel - fitted)[mine] * place[mine]).sum() / (place[mine] ** 2).sum()
        would = outwards * found.numbers["detector_distance"] / found.numbers["mla_distance"]
        print(
            f"R12-A, centres of type {number} at the corners of the detector: {edge * scale:+.3f} px outwards, "
            f"at such heights {edge * would:+.3f} px"
        )
    arms = np.hypot(*arm.T)
    for name, chosen in (("within 6 px", arms < 6), ("beyond 8 px", arms > 8)):
        by = [
            (residuals[each] * arm[each]).sum() / (arm[each] ** 2).sum()
            for each in (chosen & near & (types == number) for number in range(lattice.lens_types))
        ]
        print(f"R12-A, corners predicted {name} of their centre: " + ", ".join(f"{value:+.1%}" for value in by))
    print(f"R12-A, observed at most {np.hypot(*(arm + residuals)[near].T).max():.2f} px from their centre")


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


def white_images(verdict: Verdict) -> None:
    """Find the centres in drawn white images with photon noise."""
    for name, shifted in (("square", None), ("hexagonal", 0)):
        pitch, turn, shape = 16.37, 0.3, (1536, 1536)
        row = pitch if shifted is None else pitch * math.sqrt(0.75)
        grid = LensGrid((pitch, row), (-20.3, -25.6), (130, 110), math.radians(turn), shifted)
        centres = grid.centres().reshape(-1, 2)
        image = np.zeros(shape)
        window = np.arange(-9, 10)
        for cx, cy in centres:
            x, y = int(cx) + window, int(cy) + window
            if min(x[0], y[0]) < 0 or max(x[-1], y[-1]) >= shape[0]:
                continue
            distance = np.hypot(x + 0.5 - cx, (y + 0.5 - cy)[:, None])
            image[np.ix_(y, x)] += np.clip(7.5 - distance, 0, 1)
        judge_white(verdict, f"drawn, {name}", 0.01 + 0.99 * image, centres, pitch, turn)
    for lattice in ("square", "hexagonal"):
        camera = PlenopticCamera(
            resolution=(640, 480), detector_width=1.28, mla_lattice=lattice, mla_rotation=0.3, aperture_radius=4.5
        )
        pitch = camera.micro_image_pitch / camera.pixel_size
        for model in ("ray", "wave"):
            image = render_capture(white_wall(camera), model=model, spp=64).image
            centres = camera_centres(camera).pixel + 0.5
            judge_white(verdict, f"by {model}s, {lattice}", image.clip(0), centres, pitch, 0.3)


def white_wall(camera: PlenopticCamera) -> Any:
    """Return a scene of a wall that shines evenly, in focus."""
    set_variant(None)
    to_world = mi.ScalarTransform4f().translate([0, 0, camera.focus_distance]).rotate([0, 1, 0], 180).scale(40)
    wall = {
        "type": "rectangle",
        "to_world": to_world,
        "emitter": {"type": "area", "radiance": 1.0},
        "bsdf": {"type": "diffuse", "reflectance": 0.0},
    }
    return mi.load_dict({"type": "scene", "wall": wall, "integrator": {"type": "path"}, "camera": camera.to_sensor()})


def judge_white(verdict: Verdict, name: str, light: np.ndarray, centres: np.ndarray, pitch: float, turn: float) -> None:
    """Add the noise of 2000 photons in a full pixel, find the centres, and compare them with where they are."""
    found = find_centres(np.random.default_rng(1).poisson(2000 * light) / 2000)
    nearest = np.array([np.hypot(*(centres - place - 0.5).T).argmin() for place in found.pixel])
    error = found.pixel + 0.5 - centres[nearest]
    verdict.judge(f"white {name}: centres, RMS", float(np.sqrt((error**2).sum(1).mean())), 0.05, "px ")
    verdict.judge(f"white {name}: pitch, relative", abs(found.grid.spacing[0] / pitch - 1), 1e-5)
    verdict.judge(f"white {name}: rotation", abs(math.degrees(found.grid.rotation) - turn), 1e-3, "degrees ")


PARTS = ("white", "round-trip", "waves", "real", "rendered")


def main() -> int:
    """Judge what can be judged here."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", choices=PARTS, nargs="+", default=PARTS, help="what to judge (default: all)")
    parser.add_argument("--seeds", type=int, default=40, help="pictures of the round trip (default: %(default)s)")
    given = parser.parse_args()
    verdict = Verdict()
    if "white" in given.only:
        white_images(verdict)
    if "round-trip" in given.only:
        round_trip(verdict, given.seeds)
    if "waves" in given.only:
        board_by_waves(verdict)
    if {"real", "rendered"} & set(given.only):
        folder = Path(os.environ.get("MITSUBA_PLENOPTIC_DATA", "")) / "raytrix_r12a"
        if (folder / "corners.csv").is_file():
            real_camera(folder, verdict, given.only)
        else:
            print(f"no data of a real camera in {folder}: set MITSUBA_PLENOPTIC_DATA")
    return 0 if verdict.kept else 1


if __name__ == "__main__":
    sys.exit(main())
