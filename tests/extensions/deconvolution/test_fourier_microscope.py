"""Fourier microscopes deconvolved: against exact sums of point spreads, closed forms, and beads at known places."""

import math

import numpy as np
import pytest

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.design import lens_aperture, resolution_limit
from mitsuba_plenoptic.extensions.deconvolution.fourier import FourierResponse
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight

WAVELENGTH = 550.0
LENS = mp.Objective(20, 0.25, arrangement="fourier", fourier_focal_length=50)
SMALL = mp.PlenopticCamera(
    main_lens=LENS, mla_pitch=0.5, mla_focal_length=20.0, mla_offset=(0.25, 0.25), detector_width=1.5,
    resolution=(150, 150),
)  # fmt: skip
CAMERAS = {
    "coarse odd pixels": (SMALL.replace(resolution=(61, 61), detector_width=1.525), 3),
    "hexagonal, three focal lengths": (
        SMALL.replace(mla_lattice="hexagonal", mla_offset=(0.1, 0), mla_focal_length=(18.0, 20.0, 23.0)),
        1,
    ),
    "crop": (SMALL.replace(crop_offset=(40, 13), crop_size=(80, 101)), 1),
    "warped": (SMALL.replace(mla_warp=(0.02, 0.01, -0.02)), 1),
}


def response_of(camera, depths, oversample=1):
    return FourierResponse(camera, depths, wavelength=WAVELENGTH, oversample=oversample)


def bin_area(camera, oversample):
    """Of a bin in the native image."""
    return (camera.pixel_size / oversample * camera.mla_distance / camera.detector_distance) ** 2


