"""A capture of some pixels is the cut of the whole, for every kind of camera."""

import numpy as np
import pytest
from cameras import CAMERAS, WAVELENGTH, error, seen_by

from mitsuba_plenoptic import CaptureOperator

QUICK = ("turned", "unequal lenses", "coded", "ordinary", "microscope")


@pytest.mark.parametrize(
    ("name", "method"),
    [
        pytest.param(name, method, marks=[pytest.mark.slow] * (name not in QUICK or method != "patch"))
        for name in CAMERAS
        for method in ("patch", "full_field")
        if name != "cropped"
    ],
)
def test_points(name, method):
    camera = CAMERAS[name]
    (columns, rows), weights = camera.resolution, np.array([1.0, -2.0])
    left, top, width, height = columns // 4, rows // 5, columns // 2, rows // 3
    crop = camera.replace(crop_offset=(left, top), crop_size=(width, height))
    whole, part = (
        CaptureOperator(each, seen_by(name), wavelength=WAVELENGTH, method=method).forward(weights)
        for each in (camera, crop)
    )
    # Of light that is blurred, a crop lacks what comes from beyond it.
    limit = 5e-3 if name == "blurred" else 2e-3
    assert error(part, whole[top : top + height, left : left + width]) < limit
