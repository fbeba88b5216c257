"""Light fields of Fourier microscopes: places, parallax and brightness of views against closed forms."""

import math

import numpy as np
import pytest

from mitsuba_plenoptic import Capture, CaptureOperator, Objective, PlenopticCamera, decode
from mitsuba_plenoptic.design import parallax
from mitsuba_plenoptic.views import camera_of

LENS = Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50)
ARRAY = {"mla_pitch": 0.5, "mla_focal_length": 20.0, "mla_offset": (0.25, 0.25)}
SQUARE = PlenopticCamera(main_lens=LENS, **ARRAY, detector_width=2.6, resolution=(260, 260))
HEXAGONAL = SQUARE.replace(mla_lattice="hexagonal", mla_offset=(0, 0))
TO_STOP = -200 / 50
POINTS = np.array([[0.01, -0.004, 0.02]])


def capture_of(camera, points=POINTS, power=1.0):
    image = CaptureOperator(camera, points, wavelength=550, method="full_field").forward(np.full(len(points), power))
    return Capture(np.maximum(image, 0), camera, 550.0, "wave", {})


@pytest.fixture(scope="module")
def square():
    return capture_of(SQUARE)


@pytest.fixture(scope="module")
def hexagonal():
    return capture_of(HEXAGONAL)


@pytest.fixture(scope="module", params=["square", "hexagonal"])
def lf(request):
    return decode(request.getfixturevalue(request.param))


def test_each_view_sees_the_object_from_its_lenss_direction(lf):
    """The centre of light of each view that is not cut by the stop, against the parallax of its lens."""
    camera, (X, Y, depth) = camera_of(lf), POINTS[0]
    scale = LENS.view_scale(camera.detector_distance)
    lit = np.argwhere(lf.weight.values[:, :, 24 if camera == SQUARE else 21, 24] > 0.9)
    assert len(lit) >= 13
    for row, column in lit:
        picture = lf.isel(v=row, u=column)
        values = np.where(picture.values > 0.05 * float(picture.max()), picture.values, 0)
        x, y = (float((values * axis).sum() / values.sum()) for axis in (picture.s.values, picture.t.values[:, None]))
        c = np.array([float(lf.u[column]), float(lf.v[row])]) / TO_STOP
        distance = float(np.hypot(*c))
        shift = parallax(camera, distance) * depth / scale * (c / distance) if distance else np.zeros(2)
        assert np.allclose([x, y], [X + shift[0], Y + shift[1]], atol=0.35 * camera.bin_size(0))


def test_even_lenses_have_even_views(lf):
    """Pictures are divided by what a lens sees of the stop: all hold the same light."""
    sums = lf.sum(("s", "t")).values[lf.weight.values.max(axis=(2, 3)) > 0.9]
    assert np.ptp(sums) < 0.03 * sums.mean()
    # All of a pixel's lens is lit by a bin of radiance r with what radiance_weight says of it.
    lenses = math.pi * (LENS.blur_diameter(0) / 2) ** 2 / camera_of(lf).lattice.lens_area
    assert sums.mean() == pytest.approx(1 / lenses, rel=0.03)


def test_a_hexagonal_array_leaves_places_without_a_view(hexagonal):
    lf = decode(hexagonal)
    there = lf.weight.values.max(axis=(2, 3)) > 0
    assert not (there[:, :-1] & there[:, 1:]).any()
    assert np.allclose(np.diff(lf.u), 0.25 * TO_STOP)
    assert np.allclose(np.diff(lf.v), 0.25 * math.sqrt(3) * TO_STOP)
    assert not lf.values[~there].any()


def test_views_are_upright_and_crops_lose_their_pixels(square):
    whole = decode(square)
    part = decode(capture_of(SQUARE.replace(crop_offset=(70, 90), crop_size=(120, 100))))
    assert (np.diff(whole.s) < 0).all() and (np.diff(whole.u) < 0).all()
    assert part.shape == whole.shape
    seen = part.weight.values > 0.9
    assert 0.1 < seen.mean() < 0.5
    assert np.abs(part.values - whole.values)[seen].max() < 1e-3 * float(whole.max())


def test_a_white_capture_and_colours(square):
    white = np.full(SQUARE.shape, 0.5, np.float32)
    colour = decode(np.repeat(square.image[..., None], 3, axis=2), camera=SQUARE, white=white)
    np.testing.assert_allclose(decode(square, white=6 * white).values, colour.values[..., 0], rtol=1e-5)
    plain = decode(square)
    assert colour.dims == ("v", "u", "t", "s", "c")
    lit = plain.weight.values > 0.9
    # This white knows no stop; its radiance is found by the computed one near the axis.
    expected = plain.values * plain.white.values / float(plain.white.max(("t", "s"))[1:4, 1:4].median())
    assert np.allclose(colour.values[..., 0][lit], expected[lit], atol=1e-3 * float(plain.max()))
