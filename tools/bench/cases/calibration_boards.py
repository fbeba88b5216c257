"""Boards that are rendered and detected, and the cameras calibrated by them against those that rendered them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from scipy.stats import chi2

from mitsuba_plenoptic import PlenopticCamera, calibrate, render_capture
from mitsuba_plenoptic.calibration import Board, LensIndex, board_scene, camera_centres, concatenate, detect_corners
from mitsuba_plenoptic.extensions.calibrate.board_model import Observations, numbers_of, predict
from mitsuba_plenoptic.extensions.calibrate.observations import observations
from mitsuba_plenoptic.views import white_image

from .. import Row, case, figure

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
    page="docs/calibration.md",
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
    page="docs/calibration.md",
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
