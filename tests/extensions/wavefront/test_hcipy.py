"""Cameras as optical elements of HCIPy, against its own microlens arrays on the same wavefronts."""

import numpy as np
import pytest
from cameras import error
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.far_sources import star

hcipy = pytest.importorskip("hcipy")

from mitsuba_plenoptic.hcipy import CameraOptics, phase_screen  # noqa: E402

WAVELENGTH = 633e-9
TERMS = [0, 0.2, -0.1, 0.1, -0.15, 0.05, 0.08, -0.06, 0.1, 0.04]
FINER = 3
"""HCIPy's samples along an axis in a pixel."""


def wavefront(grid, diameter, terms=TERMS):
    """An aberrated wavefront in a round aperture, with the power 1."""
    aperture = hcipy.evaluate_supersampled(hcipy.make_circular_aperture(diameter), grid, 8)
    modes = hcipy.make_zernike_basis(len(terms), diameter, grid)
    phase = 2 * np.pi * sum(term * mode for term, mode in zip(terms, modes, strict=True))
    made = hcipy.Wavefront(hcipy.Field(aperture * np.exp(1j * phase), grid), WAVELENGTH)
    made.total_power = 1
    return made


def exact(camera, points):
    return mp.CaptureOperator(camera, points, wavelength=WAVELENGTH * 1e9, method="full_field")


def binned(samples, pixels):
    return samples.reshape(pixels, FINER, pixels, FINER).sum((1, 3))


def spots(image, lenses):
    """Centroids in pixels of the lenses' cells that have most of a lens's light."""
    size = image.shape[0] // lenses
    cells, index = image.reshape(lenses, size, lenses, size), np.arange(size)
    power = cells.sum((1, 3))
    found = np.stack([np.einsum("arbs,s->ab", cells, index), np.einsum("arbs,r->ab", cells, index)]) / power
    return found[:, power > 0.9 * np.median(power[power > 0.3 * power.max()])]


def test_a_shack_hartmann_sensor_equals_that_of_hcipy():
    # HCIPy places the centre of a lens on the axis; the pupil's image of 1.6 mm has five lenses across.
    width, beam, magnification = 1.76e-3, 1.6e-3, 0.32
    size = {"detector_width": 1.76, "resolution": (176, 176)}
    camera = PlenopticCamera.preset("shack_hartmann").replace(aperture_radius=2.5, mla_offset=(0.16, 0.16), **size)
    grid = hcipy.make_pupil_grid(176 * FINER, width)
    given = wavefront(grid, beam)
    theirs = binned(hcipy.SquareShackHartmannWavefrontSensorOptics(grid, 50, 5, beam).forward(given).power.shaped, 176)
    # The collimator images the pupil upside down.
    pupil = hcipy.make_pupil_grid(grid.dims, width / magnification)
    entering = hcipy.Wavefront(hcipy.Field(given.electric_field.shaped[::-1, ::-1].ravel(), pupil), WAVELENGTH)
    entering.total_power = 1
    ours = CameraOptics(camera).forward(entering)
    assert ours.grid.x.min() == pytest.approx(-0.875e-3) and ours.sum() == pytest.approx(0.997, abs=3e-3)
    assert error(ours.shaped, theirs) < 0.01
    # The detector's 5.5 cells across: those of the inner five lenses.
    ours, theirs = (spots(image[8:168, 8:168], 5) for image in (ours.shaped, theirs))
    assert ours.shape[1] >= 9 and np.abs(ours - theirs).max() < 0.01


def test_an_array_in_the_focus_equals_that_of_hcipy():
    camera = PlenopticCamera.preset("telescope").replace(detector_width=1.28, resolution=(128, 128))
    pupil, focus = hcipy.make_pupil_grid(128, 10.24e-3), hcipy.make_pupil_grid(128 * FINER, 1.28e-3)
    given = wavefront(pupil, 10e-3)
    field = hcipy.FraunhoferPropagator(pupil, focus, focal_length=0.5).forward(given)
    # Fraunhofer's integral leaves the curvature of the focal plane's field out.
    field.electric_field *= np.exp(1j * np.pi * (focus.x**2 + focus.y**2) / (WAVELENGTH * 0.5))
    centres = (np.arange(6) - 2.5) * 0.32e-3
    array = hcipy.MicroLensArray(focus, hcipy.CartesianGrid(hcipy.SeparatedCoords((centres, centres))), 16e-3)
    # Oversampling its transfer function, as it does by default, would lose 0.6 % of the light.
    behind = hcipy.FresnelPropagator(focus, 16e-3, num_oversampling=1).forward(array.forward(field))
    optics = CameraOptics(camera)
    ours = optics.forward(given)
    assert error(ours.shaped, binned(behind.power.shaped, 128)) < 0.01
    assert hcipy.NoisyDetector(optics.output_grid)(1e5 * ours).sum() == pytest.approx(1e5 * ours.sum(), abs=1600)


