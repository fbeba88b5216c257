"""Phase screens, far sources, and the cameras with an array in the focus of a telescope or in its pupil's image."""

import json
import math

import mitsuba as mi
import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import PhaseScreen, PlenopticCamera, frozen_flow
from mitsuba_plenoptic.far_sources import binary, extended, star
from mitsuba_plenoptic.lenses.thin import Wavefront
from mitsuba_plenoptic.prescription.collimator import Collimator
from mitsuba_plenoptic.report.sheet import design_sheet

WAVELENGTH = 633.0
AIRY_STEP = math.degrees(WAVELENGTH * 1e-6 / 10) * 3600
"""Angle lambda / D of the telescope in arcseconds."""

TERMS = [0, 0.1, -0.2, 0.15, -0.1, 0.05, 0.08, -0.06, 0.1, 0.04]


def camera(preset, **changes):
    """A wavefront sensor with coarser pixels, for speed."""
    return PlenopticCamera.preset(preset).replace(resolution=(128, 128), **changes)


def zernike_screen(terms, samples=96, width=10.2):
    x = np.linspace(-width / 2, width / 2, samples)
    return PhaseScreen(Wavefront(terms, 5.0).path(*np.meshgrid(x, x)) / (WAVELENGTH * 1e-6), width)


def capture(camera, direction=(0.0, 0.0)):
    points, weights = star(direction)
    return mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field").forward(weights)


# -- phase screens -----------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["telescope", "shack_hartmann"])
def test_a_screen_of_zernike_terms_equals_the_terms(preset):
    one = capture(camera(preset, wavefront=TERMS), (20.0, -10.0))
    other = capture(camera(preset, phase_screen=zernike_screen(TERMS)), (20.0, -10.0))
    assert np.linalg.norm(one - other) < 1e-4 * np.linalg.norm(one)
    assert np.linalg.norm(one - capture(camera(preset), (20.0, -10.0))) > 0.1 * np.linalg.norm(one)


@pytest.mark.parametrize("lens_model", ["ideal", "parabolic"])
def test_ray_captures_with_a_screen_are_those_with_the_terms(lens_model):
    strong, scene = [20 * term for term in TERMS], mp.load_scene("telescope")

    def render(**changes):
        sensor = camera("telescope", lens_model=lens_model, **changes)
        return mp.render_capture(mp.with_camera(scene, sensor), model="ray", spp=4).image

    one, other = render(wavefront=strong), render(phase_screen=zernike_screen(strong))
    assert np.linalg.norm(one - other) < 1e-3 * np.linalg.norm(one) < 1e-2 * np.linalg.norm(one - render())


def test_screens_extend_by_half_a_sample_and_must_cover_the_pupil():
    # The centres of 50 cells that cover the pupil.
    x = (np.arange(50) + 0.5) * 0.2 - 5
    tilt = PhaseScreen(np.tile(x, (50, 1)), x[-1] - x[0])
    assert tilt.reach == pytest.approx(5)
    assert tilt.path(5.0, 0.0) == pytest.approx(5 * WAVELENGTH * 1e-6, rel=1e-6)
    assert PlenopticCamera(phase_screen=tilt).phase_screen == tilt
    refuses("phase_screen = .* 5 mm.* 5.1", PlenopticCamera, phase_screen=tilt, aperture_radius=5.1)


def test_screens_in_files_and_scenes(tmp_path):
    screen = zernike_screen(TERMS, samples=12)
    camera = PlenopticCamera(phase_screen=screen)
    assert PlenopticCamera.from_json(camera.to_json()) == camera and "12 x 12 samples" in repr(camera)
    np.save(tmp_path / "waves.npy", screen.waves)
    file = tmp_path / "screen.json"
    file.write_text(json.dumps({"waves": str(tmp_path / "waves.npy"), "width": screen.width}))
    sensor = PlenopticCamera().to_sensor()
    for given in (str(file), json.dumps(screen.to_plain())):
        assert PlenopticCamera.from_sensor(mi.load_dict(sensor | {"phase_screen": given})).phase_screen == screen
    mi.Bitmap(screen.waves.astype(np.float32)[..., None]).write(str(tmp_path / "waves.exr"))
    assert PhaseScreen(tmp_path / "waves.exr", screen.width) == screen
    refuses(r"waves of shape \(2, 2\)", PhaseScreen, [[0, 1], [1, 0]], 10)
    refuses(r"waves\[0, 0\] = nan", PhaseScreen, np.full((8, 8), np.nan), 10)
    refuses("width = -1", PhaseScreen, np.zeros((8, 8)), -1)
    refuses(r"waves\.txt", PhaseScreen, "waves.txt", 10)
    refuses("of type complex128", PhaseScreen, np.ones((6, 6)) * 1j, 12)
    refuses("phase_screen: width", PlenopticCamera, phase_screen={"waves": [[0] * 4] * 4})
    fits = pytest.importorskip("astropy.io.fits")
    fits.writeto(tmp_path / "waves.fits", screen.waves)
    assert PhaseScreen(tmp_path / "waves.fits", screen.width) == screen
    (tmp_path / "bad.fits").write_text("no FITS")
    refuses("it is no FITS file", PhaseScreen, tmp_path / "bad.fits", 10)


