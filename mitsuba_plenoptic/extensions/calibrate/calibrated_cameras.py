"""Calibrated cameras as JSON files, and configurations of libpleno and COMPOTE.

A calibrated camera is a file of `PlenopticCamera.to_json` with an additional object ``calibration``: how the data count
lenses and pixels, the fitted numbers with their deviations, the poses, and the residuals. Every command that takes a
camera accepts such a file.
"""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ...camera import PlenopticCamera, camera_and_record
from ...errors import NO_RECORD, naming, refuse_if, refusing, require_count, require_number, short_repr
from ...lenses import undistort
from ...runtime import Array, Named, write_text
from .board_model import camera_of
from .calibration_result import Calibration
from .observations import Board, LensIndex


def write_calibration(path: str | Path, calibration: Calibration, board: Board) -> None:
    """Write a calibrated camera as a JSON file, completely or not at all.

    Parameters
    ----------
    calibration : Calibration
        The calibration to write.
    board : Board
        The board that was seen.
    """
    evaluation = calibration.evaluation
    record = {
        "lens_index": asdict(calibration.index),
        "pixel": {
            "size_mm": calibration.camera.pixel_size,
            "convention": "u is the column and v the row in the recorded picture; "
            "(0, 0) is the centre of its first pixel",
        },
        "board": {"columns": board.columns, "rows": board.rows, "square_mm": board.square},
        "board_heights_mm": calibration.board_heights.tolist(),
        "reprojection_error_px": evaluation.error,
        "reprojection_error_without_outliers_px": evaluation.error_without_outliers,
        "centre_error_px": calibration.centre_error,
        "observations": len(evaluation.residuals),
        "numbers": {
            name: {"value": value, "deviation": calibration.deviations[name]}
            for name, value in calibration.numbers.items()
        },
        "frames_disagree": calibration.disagreement,
        "deviations_by_frames": calibration.by_frames,
        "blur": None if calibration.blur is None else asdict(calibration.blur),
        "weak_directions": [
            {"weakness": weakness, "numbers": parts} for weakness, parts in calibration.weak_directions()
        ],
        "open_direction": calibration.open_direction,
        "prediction_deviation_px": calibration.prediction_deviation,
        "pose_convention": "by frame: rotation vector in radians and place in mm of the first corner seen, "
        "from the board's to the camera frame",
        "poses": {str(frame): pose.tolist() for frame, pose in zip(evaluation.frames, evaluation.poses, strict=True)},
        "outlier_rows": (evaluation.outliers + 2).tolist(),
        "outlier_centre_rows": (calibration.centre_outliers + 2).tolist(),
    }
    text = json.dumps({**calibration.camera.to_dict(), "calibration": record}, indent=1) + "\n"
    write_text(path, text, ".json")


def read_camera(source: str | Path) -> tuple[PlenopticCamera, LensIndex | None]:
    """Return a camera as every command reads it, and the indexing of lenses in the data of its calibration.

    Parameters
    ----------
    source : str or path
        A preset, a JSON or YAML file of parameters or of arguments of `PlenopticCamera.matched`, these as text,
        ``NAME=VALUE,NAME=VALUE``, or a configuration of libpleno and COMPOTE.

    Returns
    -------
    camera : PlenopticCamera
    index : LensIndex or None
        Indexing of lenses in the data of the calibration; None if the file does not state it.
    """
    camera, record = camera_and_record(source)
    with naming(source):
        return camera, lens_index(record)


def lens_index(record: Any) -> LensIndex | None:
    """Return the indexing of lenses that the object ``calibration`` of a camera's file states, or None."""
    if record is None:
        return None
    with refusing(
        f"calibration = {short_repr(record)}: it has no lens_index of odd_rows, row_sign and first", *NO_RECORD
    ):
        index = record["lens_index"]
        odd_rows, row_sign, (k, l) = index["odd_rows"], index["row_sign"], index["first"]  # noqa: E741
    refuse_if(
        odd_rows not in (-0.5, 0, 0.5) or row_sign not in (-1, 1),
        f"lens_index = {short_repr(index)}: odd_rows is -0.5, 0 or 0.5 and row_sign is -1 or 1",
    )
    first = require_count("first", k, minimum=-(2**20)), require_count("first", l, minimum=-(2**20))
    return LensIndex(float(odd_rows), int(row_sign), first)


