"""Point spreads by patches are those of full fields, for every kind of camera."""

import numpy as np
import pytest
from cameras import CAMERAS, WAVELENGTH, error, seen_by

from mitsuba_plenoptic import CaptureOperator

QUICK = ("sphere", "vignetted", "coded", "microscope")
LIMITS = {"warped": 0.015, "unequal lenses": 0.015}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in QUICK)) for n in CAMERAS])
def test_patches_are_full_fields(name):
    weights = np.array([1.0, 2.0])
    patch, full = (
        CaptureOperator(CAMERAS[name], seen_by(name), wavelength=WAVELENGTH, accuracy=accuracy, method=method).forward(
            weights
        )
        for method, accuracy in (("patch", 0), ("full_field", None))
    )
    assert patch.shape == full.shape == CAMERAS[name].shape
    assert patch.dtype == np.float32 and patch.min() >= 0
    assert error(patch, full) < LIMITS.get(name, 0.005)
