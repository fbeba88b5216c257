"""Calibrations against a real camera, what COMPOTE found of it, and white images drawn from closed forms.

Every figure stands beside its limit; the exit status is 1 if one is beyond it. The data of the real camera (Raytrix
R12, Labussiere et al. 2020) are taken from the folder that MITSUBA_PLENOPTIC_DATA names, in ``raytrix_r12a``.

    MITSUBA_PLENOPTIC_DATA=data python tools/calibration_accuracy.py
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.calibration import (
    Board,
    Table,
    calibrate,
    find_centres,
    left_out_errors,
    read_camera,
    read_centres,
    read_corners,
)
from mitsuba_plenoptic.calibration.model import NAMES
from mitsuba_plenoptic.calibration.numbers import numbers_of
from mitsuba_plenoptic.lightfield import LensGrid

BOARD = Board(9, 5, 10.0)


class Verdict:
    """Prints figures beside their limits and remembers whether all were kept."""

    def __init__(self) -> None:
        self.kept = True

    def judge(self, what: str, figure: float, limit: float, unit: str = "") -> None:
        """Print a figure that must not be above its limit."""
        good = figure <= limit
        self.kept &= good
        print(f"{'kept  ' if good else 'BROKEN'} {what}: {figure:.5g} {unit}(limit {limit:.5g})", flush=True)


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


def real_camera(folder: Path, verdict: Verdict) -> None:
    """Calibrate the real camera and compare with COMPOTE."""
    values = json.loads((folder / "compote_intrinsics.json").read_text())
    start = PlenopticCamera.preset("raytrix")
    corners = read_corners(folder / "corners.csv", BOARD, start.crop_size)
    centres = read_centres(folder / "centres.csv")
    before = time.process_time()
    found = calibrate(corners, BOARD, start, centres)
    verdict.judge("R12-A, processor time of the calibration", time.process_time() - before, 20.0, "s ")
    seen = found.evaluation
    verdict.judge("R12-A, RMS over every row", seen.error, 0.965, "px ")
    verdict.judge("R12-A, centres of micro-images from the camera", found.centre_error or math.inf, 0.30, "px ")
    affine, tilted = grid_errors(found.index.unit(centres["k"], centres["l"]), centres.pixel)
    print(f"R12-A, centres from an affine grid: {affine:.5g} px")
    verdict.judge("R12-A, centres from a tilted grid", tilted, 0.26, "px ")
    left_out = left_out_errors(corners, BOARD, found, centres)
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
        image = np.random.default_rng(1).poisson(2000 * (0.01 + 0.99 * image)) / 2000
        found = find_centres(image)
        nearest = np.array([np.hypot(*(centres - place - 0.5).T).argmin() for place in found.pixel])
        error = found.pixel + 0.5 - centres[nearest]
        verdict.judge(f"white, {name}: centres, RMS", float(np.sqrt((error**2).sum(1).mean())), 0.05, "px ")
        verdict.judge(f"white, {name}: pitch, relative", abs(found.grid.spacing[0] / pitch - 1), 1e-5)
        verdict.judge(f"white, {name}: rotation", abs(math.degrees(found.grid.rotation) - turn), 1e-3, "degrees ")


def main() -> int:
    """Judge what can be judged here."""
    verdict = Verdict()
    white_images(verdict)
    folder = Path(os.environ.get("MITSUBA_PLENOPTIC_DATA", "")) / "raytrix_r12a"
    if (folder / "corners.csv").is_file():
        real_camera(folder, verdict)
    else:
        print(f"no data of a real camera in {folder}: set MITSUBA_PLENOPTIC_DATA")
    return 0 if verdict.kept else 1


if __name__ == "__main__":
    sys.exit(main())
