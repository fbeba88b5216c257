"""Prescriptions: paraxial numbers against closed forms and Optiland's, glasses, files, and what is refused."""

import json
import math
import warnings

import pytest
import yaml

from mitsuba_plenoptic import InputError, PlenopticCamera, read_prescription
from mitsuba_plenoptic.prescription import Glass
from mitsuba_plenoptic.prescription.surfaces import BUNDLED, bundled_prescription

BK7 = {"name": "N-BK7", "sellmeier": [1.03961212, 0.231792344, 1.01046945, 0.00600069867, 0.0200179144, 103.560653]}


def singlet(glass=1.5, radii=(50.0, -70.0), thickness=4.0, **changes):
    first = {"radius": radii[0], "thickness": thickness, "glass": glass, "semi_aperture": 10, "stop": True}
    return {"surfaces": [first | changes, {"radius": radii[1], "semi_aperture": 10}]}


@pytest.mark.parametrize("glass, index", [
    (BK7, 1.5168000),
    ({"schott": [2.592001, -0.01540969, 0.0102268, 0.001581559, -0.0001877149, 1.012515e-05]}, 1.6204089),
    ({"index": 1.5168, "abbe": 64.17}, 1.5168),
    ({"table": [[400, 1.5308], [500, 1.5214], [587.5618, 1.5168], [700, 1.5131]]}, 1.5168),
    (1.5168, 1.5168),
])  # fmt: skip
def test_glasses_have_their_catalogues_indices(glass, index):
    assert Glass.from_plain(glass).at(587.5618) == pytest.approx(index, abs=1e-7)
    assert Glass.from_plain(Glass.from_plain(glass).to_plain()) == Glass.from_plain(glass)


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_lenses_tell_their_source_and_survive_files(name, tmp_path):
    lens = bundled_prescription(name)
    assert lens.source and lens.name
    (tmp_path / "lens.yaml").write_text(yaml.safe_dump(lens.to_plain()))
    assert read_prescription(tmp_path / "lens.yaml") == lens
    assert read_prescription(json.dumps(lens.to_plain())) == lens


def test_a_camera_holds_its_lens_in_full():
    camera = PlenopticCamera(main_lens="double_gauss.yaml", focal_length=80, aperture_radius=5)
    assert PlenopticCamera.from_json(camera.to_json()) == camera
    assert camera.replace(focus_distance=300.0).main_lens == camera.main_lens
    own = PlenopticCamera(main_lens="double_gauss", focus_distance=1000)
    assert own.focal_length == pytest.approx(100.00375, rel=1e-7)
    assert own.f_number == pytest.approx(3, rel=1e-3)


def test_surfaces_end_where_they_cross():
    """Two spheres of radii 50 and -70, their vertices 1.4 apart, meet in the plane of both of their circles."""
    with pytest.warns(UserWarning) as caught:
        camera = PlenopticCamera(main_lens=singlet(thickness=1.4))
    (warning,) = caught
    assert "main_lens: surfaces 1 and 2 cross 9.008 mm" in str(warning.message)
    apart = 50 + 70 - 1.4
    from_first = (apart**2 + 50**2 - 70**2) / (2 * apart)
    crossing = math.sqrt(50**2 - from_first**2)
    assert [surface.semi_aperture for surface in camera.main_lens.surfaces] == pytest.approx([crossing] * 2, rel=1e-9)
    # What is listed beyond the crossing of one surface alone does not matter, and a clipped lens stays as it is.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert camera.replace(focus_distance=300.0).main_lens == camera.main_lens
        small = singlet(thickness=1.4)
        small["surfaces"][1]["semi_aperture"] = 9
        assert PlenopticCamera(main_lens=small).main_lens.surfaces[0].semi_aperture == 10


def test_blur_and_micro_images_follow_the_exit_pupil():
    """By similar triangles of the cone from the exit pupil, whose place and size Optiland tells."""
    camera = PlenopticCamera(main_lens="double_gauss", focal_length=80, aperture_radius=5)
    assert camera.pupil_distance == pytest.approx(120 + 80 / 100.00375 * (-38.516202 + 53.156881), abs=1e-4)
    assert camera.pupil_radius == pytest.approx(5 * 1.1464013, rel=1e-6)
    image = 1 / (1 / 80 - 1 / 210)
    gap = abs(120 - image) / (camera.pupil_distance + image - 120)
    assert camera.blur_diameter(210) == pytest.approx(2 * camera.pupil_radius * gap, rel=1e-12)
    assert camera.micro_image_diameter == pytest.approx(2 * camera.pupil_radius * 0.512 / camera.pupil_distance)
    assert math.isfinite(camera.blur_diameter(math.inf))


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
    assert Glass.from_plain(1.5).reach == (0, 2500)