def exact(camera, oversample, row, column, depth, parts=3):
    """Add exact spreads of even places in a bin, counted as they lie in a lens's picture."""
    columns, rows = (oversample * count for count in camera.bin_count)
    size = camera.bin_size(0) / oversample
    inner = (np.arange(parts) + 0.5) / parts
    x, y = np.meshgrid((column - columns / 2 + inner) * size, (row - rows / 2 + inner) * size)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth)])
    operator = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field")
    return operator.forward(
        np.full(len(points), radiance_weight(camera, main_lens(camera), bin_area(camera, oversample)) / len(points))
    )


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name != "crop")) for name in CAMERAS])
def test_every_bin_has_its_exact_spread(name):
    """Even at the border of the field, from spreads of other points than the one that the response knows."""
    camera, oversample = CAMERAS[name]
    response = response_of(camera, [0.02], oversample)
    rows, columns = response.shapes[0]
    place = (rows - 2, columns // 2 + 3)
    values = np.zeros((rows, columns), np.float32)
    values[place] = 2
    expected = 2 * exact(camera, oversample, *place, 0.02)
    assert np.linalg.norm(response.forward(values) - expected) < 0.01 * np.linalg.norm(expected)


@pytest.mark.slow
def test_light_of_deep_planes_is_kept_as_far_as_it_goes():
    """Parallax takes the pictures of the outer lenses far beyond the image of the stop."""
    camera = SMALL.replace(detector_width=5.0, resolution=(250, 250))
    response = response_of(camera, [-0.9])
    values = np.zeros(response.shapes[0], np.float32)
    values[12, 12] = 1
    expected = exact(camera, 1, 12, 12, -0.9, parts=2)
    found = response.forward(values)
    assert found.sum() == pytest.approx(expected.sum(), rel=2e-3)
    # Four places of the bin do not tell the fringes of several lenses' light evenly.
    assert np.linalg.norm(found - expected) < 0.06 * np.linalg.norm(expected)


def test_an_even_object_reads_1():
    """But for what isotropic light has less of in the middle of the stop than on the mean."""
    response = response_of(SMALL, [0.0])
    image = response.forward(np.ones(response.shapes[0], np.float32))
    alpha = LENS.half_angle
    mean = 2 * (1 - math.cos(alpha)) / math.sin(alpha) ** 2
    growth = LENS.magnification / LENS.last_focal_length
    x = (np.arange(64) + 0.5) / 64 * 0.5 - 0.25
    sine = np.hypot(x, x[:, None]) * growth
    assert image[65:85, 65:85].mean() == pytest.approx((1 / np.sqrt(1 - sine**2)).mean() / mean, rel=0.01)


def test_beads_come_back_to_their_planes_places_and_powers():
    depths, oversample = [-0.06, 0.0, 0.06], 2
    beads = np.array([[0.0083, -0.0041, -0.06], [-0.0112, 0.0067, 0.0], [0.0021, 0.0103, 0.06]])
    powers = np.array([1.0, 0.7, 1.2])
    image = mp.CaptureOperator(SMALL, beads, wavelength=WAVELENGTH, method="full_field").forward(powers)
    capture = mp.Capture(np.maximum(image, 0), SMALL, WAVELENGTH, "wave", {})
    found = mp.reconstruct(capture, depths, method="deconvolved", volume=True, oversample=oversample, iterations=60)
    assert found[0].facts["residual"] < 0.1
    for (X, Y, _), power, plane in zip(beads, powers, found, strict=True):
        assert plane.bin_size == pytest.approx(0.01 * 50 / (20 * 20) / oversample)
        # Pictures have +x to the left and +y up.
        y, x = ((size / 2 - np.arange(size) - 0.5) * plane.bin_size for size in plane.image.shape)
        light = np.nan_to_num(plane.image) * radiance_weight(SMALL, main_lens(SMALL), bin_area(SMALL, oversample))
        near = (np.abs(x - X) < 8 * plane.bin_size) & (np.abs(y - Y)[:, None] < 8 * plane.bin_size)
        mine = light * near
        assert mine.sum() == pytest.approx(power, rel=0.03)
        assert light[~near].sum() < 0.03 * power
        centre = [(mine.sum(0) @ x) / mine.sum(), (mine.sum(1) @ y) / mine.sum()]
        assert np.allclose(centre, [X, Y], atol=0.1 * plane.bin_size)


def spectrum_of_the_middle_lens(camera, depth, frequencies):
    """Contrast that lines in the object have in the picture of the lens on the axis, from the response itself."""
    response = response_of(camera, [depth])
    rows, columns = response.shapes[0]
    point = np.zeros((rows, columns), np.float32)
    point[rows // 2, columns // 2] = 1
    half = round(0.25 / camera.pixel_size)
    middle = np.array(camera.shape) // 2
    picture = response.forward(point)[middle[0] - half : middle[0] + half, middle[1] - half : middle[1] + half]
    x = (np.arange(2 * half) - half) * camera.bin_size(0)
    line = picture.sum(axis=0)
    phases = np.exp(-2j * np.pi * np.outer(frequencies, x))
    # Bins and pixels are even over their widths.
    return np.abs(phases @ line) / line.sum() / np.sinc(np.asarray(frequencies) * camera.bin_size(0)) ** 2


def test_the_limit_is_where_the_responses_own_spectrum_ends():
    camera = SMALL.replace(resolution=(450, 450))
    cutoff = 2 * lens_aperture(camera) / (WAVELENGTH * 1e-6)
    limit = resolution_limit(camera, 0.0, WAVELENGTH)
    assert limit.waves == pytest.approx(cutoff)
    assert not limit.in_focus
    # In focus the spectrum of a square lens falls evenly to zero; depth puts lines out before.
    parts = np.array([0.25, 0.5, 0.8, 0.95])
    assert np.allclose(spectrum_of_the_middle_lens(camera, 0.0, parts * cutoff), 1 - parts, atol=0.02)
    depth = 2 * WAVELENGTH * 1e-6 / lens_aperture(camera) ** 2
    gone = resolution_limit(camera, depth, WAVELENGTH).waves
    assert gone == pytest.approx(cutoff / 2 * (1 - math.sqrt(0.5)))
    contrast = spectrum_of_the_middle_lens(camera, depth, gone * np.linspace(0.5, 1.5, 101))
    assert np.linspace(0.5, 1.5, 101)[contrast.argmin()] == pytest.approx(1, abs=0.04)
    assert contrast.min() < 0.02 < 0.3 < contrast[0]
    assert resolution_limit(camera, depth).waves == pytest.approx(1 / (2 * lens_aperture(camera) * depth))
    assert resolution_limit(SMALL, 0.0, WAVELENGTH).pixels == pytest.approx(400.0)
