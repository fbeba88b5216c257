"""Cameras fitted to white pictures that other parts of the package draw, by rays and by waves."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import scipy.ndimage
from PIL import Image
from refusals import refused, refuses

from mitsuba_plenoptic import Capture, PlenopticCamera, Vignetting, render_capture
from mitsuba_plenoptic.calibration import fit_white
from mitsuba_plenoptic.camera.camera_files import camera_and_record
from mitsuba_plenoptic.camera.lens_transmissions import LensTransmissions
from mitsuba_plenoptic.camera.stray_light import StrayLight
from mitsuba_plenoptic.cli import main
from mitsuba_plenoptic.detector import DetectorOperator
from mitsuba_plenoptic.extensions.calibrate import white_fit
from mitsuba_plenoptic.extensions.calibrate.array_fit import fit_array, places
from mitsuba_plenoptic.extensions.calibrate.white_frames import WhiteFrame, black_level
from mitsuba_plenoptic.extensions.calibrate.white_page import side_by_side
from mitsuba_plenoptic.io.pictures import read_picture
from mitsuba_plenoptic.views import lens_grid, white_image

THIN = PlenopticCamera(
    focal_length=50, aperture_radius=3.2, focus_distance=400, mla_focal_length=0.8, mla_pitch=0.1, mla_rotation=0.2,
    mla_offset=(0.013, -0.021), detector_width=1.6, resolution=(240, 200),
)  # fmt: skip


def recorded(light, seed=0, photons=20000, dark=100.0):
    generator = np.random.default_rng(seed)
    white = generator.poisson(photons * light.clip(0)) + generator.normal(dark, 2, light.shape)
    return white, generator.normal(dark, 2, light.shape)


SQUARES = np.linspace(-1, 1, 9) ** 2
HALF_IN_CORNERS = StrayLight(0.1 - 0.025 * (SQUARES + SQUARES[:, None]))


def test_numbers_of_a_drawn_white_are_found():
    camera = THIN.replace(mla_lattice="hexagonal", mla_rotation=27.0, detector_blur=0.8 * THIN.pixel_size)
    camera = camera.replace(stray_light=HALF_IN_CORNERS)
    light = white_image(camera)
    assert WhiteFrame.of(Capture(white_image(THIN), THIN)).saturated == 0
    white, dark = recorded(light)
    start = camera.replace(mla_pitch=0.0992, mla_rotation=0.0, mla_offset=(0, 0), aperture_radius=2.8)
    found = fit_white(white, start, dark=dark, wavelength=None)
    array, numbers = found.array, {name: values[0] for name, values in found.field.coefficients.items()}
    assert array.pitches == pytest.approx((0.1, 0.1), rel=2e-4)
    assert array.rotation == pytest.approx(camera.mla_rotation, abs=0.02)
    assert numbers["radius"] == pytest.approx(camera.pupil_radius / camera.pupil_step, rel=2e-3)
    assert numbers["blur"] == pytest.approx(0.8, rel=0.02)
    # The camera records as much stray light, in parts of the mean light.
    stray = [DetectorOperator.of(some).stray_light for some in (found.camera, camera)]
    assert np.abs(np.subtract(*stray)).max() < 0.005
    assert np.abs(white_image(found.camera) - light).mean() < 0.01
    for name in ("ellipse_x", "ellipse_y", "slope_x", "slope_y"):
        assert abs(numbers[name]) < 5 * found.deviations[name][0] + 1e-3
    assert found.withheld.sum() > 30
    assert np.sqrt((found.off_array[found.withheld] ** 2).mean(0)).max() < 0.02
    # Nothing but noise of photons is left.
    assert found.judgement.systematic < 0.006
    assert found.judgement.residual < 0.011


@pytest.mark.slow
def test_an_iris_and_a_map_of_the_pupil_are_found():
    """Seven dents of the outline, and light that falls along a diagonal, which stray light alike everywhere is not."""
    iris = Vignetting(0.95, transmission=[0.0, 0.3, 0.0], harmonics=[*[0.0] * 8, 0.03, -0.02])
    camera = THIN.replace(mla_pitch=0.15, aperture_radius=4.8, vignetting=iris, detector_blur=0.005)
    white, dark = recorded(white_image(camera))
    found = fit_white(white, camera, dark=dark, wavelength=None).camera.vignetting
    assert found.harmonics[8:10] == pytest.approx((0.03, -0.02), abs=0.002)
    corner = [found.power(0.5, y, 0, 0) / found.power(0, 0, 0, 0) for y in (0.5, -0.5)]
    assert corner == pytest.approx((1.083, 0.917), abs=0.01)
    assert camera.replace(vignetting=found.to_plain()).vignetting == found


@pytest.mark.slow
def test_a_pupil_that_narrows_from_lens_to_lens_is_found():
    """Within a zone of eight lenses the rim moves by a pixel, which is more than a first order tells."""
    narrowing = Vignetting([1.0, 0, 0, -0.2, 0, -0.2], 0.8)
    light = white_image(THIN.replace(vignetting=narrowing, detector_blur=0.8 * THIN.pixel_size))
    found = fit_white(recorded(light)[0] - 100, THIN, wavelength=None).camera
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 8), np.linspace(-0.55, 0.55, 8))
    radius = found.vignetting.at(x, y)["radius"] * found.aperture_radius / THIN.aperture_radius
    # Noise moves the corners by up to 2.4 per cent.
    assert np.sqrt(((radius / narrowing.at(x, y)["radius"] - 1) ** 2).mean()) < 0.008


@pytest.mark.slow
def test_waves_are_told_from_rays():
    """The white of a wave capture is fitted by waves without a blur; rays explain its diffraction by a wide one."""
    camera = THIN.replace(mla_pitch=0.08, mla_focal_length=1.6, detector_distance=1.6, aperture_radius=1.3)
    camera = camera.replace(detector_width=0.8, resolution=(160, 120), mla_rotation=23.0)
    scene = {"type": "scene", "lamp": {"type": "constant"}}
    waves = {"type": "plenoptic_wave", "wavelength": 550.0, "child": {"type": "direct"}}
    light = render_capture(mi.load_dict(scene | {"camera": camera.to_sensor(), "integrator": waves}), spp=256).image
    found = {length: fit_white(light, camera, wavelength=length) for length in (550.0, None)}
    radius, blur = ({key: fit.field.coefficients[name][0] for key, fit in found.items()} for name in ("radius", "blur"))
    assert radius[550.0] == pytest.approx(camera.pupil_radius / camera.pupil_step, rel=2e-3)
    assert abs(blur[550.0]) < 0.25 < 0.7 < blur[None]
    # Light that lenses diffract far is no stray light.
    assert abs(found[550.0].field.coefficients["stray"][0]) < 0.002
    waves, rays = (found[length].judgement for length in (550.0, None))
    assert waves.mean_image < 0.003
    assert rays.mean_image > 2 * waves.mean_image


@pytest.mark.slow
def test_lenses_are_whole_by_their_place():
    """A cell of 15.4 x 15.4 pixels may hold 15 x 15 of them, 95 % of it; all have their own brightness."""
    bright = LensTransmissions(1 + 0.05 * np.random.default_rng(1).standard_normal((61, 61)), first=(-30, -30))
    camera = THIN.replace(mla_rotation=0.0, mla_transmissions=bright, aperture_radius=3.0)
    size = camera.micro_image_pitch / 15.4
    camera = camera.replace(resolution=(190, 170), detector_width=190 * size)
    found = fit_white(1000 * white_image(camera), camera, wavelength=None)
    from_axis = (found.place + 0.5 - [95, 85]) * size / camera.image_growth
    true = bright.at(camera.lattice, *np.rint(camera.lattice.cell(*from_axis.T)))
    assert (found.brightness / true).std() < 1e-3 * (found.brightness / true).mean()
    corners = lens_grid(camera).centres().reshape(-1, 1, 2) + camera.lattice.cell_corners() * 15.4 / camera.row_pitch
    assert len(found.place) >= ((corners > 0) & (corners < [190, 170])).all((1, 2)).sum() > 100


@pytest.mark.slow
def test_micro_images_that_overlap_are_fitted():
    camera = THIN.replace(mla_rotation=3.0, resolution=(200, 180), detector_width=4 / 3)
    scale = 1.25 / camera.micro_image_diameter * camera.micro_image_pitch
    camera = camera.replace(aperture_radius=camera.aperture_radius * scale, detector_blur=0.6 * camera.pixel_size)
    white, dark = recorded(white_image(camera))
    found = fit_white(white, camera.replace(mla_rotation=0.0, mla_offset=(0, 0)), dark=dark, wavelength=None)
    assert found.array.rotation == pytest.approx(3.0, abs=0.02)
    assert found.array.pitches == pytest.approx((0.1, 0.1), rel=1e-3)
    numbers = {name: values[0] for name, values in found.field.coefficients.items()}
    assert numbers["radius"] == pytest.approx(camera.pupil_radius / camera.pupil_step, rel=5e-3)
    # Samples of a narrow blur have its variance, not its form; hardly any gap is left that tells of stray light.
    assert numbers["blur"] == pytest.approx(0.6, abs=0.06)
    assert abs(numbers["stray"]) < 0.04


SMALL = THIN.replace(resolution=(150, 120), detector_width=1.0)
WHITE, DARK = recorded(white_image(SMALL))


def scene_like(light):
    """A picture whose micro-images differ, as those of a scene do."""
    texture = scipy.ndimage.gaussian_filter(np.random.default_rng(5).random(light.shape), 2)
    return light * (0.3 + 0.7 * texture / texture.max()) ** 3


def fitted(white=WHITE, dark=DARK, wavelength=None, **changes):
    return fit_white(white, SMALL.replace(**changes), dark=dark, wavelength=wavelength)


test_wrong_pictures_are_refused = refused(
    (lambda: fitted(scene_like(WHITE - DARK), None), "no white picture"),
    (lambda: fitted(mla_pitch=0.11), "pixels apart"),
    (lambda: fitted(mla_lattice="hexagonal"), "rows that are not shifted"),
    (lambda: fitted(WHITE.T, DARK.T), "is the picture turned"),
    (lambda: fitted(WHITE.clip(None, 15000)), "saturated"),
    (lambda: fitted(Capture(WHITE.clip(None, 15000), SMALL, metadata={"raw": {}})), "saturated"),
    (lambda: fitted(DARK, WHITE), "dark: it is not darker"),
    (lambda: fitted(WHITE.max() - WHITE, None), "no white picture by this camera"),
    (lambda: fit_white(WHITE, PlenopticCamera(mla_lattice="none"), wavelength=None), "mla_lattice = none"),
    (lambda: fitted(dark=DARK + 1000), r"stray light of -0\.05"),
)


def test_wrong_numbers_are_refused_before_lenses_are_searched(monkeypatch):
    monkeypatch.setattr(white_fit, "find_centres", lambda white, like: pytest.fail("searched"))
    refuses("dark of shape", fitted, dark=DARK[:-1])
    refuses("pixels wide", fitted, mla_pitch=4e-3, mla_focal_length=0.032)
    refuses("fit by rays", fitted, mla_aperture="circle", wavelength=550.0)


@pytest.mark.slow
def test_eight_bits_mirrored_pictures_and_dust_are_fitted():
    light = (WHITE - DARK).clip(0)
    light[[[40], [60], [80]], 60:72] *= 0.3
    light[80, 30:33] = light.max()
    found = fit_white(np.round(light[:, ::-1] / light.max() * 250), SMALL, wavelength=None)
    assert found.array.rotation == pytest.approx(-SMALL.mla_rotation, abs=0.05)
    assert found.field.coefficients["radius"][0] == pytest.approx(SMALL.pupil_radius / SMALL.pupil_step, rel=5e-3)
    assert 4 / light.size < found.judgement.outliers < 60 / light.size * 3


def test_a_light_field_below_its_dark_picture_has_a_black_level_of_its_own():
    light = scene_like(WHITE - DARK)
    light[50:60, 60:80] = 0
    light += np.random.default_rng(2).normal(0, 5, light.shape)
    light[20, 20] = -light.max()
    assert black_level(light) == 0
    with pytest.warns(UserWarning, match="its darkest places lie .* below the dark picture"):
        level = black_level(light - 0.1 * light.mean())
    assert level == pytest.approx(-0.1 * light.mean(), abs=5)


ANTLEG = Path(__file__).parent / "antleg"
"""Part of a real microscope's white picture and dark frame, from napari-LF (BSD 3-Clause, LICENSE beside them)."""


