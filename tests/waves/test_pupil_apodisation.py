"""Pupils with a transmission or a phase screen, by rays, waves of points and signed rays."""

import numpy as np
import pytest
from cameras import disk, error, sky
from cases import scene_of
from scipy.special import j0

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.design import white_mean
from mitsuba_plenoptic.lenses.thin import Wavefront
from mitsuba_plenoptic.optics import guards
from mitsuba_plenoptic.views.white import white_image

A2, A4 = -0.6, 0.2

CAMERA = PlenopticCamera(resolution=(64, 64), detector_width=0.256, pupil_apodisation=(A2, A4))
"""Of 4 x 4 lenses with 16 x 16 pixels."""


def transmission(r, a2=A2, a4=A4):
    return np.clip(1 + a2 * r**2 + a4 * r**4, 0, None)


def on_pupil(camera):
    """Return the distances from the pupil's centre, over its radius, that pixels near the axis see in focus."""
    offset = (camera.pixel_coordinates(0) - camera.mla_offset[0]) % camera.mla_pitch - camera.mla_pitch / 2
    return np.hypot(offset, offset[:, None]) * camera.pupil_distance / camera.mla_focal_length / camera.pupil_radius


def diffracted(camera, wavelength, apodisation, parts=8):
    """Return the white capture: the pupil behind each lens, convolved with the diffraction of its square by FFT."""
    size, step = 3 * camera.resolution[0] * parts, camera.pixel_size / parts
    along, image = (np.arange(size) - size / 2 + 0.5) * step, np.zeros((size, size))
    radius, pitch = camera.micro_image_diameter / 2, camera.micro_image_pitch
    for x, y in np.ndindex(6, 6):
        r = np.hypot(along - (x - 2.5) * pitch, (along - (y - 2.5) * pitch)[:, None])
        image += transmission(r / radius, *apodisation) * np.clip((radius - r) / step + 0.5, 0, 1)
    frequency = np.fft.fftfreq(size, step)
    extent = wavelength * 1e-6 * camera.mla_focal_length / camera.mla_pitch
    transfer = np.clip(1 - np.abs(frequency) * extent, 0, None) * np.sinc(frequency * camera.pixel_size)
    image = np.fft.ifft2(np.fft.fft2(image) * transfer * transfer[:, None]).real
    shape, middle = (camera.resolution[0], parts) * 2, slice(parts // 2 - 1, parts // 2 + 1)
    seen = slice(size // 3, size * 2 // 3)
    return image[seen, seen].reshape(shape)[:, middle, :, middle].mean((1, 3))


def test_rays_read_the_transmission():
    found, plain, seen = sky(CAMERA, 64), sky(CAMERA.replace(pupil_apodisation=(0, 0)), 64), on_pupil(CAMERA)
    whole = (plain == 1) & (np.hypot(*np.meshgrid(*[CAMERA.pixel_coordinates(0)] * 2)) < 0.1)
    # Micro-images lie up to 0.07 pixels beside their lenses.
    assert found[whole] == pytest.approx(transmission(seen)[whole], abs=0.035)
    assert found.mean() / plain.mean() == pytest.approx(1 + A2 / 2 + A4 / 3, rel=3e-3)
    assert np.abs(white_image(CAMERA) - found).mean() < 0.006
    assert found.mean() == pytest.approx(white_mean(CAMERA), rel=0.015)  # of whole lenses


def test_waves_diffract_the_apodised_micro_image():
    camera = CAMERA.replace(resolution=(32, 32), detector_width=0.128)
    found, expected = sky(camera, 512, "wave"), diffracted(camera, 633, (A2, A4))
    assert np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)
    assert found.sum() == pytest.approx(expected.sum(), rel=0.003)


@pytest.mark.parametrize(("method", "a2", "a4"), [("patch", -1.5, 0.0), ("full_field", A2, A4)])
def test_point_spreads_are_sums_over_the_pupil(method, a2, a4):
    """In focus, directly behind a single lens; closed form: the Hankel transform of the amplitude."""
    camera = PlenopticCamera(
        pupil_apodisation=(a2, a4), mla_pitch=2.0, mla_offset=(1.0, 1.0), mla_focal_length=1e6, detector_distance=1e-4,
        resolution=(40, 40), detector_width=0.08,
    )  # fmt: skip
    found = CaptureOperator(camera, [(0, 0, 240)], wavelength=633, method=method, accuracy=0).forward([1.0])
    r = (np.arange(2000) + 0.5) / 2000
    along = (camera.pixel_coordinates(0)[:, None] + (np.arange(5) - 2) / 5 * camera.pixel_size).ravel()
    apart = np.hypot(along, along[:, None])
    radii = np.linspace(0, apart.max(), 500)
    waves = 2 * np.pi * radii[:, None] * r * camera.aperture_radius / (633e-6 * camera.mla_distance)
    field = (np.sqrt(transmission(r, a2, a4)) * r * j0(waves)).sum(1)
    expected = np.interp(apart, radii, field**2).reshape(40, 5, 40, 5).mean((1, 3))
    found, expected = found / found.sum(), expected / expected.sum()
    assert np.linalg.norm(found - expected) < 0.004 * np.linalg.norm(expected)


def test_ordinary_cameras_read_the_mean_transmission():
    camera = PlenopticCamera(mla_lattice="none", resolution=(8, 8), detector_width=0.128, pupil_apodisation=(A2, A4))
    assert sky(camera, 16) == pytest.approx(np.full((8, 8), 1 + A2 / 2 + A4 / 3), abs=1e-4)


PLACES = np.linspace(-5.2, 5.2, 105)
COMA = (0, 0, 0, 0, 0, 0.3, 0, 0.5)


def capture_of_lamp(**changes):
    sensor = mp.PlenopticCamera(resolution=(32, 32), detector_width=0.128, **changes).to_sensor()
    scene = scene_of(sensor, lamp=disk([0.03, 0.02, 240.0], 0.1))
    return mp.render_capture(scene, model="wave", wavelength=550.0, spp=8)


def cubic(waves):
    """A screen that rises by so many waves from the pupil's middle to its rim, by the cube of x."""
    return mp.PhaseScreen(np.tile(waves * (PLACES / 5) ** 3, (len(PLACES), 1)), 10.4)


@pytest.mark.slow
def test_a_screen_of_zernike_terms_equals_the_terms():
    of_terms = mp.PhaseScreen(Wavefront(COMA, 5.0).path(*np.meshgrid(PLACES, PLACES)) / 633e-6, 10.4)
    screen, terms = capture_of_lamp(phase_screen=of_terms).image, capture_of_lamp(wavefront=COMA).image
    assert error(screen, terms) < 2e-3
    assert error(screen, capture_of_lamp().image) > 0.2


def test_the_guard_has_the_third_derivative():
    r"""Of points q apart along x the paths :math:`c x^3` differ by :math:`c q^3 / 4` more than by the slope."""
    found = capture_of_lamp(phase_screen=cubic(10)).metadata["guards"]["phase_screen"]
    along = 550e-6 * 120 / 0.064 * np.cos(np.pi * np.arange(360) / 360)
    phase = 2 * np.pi * 10 * 633 / 550 / 5**3 * along**3 / 4
    assert found == pytest.approx((1 - np.cos(phase)).mean(), rel=0.02)
    with pytest.warns(mp.PhysicsWarning, match="phase_screen"):
        capture_of_lamp(phase_screen=cubic(20))
    with pytest.raises(guards.PhysicsError, match="of the light"):
        capture_of_lamp(phase_screen=cubic(100))
