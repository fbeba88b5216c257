"""Focal lengths as functions of the wavelength, of thin lenses and of prescriptions, against closed forms."""

import math

import numpy as np
import pytest

from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.prescription import Glass

CROWN = {"index": 1.5168, "abbe": 64.17}
LINE_D, LINE_F, LINE_C = 587.5618, 486.1327, 656.2725
"""Fraunhofer's lines of helium and hydrogen, in nanometres."""

LINES = (404.6561, LINE_D, 706.5188)


@pytest.mark.parametrize("wavelength", LINES)
def test_thin_lenses_of_glass(wavelength):
    """Focal lengths go with 1 / (n - 1), n by Cauchy's formula through the two numbers of the glass, to 1e-6."""
    camera = PlenopticCamera(glass=CROWN, mla_glass={"sellmeier": SILICA, "name": "silica"})
    there = camera.at_wavelength(wavelength)
    B = (1.5168 - 1) / 64.17 / (LINE_F**-2 - LINE_C**-2)
    n = 1.5168 + B * (wavelength**-2 - LINE_D**-2)
    assert there.focal_length == pytest.approx(80 * 0.5168 / (n - 1), rel=1e-6)
    silica = [1 + sum(b * v / (v - c) for b, c in zip(SILICA[:3], SILICA[3:], strict=True))
              for v in ((line * 1e-3) ** 2 for line in (LINE_D, wavelength))]  # fmt: skip
    ratio = (math.sqrt(silica[0]) - 1) / (math.sqrt(silica[1]) - 1)
    assert there.mla_focal_length == pytest.approx(0.512 * ratio, rel=1e-6)
    assert (there.mla_distance, there.detector_distance) == (camera.mla_distance, camera.detector_distance)
    assert there.glass is None and there.mla_glass is None and there.at_wavelength(400) is there


SILICA = (0.6961663, 0.4079426, 0.8974794, 0.0684043**2, 0.1162414**2, 9.896161**2)
"""Fused silica (Malitson 1965)."""


def test_wavelengths_beyond_a_table():
    camera = PlenopticCamera(glass={"table": [[500, 1.53], [700, 1.51]], "name": "short"})
    with pytest.raises(InputError, match="glass short: wavelength = 450 nm"):
        camera.at_wavelength(450)
    assert Glass.from_plain(1.5).reach == (0, np.inf)