def libpleno_camera(values: Named) -> PlenopticCamera:
    """Return the camera of a configuration that libpleno and COMPOTE write (``intrinsics.js``).

    COMPOTE distorts the image point of a board's corner; a ray is distorted here in the plane of the microlens array.
    The two differ unless the image lies in the array's plane, for which the coefficients agree. The array's rotation,
    some 1e-4 rad in a real camera, becomes tilt and rotation to first order.
    """
    with refusing("it is no configuration of libpleno:", IndexError, OverflowError, *NO_RECORD):
        sensor = values["sensor"]
        mla = values["mla"]
        lens = values["main_lens"]
        size = require_number("scale", float(sensor["scale"]), positive=True)
        columns = int(sensor["width"])
        rows = int(sensor["height"])
        x0, y0, detector = _numbers(sensor["pose"]["translation"][0])
        x1, y1, height = _numbers(mla["mesh"]["pose"]["translation"][0])
        rotation = np.array([_numbers(row) for row in mla["mesh"]["pose"]["rotation"]])
        pitches = _numbers(mla["mesh"]["pitch"][0])
        count = int(mla["mesh"]["width"]), int(mla["mesh"]["height"])
        f = float(lens["f"])
        stop = float(lens["aperture"])
        distances = {"f": f, "aperture": stop, "mla": -height, "sensor": height - detector}
        for name, value in distances.items():
            require_number(name, value, positive=True)
        distortion = np.array(_numbers(values["distortions"]["radial"][0] + values["distortions"]["tangential"][0]))
        lengths = _numbers(mla["focal_lengths"])
    # Their x and y are ours reversed. A lens near the axis is our lens (0, 0).
    step = rotation @ np.diag([pitches[0], pitches[1] * math.sqrt(0.75), 0.0])
    j = 2 * round(count[1] / 4)
    centre = -(step @ [round(count[0] / 2) + 0.5, j, 0] + [x1, y1, 0])[:2]
    tilt = np.rad2deg(np.arctan([-rotation[2, 0], -rotation[2, 1]]))
    numbers = [
        f,
        -height,
        height - detector,
        *pitches,
        float(np.rad2deg(np.arctan2(rotation[1, 0], rotation[0, 0]))),
        *centre,
        *tilt,
        columns - 1 + x0 / size,
        rows - 1 + y0 / size,
        *_inverse_distortion(distortion, size * math.hypot(columns, rows) / 2),
    ]
    like = PlenopticCamera(
        focal_length=f,
        aperture_radius=f / (2 * stop),
        mla_focal_length=lengths if len(lengths) in (1, 3) else lengths[0],
        mla_lattice="hexagonal",
        detector_width=size * columns,
        resolution=(columns, rows),
    )
    return camera_of(np.array(numbers), like)


def _numbers(values: Any) -> list[float]:
    return [require_number("number", float(value)) for value in values]


def _inverse_distortion(distortion: Array, reach: float) -> Array:
    """Return the coefficients that best undo a distortion over a disc; distortions have opposite signs in x and y."""
    radius, angle = np.meshgrid(np.linspace(0.02, 1, 40) * reach, np.linspace(0, 2 * np.pi, 24, endpoint=False))
    x = (radius * np.cos(angle)).ravel()
    y = (radius * np.sin(angle)).ravel()
    k1, k2, k3, p1, p2 = distortion * [1, 1, 1, -1, -1]
    u, v = undistort(x, y, (k1, k2, k3, p1, p2))
    matrix = np.stack([np.ravel(undistort(u, v, e)) - np.ravel([u, v]) for e in np.eye(5)], axis=-1)
    scale = np.abs(matrix).max(0)
    return np.linalg.lstsq(matrix / scale, np.ravel([x - u, y - v]))[0] / scale
