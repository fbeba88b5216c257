"""Point spread functions: the referee against closed forms and itself, the patch against the referee."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import j1

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.capture.full_field import full_field
from mitsuba_plenoptic.capture.pixels import integrate_pixels
from mitsuba_plenoptic.capture.point_spread import point_fields, point_spread_function
from mitsuba_plenoptic.capture.point_spread import point_spread_function as reexported
from mitsuba_plenoptic.errors import InputError
from mitsuba_plenoptic.optics.free_space import propagate
from mitsuba_plenoptic.optics.microlenses import orders, transmission, transmission_table

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from point_spread_accuracy import cases, convergence, measure

WAVELENGTH = 633.0
SMALL = PlenopticCamera(detector_width=1.536, resolution=(768, 768))
# other numbers throughout; 20.2 pixels to a lens, fewer rows than columns
OTHER = PlenopticCamera(
    focal_length=50, aperture_radius=4, mla_distance=70, mla_focal_length=0.4, mla_pitch=0.05,
    detector_width=1.5, resolution=(606, 500),
)  # fmt: skip


def error(image, reference):
    return np.linalg.norm(image - reference) / np.linalg.norm(reference)


def test_is_exported():
    assert reexported is point_spread_function


@pytest.mark.parametrize(
    "camera, position, wavelength",
    [
        (SMALL, (0.0, 0.0, 240.0), 633),
        (SMALL, (0.4, -0.3, 240.0), 633),
        (SMALL, (0.2, 0.1, 215.0), 633),
        (SMALL, (-0.3, 0.5, 270.0), 450),
        (OTHER, (0.5, 0.4, 175.0), 532),
        (OTHER, (-0.2, 0.6, 190.0), 700),
    ],
)
def test_patch_against_full_field(camera, position, wavelength):
    patch = point_spread_function(camera, position, wavelength=wavelength)
    full = point_spread_function(camera, position, wavelength=wavelength, method="full_field")
    assert patch.shape == full.shape == camera.shape
    assert patch.dtype == np.float32
    assert patch.min() >= 0
    assert error(patch, full) < 0.005


def test_orientation():
    """The image of (X, Y, g) lies at (-X b/g, -Y b/g); columns grow with x and rows with y."""
    X, Y, g = -0.3, 0.45, 240.0
    psf = point_spread_function(SMALL, (X, Y, g), wavelength=WAVELENGTH)
    rows, columns = np.indices(psf.shape)
    for index, place in ((columns, -X / 2), (rows, -Y / 2)):
        centre = (psf * index).sum() / psf.sum()
        assert centre == pytest.approx(384 - 0.5 + place / SMALL.pixel_size, abs=16)


@pytest.mark.parametrize("method", ["patch", "full_field"])
def test_crop_is_a_part_of_the_whole(method):
    position = (0.2, 0.1, 225.0)
    whole = point_spread_function(SMALL, position, wavelength=WAVELENGTH, method=method)
    crop = SMALL.replace(crop_offset=(260, 301), crop_size=(150, 101))
    part = point_spread_function(crop, position, wavelength=WAVELENGTH, method=method)
    assert error(part, whole[301:402, 260:410]) < 2e-3


def test_airy_pattern_of_the_bare_main_lens():
    """In focus, without microlenses, at D1 = 5 where the thin parabolic lens is diffraction limited."""
    z = 0.512
    camera = PlenopticCamera(
        aperture_radius=2.5,
        mla_distance=120 - z,
        detector_distance=z,
        detector_width=0.512,
        resolution=(256, 256),
    )
    psf = full_field(camera, np.array([0.0, 0.0, 240.0]), WAVELENGTH, microlenses=False)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    p, lam = camera.pixel_size, WAVELENGTH * 1e-6
    x = (np.arange(256) - 127.5)[:, None] * p + nodes * p / 2
    r = np.hypot(x[:, None, :, None], x[None, :, None, :])
    sine = camera.aperture_radius / np.hypot(camera.aperture_radius, 120)
    v = 2 * np.pi * sine * r / lam
    density = np.pi * (sine / lam) ** 2 * (2 * j1(v) / v) ** 2
    expected = np.einsum("ijkl,k,l->ij", density, weights, weights) * (p / 2) ** 2
    assert error(psf, expected) < 1e-3


def test_orders_of_the_lens_array():
    """The Fresnel integrals against a plain sum over the cell."""
    x = (np.arange(200_000) + 0.5) / 200_000 * SMALL.mla_pitch
    t = np.exp(-1j * np.pi * (x - SMALL.mla_pitch / 2) ** 2 / (WAVELENGTH * 1e-6 * SMALL.mla_focal_length))
    q = np.arange(-20, 21)
    expected = [np.mean(t * np.exp(-2j * np.pi * k * x / SMALL.mla_pitch)) for k in q]
    assert np.allclose(orders(SMALL, WAVELENGTH, 20), expected, atol=1e-8)
    # all of the light is in some order
    assert np.sum(np.abs(orders(SMALL, WAVELENGTH, 3000)) ** 2) == pytest.approx(1, abs=1e-4)


@pytest.mark.filterwarnings("ignore:.*outer eighth of its window:mitsuba_plenoptic.PhysicsWarning")  # it is periodic
@pytest.mark.parametrize("part", [0.25, 1.0, 7.3])
def test_self_imaging_of_a_bare_lens_array(part):
    """A plane wave through the array, parts of a Talbot length on, against its Fourier orders with exact kz."""
    pitch, lam = SMALL.mla_pitch, WAVELENGTH * 1e-6
    periods, per_period = 6, 96
    highest = 0.3
    table = transmission_table(SMALL, WAVELENGTH, highest)
    x = np.arange(periods * per_period) * pitch / per_period
    t = transmission(SMALL, table, x, 0)
    distance = part * 2 * pitch**2 / lam
    field = propagate(t[None, :] * t[:, None], pitch / per_period, distance, WAVELENGTH)

    q = np.arange(-int(highest * pitch / lam), int(highest * pitch / lam) + 1)
    fine = (np.arange(100_000) + 0.5) / 100_000 * pitch
    lens = np.exp(-1j * np.pi * (fine - pitch / 2) ** 2 / (lam * SMALL.mla_focal_length))
    c = np.array([np.mean(lens * np.exp(-2j * np.pi * k * fine / pitch)) for k in q])
    s2 = (q[:, None] ** 2 + q[None, :] ** 2) * (lam / pitch) ** 2
    turns = distance / lam * (np.sqrt(1 - s2) - 1)
    waves = np.exp(2j * np.pi * q[None, :] * x[:, None] / pitch)
    expected = waves @ (c[:, None] * c[None, :] * np.exp(2j * np.pi * turns)) @ waves.T
    assert error(field, expected) < 1e-4


def test_power():
    fields = point_fields(SMALL, (0.1, -0.2, 240.0), wavelength=WAVELENGTH)
    assert fields.pupil.power == pytest.approx(1, abs=5e-4)
    # the microlenses and the way to the detector lose nothing within the window
    assert fields.detector.power == pytest.approx(fields.mla.power, rel=1e-4)
    psf = point_spread_function(SMALL, (0.1, -0.2, 240.0), wavelength=WAVELENGTH, method="full_field")
    # what is on the detector and what passes it by
    detector = fields.detector
    x, y = (
        origin + detector.pitch * np.arange(count)
        for origin, count in zip(detector.origin, detector.samples.shape[::-1], strict=True)
    )
    half = SMALL.detector_width / 2
    beside = (np.abs(x)[None, :] > half) | (np.abs(y)[:, None] > half)
    escaped = np.sum(np.abs(detector.samples[beside]) ** 2) * detector.pitch**2 + 1 - fields.mla.power
    assert psf.sum() + escaped == pytest.approx(1, abs=1e-3)


def test_field_at_the_mla_is_the_geometric_image():
    fields = point_fields(SMALL, (0.3, 0.2, 240.0), wavelength=WAVELENGTH)
    intensity = np.abs(fields.mla.samples) ** 2
    row, column = np.unravel_index(intensity.argmax(), intensity.shape)
    assert fields.mla.origin[0] + column * fields.mla.pitch == pytest.approx(-0.15, abs=2e-3)
    assert fields.mla.origin[1] + row * fields.mla.pitch == pytest.approx(-0.10, abs=2e-3)


def test_pixel_integrals_of_a_gaussian():
    """Against the error function, for pixels that are no multiple of the sampling."""
    from scipy.special import erf

    pitch, pixel, width = (1.7e-3, 1.6e-3), 3.1e-3, 8e-3
    x, y = (-0.1 + step * np.arange(120) for step in pitch)
    samples = np.exp(-(y[:, None] ** 2 + (x[None, :] - 0.01) ** 2) / width**2).astype(np.float32)
    image = integrate_pixels(samples, pitch, (-0.1, -0.1), pixel, (-0.06, -0.05), (30, 40))
    across, down = -0.06 + pixel * np.arange(41), -0.05 + pixel * np.arange(31)
    along_x, along_y = (np.diff(erf(v / width)) * np.sqrt(np.pi) / 2 * width for v in (across - 0.01, down))
    assert error(image, along_y[:, None] * along_x[None, :]) < 1e-4


@pytest.mark.parametrize(
    "change, word",
    [
        ({"position": (0, 0)}, "position"),
        ({"position": (0, 0, 0)}, "position"),
        ({"position": (0, 0, -240)}, "position"),
        ({"position": (0, np.nan, 240)}, "position"),
        ({"position": ("a", 0, 240)}, "position"),
        ({"wavelength": -1}, "wavelength"),
        ({"wavelength": None}, "wavelength"),
        ({"method": "fast"}, "method"),
    ],
)
def test_mistakes(change, word):
    arguments = {"position": (0, 0, 240), "wavelength": 633} | change
    with pytest.raises(InputError, match=f"^{word}"):
        point_spread_function(SMALL, **arguments)


def test_light_that_never_reaches_the_mla_is_refused():
    with pytest.raises(InputError, match=r"^position.*too steeply"):
        point_spread_function(SMALL, (400.0, 0, 2.0), wavelength=633)


def test_a_field_too_large_for_memory_is_refused_with_the_estimate():
    huge = PlenopticCamera(detector_width=80, resolution=(40000, 40000))
    with pytest.raises(InputError, match=r"full field of position.*GiB"):
        point_spread_function(huge, (0, 0, 240), wavelength=633, method="full_field")


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_patch_against_full_field_on_whole_detectors(case):
    assert measure(case)["error"] < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("case", convergence(), ids=lambda case: case.name)
def test_full_field_converges(case):
    result = measure(case)
    assert result["finer"] < 0.01
    assert result["wider"] < 0.01
