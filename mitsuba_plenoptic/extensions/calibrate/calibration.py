"""Calibration of a real camera: parameters from corners of a board, centres of micro-images from white images."""

from .blur import Blur
from .board_fit import calibrate, evaluate
from .boards import board_scene
from .calibrated_cameras import read_camera, write_calibration
from .calibration_result import Calibration, Evaluation
from .detect import detect_corners, write_corners
from .observations import Board, LensIndex, Table, concatenate, read_centres, read_corners
from .stop_fit import StopFit, fit_stop
from .view_corners import detect_view_corners
from .white_centres import Centres, find_centres, write_centres
from .white_fit import WhiteFit, fit_white

__all__ = [
    "Blur",
    "Board",
    "Calibration",
    "Centres",
    "Evaluation",
    "LensIndex",
    "StopFit",
    "Table",
    "WhiteFit",
    "board_scene",
    "calibrate",
    "concatenate",
    "detect_corners",
    "detect_view_corners",
    "evaluate",
    "find_centres",
    "fit_stop",
    "fit_white",
    "read_camera",
    "read_centres",
    "read_corners",
    "write_calibration",
    "write_centres",
    "write_corners",
]
