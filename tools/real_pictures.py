"""Pictures of a real light-field microscope beside simulated ones; `make_pictures` draws them.

The pictures, from napari-LF (BSD 3-Clause), are taken from the folder that MITSUBA_PLENOPTIC_DATA names, in ``antleg``.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.calibration import fit_white
from mitsuba_plenoptic.extensions.calibrate.white_command import sensor_values
from mitsuba_plenoptic.extensions.calibrate.white_page import white_figure
from mitsuba_plenoptic.extensions.prediction.real_page import pictures, slices
from mitsuba_plenoptic.extensions.prediction.study import Pictures, Study
from mitsuba_plenoptic.report.framing import Canvas
from mitsuba_plenoptic.report.stage_store import Stages

FOLDER = Path(os.environ.get("MITSUBA_PLENOPTIC_DATA", "")) / "antleg"
PART = 0.65, 0.6, 0.95, 0.87
"""Left, top, right and bottom of the part of the light field, over the picture's size."""

STORED = Path(__file__).resolve().parents[1] / "build" / "pictures" / "real"


def white() -> Canvas:
    """Return the white picture beside that of the camera fitted to it."""
    light, dark = (sensor_values(FOLDER / name) for name in ("radiometry_frame.png", "dark_frame.tif"))
    found = fit_white(light, mp.PlenopticCamera.preset("lfm_water"), dark=dark, wavelength=510.0)
    return white_figure(found)


@cache
def study() -> Study:
    """Return the study of the light field, whose runs are stored."""
    names = ("light_field.png", "radiometry_frame.png", "dark_frame.tif")
    given = Pictures(*(sensor_values(FOLDER / name) for name in names))
    rows, columns = given.white.shape
    box = PART[0] * columns, PART[1] * rows, PART[2] * columns, PART[3] * rows
    return Study(given, mp.PlenopticCamera.preset("lfm_water"), 510.0, box, Stages(STORED))


def light_field() -> Canvas:
    """Return the recorded light field beside those that volumes found by waves and by rays predict."""
    return pictures(study())


def volume() -> Canvas:
    """Return slices of the volumes."""
    return slices(study())
