"""Focal lengths as functions of the wavelength, of thin lenses and of prescriptions, against closed forms."""

import math

import numpy as np
import pytest

from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.prescription import Glass, bundled_prescription, paraxial

CROWN = {"index": 1.5168, "abbe": 64.17}
LINE_D, LINE_F, LINE_C = 587.5618, 486.1327, 656.2725
"""Fraunhofer's lines of helium and hydrogen, in nanometres."""

LINES = (404.6561, LINE_F, LINE_D, 632.8, LINE_C, 706.5188)


@pytest.mark.parametrize("wavelength", LINES)
def test_a_singlet_by_the_lensmaker(wavelength):
    """The focal length of a thick singlet in closed form (Born and Wolf, section 4.4.3), to 1e-6 of it."""
    lens = bundled_prescription("singlet")
    first, second = lens.surfaces
    n = lens.indices(wavelength)[0]
    c1, c2, t = first.curvature, second.curvature, first.thickness
    power = (n - 1) * (c1 - c2 + (n - 1) * t * c1 * c2 / n)
    assert paraxial(lens, wavelength).focal_length == pytest.approx(1 / power, rel=1e-6)


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


def test_chromatic_shift():
    """Between the lines F and C the focal length changes by f / V, to 2 %: of a thin lens and of the singlet."""
    camera = PlenopticCamera(glass=CROWN)
    shift = camera.at_wavelength(LINE_C).focal_length - camera.at_wavelength(LINE_F).focal_length
    assert shift == pytest.approx(80 / 64.17, rel=0.02)
    lens = bundled_prescription("singlet")
    n = [lens.indices(line)[0] for line in (LINE_D, LINE_F, LINE_C)]
    shift = paraxial(lens, LINE_C).focal_length - paraxial(lens, LINE_F).focal_length
    assert shift == pytest.approx(paraxial(lens, LINE_D).focal_length * (n[1] - n[2]) / (n[0] - 1), rel=0.02)


def test_a_camera_keeps_its_glasses():
    camera = PlenopticCamera(glass=CROWN, mla_glass=1.5)
    assert PlenopticCamera.from_json(camera.to_json()) == camera
    assert camera.replace(aperture_radius=4).glass == camera.glass
    assert camera.is_dispersive and not PlenopticCamera(mla_glass=1.5).is_dispersive
    assert PlenopticCamera(main_lens="tessar").is_dispersive
    assert "glass" not in PlenopticCamera().to_dict()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"glass": 1.0}, "glass: glass index: its index is 1"),
        ({"glass": "window"}, "glass = 'window'"),
        ({"mla_glass": {"index": 1.5, "abbe": 0}}, "glass: abbe = 0"),
        ({"mla_glass": {"table": [[400, 1.5], [500, 1.4]]}}, "mla_glass: glass table: wavelength = 587.562 nm"),
        ({"glass": CROWN, "main_lens": "singlet"}, "glass = .*: a main_lens brings its own"),
    ],
)
def test_mistakes_with_glasses(given, message):
    with pytest.raises(InputError, match=message) as refused:
        PlenopticCamera(**given)
    assert "\n" not in str(refused.value)


def test_wavelengths_beyond_a_table():
    camera = PlenopticCamera(glass={"table": [[500, 1.53], [700, 1.51]], "name": "short"})
    with pytest.raises(InputError, match="glass short: wavelength = 450 nm: its table goes from 500 to 700 nm"):
        camera.at_wavelength(450)
    assert Glass.from_plain(1.5).reach == (0, np.inf)