@pytest.mark.slow
def test_a_real_microscope_is_fitted():
    """Of 360 x 300 pixels; the whole picture is in the bench. The nominal camera misses this white by 11 %."""
    white, dark = (read_picture(ANTLEG / f"{name}.png", linear=True) for name in ("white", "dark"))
    found = fit_white(white, PlenopticCamera.preset("lfm_water"), dark=dark, wavelength=510)
    camera, judged = found.camera, found.judgement
    # Pitch and numerical aperture as built: 125 um, 0.5.
    assert camera.mla_pitches == pytest.approx((0.125, 0.125), rel=0.005)
    assert 0.46 < camera.objective.numerical_aperture < 0.5
    # Behind a relay 50:35, in pixels of 4.55 um.
    assert 0.5 < camera.detector_blur / camera.pixel_size < 1
    assert judged.mean_image < 0.02
    # Single lenses scatter by 2.7 % about their mean image.
    assert judged.residual < 1.1 * 0.027
    assert np.sqrt((found.off_array[found.withheld] ** 2).mean(0)).max() < 0.1
    recorded, simulated = side_by_side(found, samples=64)
    assert np.sqrt(((recorded - simulated) ** 2).mean()) < 0.03


def test_the_command_writes_a_camera_and_a_page(tmp_path, capsys, coarse_figures):
    for name, values in (("white", WHITE), ("dark", DARK)):
        Image.fromarray(values.clip(0).astype(np.uint16)).save(tmp_path / f"{name}.tif")
    (tmp_path / "known.json").write_text(SMALL.replace(resolution=(100, 100), detector_width=100 / 150).to_json())
    files = {name: str(tmp_path / name) for name in ("white.tif", "dark.tif", "known.json", "camera.json", "page.html")}
    words = ["calibrate", "white", files["white.tif"], "--dark", files["dark.tif"], "--camera", files["known.json"]]
    assert main([*words, "--model", "ray", "-o", files["camera.json"], "--report", files["page.html"]]) == 0
    assert "places: 0.0" in capsys.readouterr().out
    camera, record = camera_and_record(files["camera.json"])
    assert camera.resolution == (150, 120)
    assert camera.pupil_radius == pytest.approx(SMALL.pupil_radius, rel=5e-3)
    # One number an electron, and two of read noise; sharp rims in so small a picture add a tenth; it states 0.2.
    sensor = record["detector"]
    assert sensor["gain"] == pytest.approx(1.1, rel=0.1)
    assert sensor["gain"] * sensor["read_noise"] == pytest.approx(2, rel=0.1)
    assert "data:image/png" in (tmp_path / "page.html").read_text()
    assert main([*words, "--model", "ray", "--wavelength", "500", "-o", files["camera.json"]]) == 2