def test_screens_of_atmospheres_and_wavefronts_behind_them_agree():
    grid = hcipy.make_pupil_grid(160, 10.24e-3)
    strength = hcipy.Cn_squared_from_fried_parameter(3e-3, WAVELENGTH)
    layer = hcipy.InfiniteAtmosphericLayer(grid, strength, L0=10, seed=1, use_interpolation=True)
    camera = PlenopticCamera.preset("shack_hartmann").replace(resolution=(128, 128))
    behind = CameraOptics(camera).forward(layer.forward(wavefront(grid, 10e-3, [0])))
    screen = phase_screen(layer.phase_for(WAVELENGTH), WAVELENGTH)
    # The aperture's edge is sampled by 64 um once, and exact once.
    points, weights = star()
    assert error(behind.shaped, exact(camera.replace(phase_screen=screen), points).forward(weights)) < 0.01


@pytest.mark.parametrize("model", ["ideal", "parabolic"])
def test_a_tilted_wavefront_is_a_star_off_the_axis(model, slope=0.04):
    """An ideal lens of f/4 images it as sharply as one on the axis; microlenses take its slopes for cosines: 4 %."""
    camera = PlenopticCamera(
        focal_length=4, mla_distance=4, aperture_radius=0.5, mla_pitch=0.02, mla_focal_length=0.084,
        detector_width=0.64, resolution=(320, 320), lens_model=model,
    )  # fmt: skip
    grid = hcipy.make_pupil_grid(640, 1.05e-3)
    given = wavefront(grid, 1e-3, [0])
    tilt = slope if model == "ideal" else slope / np.sqrt(1 + 2 * slope**2)
    given.electric_field *= np.exp(-2j * np.pi * tilt * (grid.x + grid.y) / WAVELENGTH)
    star = np.array([[slope, slope, 1]]) * 1e9
    limit = 0.06 if model == "ideal" else 2e-3
    assert error(CameraOptics(camera).forward(given).shaped, exact(camera, star).forward([1.0])) < limit


def test_powers_and_places_of_pixels():
    # Columns 10 to 69 and rows 40 to 59 of 128, each 20 um wide.
    camera = PlenopticCamera.preset("telescope").replace(resolution=(128, 128))
    crop = CameraOptics(camera.replace(crop_offset=(10, 40), crop_size=(60, 20)))
    x, y = crop.output_grid.separated_coords
    assert x[[0, -1]] == pytest.approx([-53.5 * 20e-6, 5.5 * 20e-6])
    assert y[[0, -1]] == pytest.approx([-23.5 * 20e-6, -4.5 * 20e-6])
    given = wavefront(hcipy.make_pupil_grid(128, 10.24e-3), 10e-3)
    one = crop.forward(given)
    assert error(one.shaped, CameraOptics(camera).forward(given).shaped[40:60, 10:70]) < 1e-3
    given.total_power = 3
    assert error(crop.forward(given), 3 * one) < 1e-5


def test_bad_wavefronts_are_refused():
    optics, grid = CameraOptics(PlenopticCamera.preset("telescope")), hcipy.make_pupil_grid(16, 0.01)
    steep = hcipy.Field(np.exp(0.95j * np.pi * np.add.outer(range(16), range(16)).ravel()), grid)
    with pytest.raises(mp.PhysicsError, match="under-sampled"):
        optics.forward(hcipy.Wavefront(steep, WAVELENGTH))
    # Three times as wide as the telescope's aperture, of which the window holds a part.
    with pytest.raises(mp.PhysicsError, match=r"of the wavefront's power is outside the window"):
        optics.forward(hcipy.Wavefront(hcipy.make_pupil_grid(64, 0.03).ones() + 0j, WAVELENGTH))
    even = grid.ones() + 0j
    refuses("wavelength = 633", optics.forward, hcipy.Wavefront(even, 633))
    refuses("power 0", optics.forward, hcipy.Wavefront(0 * even, WAVELENGTH))
    refuses("scalar", optics.forward, hcipy.Wavefront(even, WAVELENGTH, input_stokes_vector=(1, 0, 0, 0)))
    refuses("complex", phase_screen, grid.ones() + 1j, WAVELENGTH)
    refuses("steps", phase_screen, hcipy.make_pupil_grid([16, 16], [0.01, 0.02]).zeros(), WAVELENGTH)
    refuses("centre", phase_screen, grid.shifted((0.01, 0)).zeros(), WAVELENGTH)
    refuses("main_lens = ", CameraOptics, PlenopticCamera.preset("lfm"))
