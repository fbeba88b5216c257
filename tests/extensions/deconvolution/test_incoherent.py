"""Incoherent reconstruction against sums of single point spreads, uniform scenes, and places of points."""

import functools

import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.units import radiance_weight

WAVELENGTH = 633.0
SMALL = mp.PlenopticCamera(detector_width=0.256, resolution=(128, 128))


def recorded(camera, image):
    return mp.Capture(image.astype(np.float32), camera, model="wave", wavelength=WAVELENGTH)


def refocused(camera, image, distance=250.0, **options):
    return mp.reconstruct(recorded(camera, image), distance, method="incoherent", **options).image


def test_bins_weigh_the_capture_with_the_spreads_of_their_points():
    """The light that a bin is divided by cancels between two captures."""
    camera, distance, across = SMALL.replace(wavefront=(0.0, 0.0, 0.0, 0.0, 0.1, 0.05)), 250.0, 8
    random = np.random.default_rng(0).random(camera.shape)
    even = np.ones(camera.shape)
    found = refocused(camera, random, distance) / refocused(camera, even, distance)
    count, pitch = camera.bin_count[0], camera.mla_pitch
    row, column = 1, 2
    inside = (np.arange(across) + 0.5) / across
    x, y = ((index + inside - count / 2) * pitch for index in (column, row))
    q = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = np.column_stack([-q * distance / camera.mla_distance, np.full(len(q), distance)])
    operator = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0)
    expected = operator.adjoint(random).sum() / operator.adjoint(even).sum()
    assert found[row, column] == pytest.approx(expected, rel=3e-4)


def test_it_is_linear_also_below_zero():
    random = np.random.default_rng(0).normal(size=(2, *SMALL.shape))
    parts = [refocused(SMALL, image) for image in (*random, random.sum(0))]
    assert np.allclose(parts[0] + parts[1], parts[2], atol=1e-5 * np.abs(parts[2]).max())


def test_channels_have_their_own_wavelengths():
    image = np.random.default_rng(0).random((*SMALL.shape, 3), np.float32)
    together = mp.reconstruct(mp.Capture(image, SMALL, (450.0, 633.0, 633.0), "wave"), 250, method="incoherent").image
    for channel, light in ((0, 450.0), (2, 633.0)):
        alone = mp.Capture(image[..., channel], SMALL, light, "wave")
        assert np.array_equal(together[..., channel], mp.reconstruct(alone, 250, method="incoherent").image)


@functools.cache
def of_glasses():
    """A camera with glasses, and four bins of radiance 1, filled with points, that it records at 480 nm."""
    glass = {"index": 1.5168, "abbe": 64.2}
    camera = SMALL.replace(resolution=(64, 64), glass=glass, mla_glass=glass)
    known = camera.at_wavelength(480.0)
    steps = np.ravel((np.arange(5) - 2) / 5 + np.array([[-0.5], [0.5]])) * 0.064
    x, y = (2 * each.ravel() for each in np.meshgrid(steps, steps))
    points = np.column_stack([x, y, np.full(len(x), 240.0)])
    weight = radiance_weight(known, main_lens(known, 480.0), 0.064**2) / 25
    return camera, mp.CaptureOperator(camera, points, wavelength=480.0).forward(np.full(len(x), weight))


@pytest.mark.parametrize(
    "method", [*(pytest.param(n, marks=pytest.mark.slow) for n in ("ray", "incoherent")), "deconvolved"]
)
def test_glasses_have_their_focal_lengths_at_the_wavelength(method):
    camera, image = of_glasses()
    known = camera.at_wavelength(480.0)
    found, expected = (
        mp.reconstruct(mp.Capture(image, each, 480.0, "wave"), 240.0, method=method).image for each in (camera, known)
    )
    np.testing.assert_array_equal(found, expected)
    if method == "deconvolved":
        assert found == pytest.approx(np.pad(np.ones((2, 2)), 1), abs=0.02)


@pytest.mark.parametrize("method", ["incoherent", "deconvolved"])
def test_lenses_may_differ_as_far_as_light_stays_within_pixels(method):
    """Focal lengths that differ by 1 % widen a point's image by a third of a pixel, those by 3 % by a whole one."""
    image = np.random.default_rng(0).random(SMALL.shape)
    near, far = (recorded(SMALL.replace(mla_jitter=(0.0, focal)), image) for focal in (0.01, 0.03))
    assert np.isfinite(mp.reconstruct(near, 250.0, method=method).image).any()
    refuses(r"mla_jitter = \(0.0, 0.03\)", mp.reconstruct, far, 250.0, method=method)


def test_a_microscope_sees_a_point_where_it_is():
    lens = mp.Objective(20, 0.25, arrangement="fourier", fourier_focal_length=50)
    camera = mp.PlenopticCamera(
        main_lens=lens, mla_pitch=0.8, mla_focal_length=20, detector_width=3.2, resolution=(128, 128)
    )
    size, depth = camera.bin_size(0), 0.02
    point = np.array([[3 * size, -2 * size, depth]])
    image = mp.CaptureOperator(camera, point, wavelength=WAVELENGTH, method="full_field").forward([1.0])
    result = refocused(camera, image, depth)
    row, column = np.unravel_index(np.nanargmax(result), result.shape)
    middle = (np.array(result.shape) - 1) / 2
    # The object is upright, and x is to the left.
    assert np.hypot(abs(column - middle[1]) - 3, abs(row - middle[0]) - 2) <= 1
