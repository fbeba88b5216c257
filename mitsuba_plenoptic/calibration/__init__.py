"""Calibration of a real camera: its numbers from corners of a board, its micro-images' centres from white images."""

from .files import read_camera, write_calibration
from .fit import Calibration, Evaluation, calibrate, evaluate, left_out_errors
from .observations import Board, LensIndex, Table, read_centres, read_corners
from .white import Centres, find_centres, write_centres

__all__ = [
    "Board",
    "Calibration",
    "Centres",
    "Evaluation",
    "LensIndex",
    "Table",
    "calibrate",
    "evaluate",
    "find_centres",
    "left_out_errors",
    "read_camera",
    "read_centres",
    "read_corners",
    "write_calibration",
    "write_centres",
]