def test_frozen_flow_moves_the_screen_with_the_wind():
    x, y = np.meshgrid(np.arange(200), np.arange(120))
    large = np.sin(x / 9) + np.cos(y / 7)
    screens = list(frozen_flow(large, step=0.2, width=10, wind=(300.0, -100.0), interval=0.01, frames=4))
    # Between frames the pattern moves by 3 mm along x and -1 mm along y.
    assert len(screens) == 4 and screens[0].width == pytest.approx(10)
    assert np.allclose(screens[1].path(3.0, -1.0), screens[0].path(0.0, 0.0))
    (middle,) = frozen_flow(large, step=0.2, width=10, wind=(0.0, 0.0), interval=1, frames=1)
    assert middle.path(0.1, 0.1) / (WAVELENGTH * 1e-6) == pytest.approx(large[60, 100], abs=1e-4)
    refuses("51 x 351", frozen_flow, large, step=0.2, width=10, wind=(600.0, 0.0), interval=0.1, frames=2)
    options = {"step": 1.0, "wind": (0.0, 0.0), "interval": 1.0, "frames": 1}
    for size, width in ((3, 2.0), (1100, 1030.0), (9, 1e300)):
        refuses("width = ", frozen_flow, np.zeros((size, size)), **options | {"width": width})
    assert next(frozen_flow(np.zeros((4, 4)), **options | {"width": 2.5})).waves.shape == (4, 4)
    gale = {"width": 5.0, "wind": (1e300, 0), "interval": 1e300, "frames": 2}
    refuses("6 x inf", frozen_flow, np.zeros((9, 9)), **options | gale)


# -- far sources -------------------------------------------------------------------------------------


def test_directions_of_far_sources(tmp_path):
    picture = np.zeros((2, 4))
    # The upper left pixel and the lower right one.
    picture[0, 0], picture[1, 3] = 3, 1
    for (points, weights), seen, light in (
        (binary(10.0, angle=90.0, ratio=0.25, direction=(4.0, 0.0)), [(4, -5), (4, 5)], [0.8, 0.2]),
        (extended(picture, width=8.0), [(3, 1), (-3, -1)], [0.75, 0.25]),
    ):
        assert np.allclose(np.rad2deg(np.arctan2(points[:, :2], points[:, 2:])) * 3600, seen)
        assert np.allclose(weights, light)
    refuses(r"^picture: it must be bright", extended, np.zeros((4, 4)), width=1)
    refuses(r"^direction = 1e", star, (1e9, 0))
    file = tmp_path / "colours.exr"
    mi.Bitmap(np.ones((6, 6, 3), np.float32)).write(str(file))
    refuses(r"colours.exr: .*3 channels", extended, file, width=1)


def test_a_star_off_axis_is_a_tilt():
    # By its tilt over the pupil, 2 a4 / radius in waves per millimetre.
    step = 1.5 * AIRY_STEP
    tilt = math.tan(math.radians(step / 3600)) * 5.0 / (2 * WAVELENGTH * 1e-6)
    for preset in ("telescope", "shack_hartmann"):
        one, other = capture(camera(preset), (step, 0.0)), capture(camera(preset, wavefront=[0, -tilt]))
        assert np.linalg.norm(one - other) < 1e-4 * np.linalg.norm(one)


# -- the array in the image of the pupil --------------------------------------------------------------


def test_the_collimator_as_plain_data_and_what_it_refuses():
    camera = PlenopticCamera.preset("shack_hartmann")
    assert PlenopticCamera.from_json(camera.to_json()) == camera
    assert camera.main_lens == Collimator(160.0) and camera.mla_distance == pytest.approx(500 + 160 + 160 * 1.32)
    assert camera.focus_distance == math.inf and camera.blur_diameter(math.inf) == pytest.approx(3.2)
    refuses("^mla_distance = 300: with this main_lens it is 871.2", camera.replace, mla_distance=300.0)
    refuses("^focus_distance = 300: a telescope", camera.replace, focus_distance=300.0)
    refuses("^mla_tilt", camera.replace, mla_tilt=(1.0, 0.0))
    lens = {"collimator_focal_length": -1}
    refuses("^main_lens: collimator_focal_length = -1", camera.replace, main_lens=lens)
    refuses("full_field", mp.CaptureOperator, camera, star()[0], wavelength=WAVELENGTH)
    with pytest.raises(RuntimeError, match="main_lens = collimator"):
        mi.load_dict(camera.to_sensor())
    assert mp.design.design_warnings(camera, 633) == []
    sheet = {row.quantity: row.value for row in design_sheet(camera.replace(wavefront=TERMS), 633)}
    assert sheet["lenses across it"] == "10" and sheet["field of a lens"] == "1320" and "aberrations" in sheet
