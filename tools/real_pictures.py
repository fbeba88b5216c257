"""Pictures of a real light-field microscope beside simulated ones; `make_pictures` draws them.

The pictures, from napari-LF (BSD 3-Clause), are taken from the folder that MITSUBA_PLENOPTIC_DATA names, in ``antleg``.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.calibration import fit_white
from mitsuba_plenoptic.extensions.calibrate.white_frames import sensor_pictures
from mitsuba_plenoptic.extensions.calibrate.white_page import white_figure
from mitsuba_plenoptic.extensions.prediction.real_page import pictures, planes_of
from mitsuba_plenoptic.extensions.prediction.study import LIGHTS, Pictures, Study
from mitsuba_plenoptic.io.cache import Cache
from mitsuba_plenoptic.report.plots import Plot, show

FOLDER = Path(os.environ.get("MITSUBA_PLENOPTIC_DATA", "")) / "antleg"
PART = 0.65, 0.6, 0.95, 0.87
"""Left, top, right and bottom of the part of the light field, over the picture's size."""

STORED = Path(__file__).resolve().parents[1] / "build" / "pictures" / "real"
PEER = STORED / "pyolaf.npz"
"""Volume by another program, with arrays depth_um and volume."""

DEPTHS = -0.036, -0.027, -0.012, 0.012, 0.027
"""Depths of slices in millimetres, positive away from the objective."""


def white() -> Plot:
    """Return the white picture beside that of the camera fitted to it."""
    light, dark = sensor_pictures(FOLDER / "radiometry_frame.png", dark=FOLDER / "dark_frame.tif")
    found = fit_white(light, mp.PlenopticCamera.preset("lfm_water"), dark=dark, wavelength=510.0)
    return white_figure(found)


@cache
def study() -> Study:
    """Return the study of the light field, whose runs are stored."""
    white, light_field, dark = (FOLDER / name for name in ("radiometry_frame.png", "light_field.png", "dark_frame.tif"))
    given = Pictures(*sensor_pictures(white, light_field=light_field, dark=dark))
    rows, columns = given.white.shape
    box = PART[0] * columns, PART[1] * rows, PART[2] * columns, PART[3] * rows
    return Study(given, mp.PlenopticCamera.preset("lfm_water"), 510.0, box, [], Cache(STORED))


def light_field() -> Plot:
    """Return the recorded light field beside those that scenes found by waves and by rays predict."""
    return pictures(study())


def volume() -> Plot:
    """Return slices of the volumes by waves and by rays, and, if it is stored, of pyolaf's from the same pixels."""
    volumes = {f"by {light}": planes_of(study(), light) for light in LIGHTS}
    if PEER.exists():
        with np.load(PEER) as peer:
            volumes["by pyolaf"] = dict(zip((peer["depth_um"] / 1000).tolist(), peer["volume"], strict=True))
    plot = Plot(len(DEPTHS) * 2.2 + 0.2)
    panels = plot.panels(len(volumes), len(DEPTHS), 1.6 / 2.1)
    for row, (name, planes) in zip(panels, volumes.items(), strict=True):
        for axes, wanted in zip(row, DEPTHS, strict=True):
            depth = min(planes, key=lambda depth, wanted=wanted: abs(depth - wanted))
            image = planes[depth]
            show(axes, image, f"{1000 * depth:+.0f} µm {name}", peak=float(np.quantile(image, 0.995)), size=8)
    return plot