STRAIGHT = THIN.replace(aperture_radius=3.0, detector_width=3.0, resolution=(300, 260))
"""30 x 26 lenses of ten pixels."""

# Up to 0.3 pixels along x and along y, by Chebyshev's 16 t^5 - 20 t^3 + 5 t, which no lower degree resembles.
SIZE = 0.3 * STRAIGHT.pixel_size / STRAIGHT.image_growth
FIFTH = np.zeros((2, 18))
FIFTH[0, [3, 12]] = SIZE * np.array([-20 / 1.5**3, 16 / 1.5**5])
FIFTH[1, [6, 17]] = SIZE * np.array([-20 / 1.3**3, 16 / 1.3**5])
WARPED = STRAIGHT.replace(mla_warp=tuple(FIFTH.ravel()))


@pytest.mark.parametrize(
    ("camera", "lenses", "terms", "most"),
    [(STRAIGHT, 25, 0, 0.01), (WARPED, 25, 18, 0.03), (WARPED, 17, 7, 0.6), (WARPED, 11, 0, 0.6)],
)
def test_withheld_places_choose_the_degree(camera, lenses, terms, most):
    """Of centres with noise of 0.02 pixels, where lenses suffice: 20 for each term; 17 x 17 are too few for 18."""
    index = np.stack(np.meshgrid(*2 * [np.linspace(-12.0, 12.0, lenses).round()]), axis=-1).reshape(-1, 2)
    centre = np.stack(camera.lattice.centre(*index.T), axis=-1)
    true = centre * camera.image_growth / camera.pixel_size + (np.array(camera.resolution) - 1) / 2
    fit = fit_array(true + np.random.default_rng(1).normal(0, 0.02, true.shape), index, STRAIGHT)
    assert np.flatnonzero(fit.warp.reshape(2, -1).any(0)).max(initial=-1) + 1 == terms
    assert np.hypot(*(places(fit, index, camera) - true).T).max() < most


@pytest.mark.slow
def test_a_warp_of_fifth_degree_is_found_in_a_white_picture():
    light = scipy.ndimage.gaussian_filter(white_image(WARPED), 0.8) * 0.97 + 0.03
    generator = np.random.default_rng(0)
    white, dark = generator.poisson(20000 * light), generator.normal(0, 2, light.shape)
    fit = fit_white(white, STRAIGHT, dark=dark, wavelength=None)
    assert len(fit.camera.mla_warp) == 36
    off = places(fit.array, fit.lens, fit.camera)[:, None] + 0.5 - lens_grid(WARPED).centres().reshape(-1, 2)
    assert np.hypot(*off.transpose(2, 0, 1)).min(1).max() < 0.03
