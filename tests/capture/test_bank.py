"""The kernel bank: its parts against plain formulas, its sums against exact ones."""

import pickle

import numpy as np
import pytest
import scipy
from mitsuba_plenoptic.capture.bank import Convolution, LensBank, lens_bank, near_weight
from mitsuba_plenoptic.capture.bank.radial import RadialFields
from threadpoolctl import threadpool_info, threadpool_limits
from wave_cases import WAVELENGTH, capture, error, small_camera

from mitsuba_plenoptic.capture.operator import CaptureOperator
from mitsuba_plenoptic.capture.point_spread import point_fields
from mitsuba_plenoptic.optics.main_lens import main_lens
from mitsuba_plenoptic.runtime.backend import array_module
from mitsuba_plenoptic.runtime.batches import Box, Part, Threads, add
from mitsuba_plenoptic.runtime.jobs import Job

CAMERAS = {
    "square": {},
    "discs, turned": {
        "mla_lattice": "hexagonal", "mla_rotation": 7.0, "mla_offset": (0.01, -0.02), "mla_aperture": "circle",
        "mla_fill": 0.9,
    },
    "three focal lengths": {"mla_lattice": "hexagonal", "mla_focal_length": (0.44, 0.512, 0.6)},
}  # fmt: skip

NEAR, FAR = 222.0, 262.0
"""Distances before and beyond focus of points that are blurred over 6.3 and 6.6 lenses."""


def bank_of(camera, *distances, accuracy=0.03):
    vergences = [float(main_lens(camera).vergence(g)) for g in distances]
    return LensBank.learn(camera, WAVELENGTH, accuracy, (min(vergences), max(vergences)))


def test_banks_are_learnt_on_one_thread(monkeypatch):
    # NumPy's and SciPy's libraries are both there before one counts their threads.
    scipy.linalg.norm(np.ones(2))
    # Products of matrices have other last bits on two threads, for some sizes: workers have one, other processes more.
    seen = []

    class Watched(lens_bank.Learner):
        def kernels(self, error):
            seen.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
            return super().kernels(error)

    monkeypatch.setattr(lens_bank, "Learner", Watched)
    lens_bank._learn.cache_clear()
    with threadpool_limits(limits=2, user_api="blas"):
        bank_of(small_camera(), NEAR, accuracy=0.1)
    assert seen and set(seen) == {1}


def wall(camera, distance, lenses=2, per_lens=8):
    """Return the points of a wall on the axis, even in every lens."""
    place = ((np.arange(lenses * per_lens) + 0.5) / per_lens - lenses / 2) * camera.mla_pitch
    x, y = (part.ravel() * -distance / camera.mla_distance for part in np.meshgrid(place, place))
    return np.column_stack([x, y, np.full(len(x), distance)])


def test_radial_field_is_that_of_the_full_field():
    camera, distance = small_camera(12), FAR
    field = RadialFields.of(camera, WAVELENGTH, np.array([distance]), 0.38)
    mla = point_fields(camera, (0.0, 0.0, distance), wavelength=WAVELENGTH).mla
    x = mla.origin[0] + np.arange(mla.samples.shape[1]) * mla.pitch
    row = round(-mla.origin[1] / mla.pitch)
    r = np.hypot(x, mla.origin[1] + row * mla.pitch)
    near = r < 0.35
    found = np.interp(r[near], np.arange(field.samples.shape[1]) * field.step, np.abs(field.samples[0]) ** 2)
    exact = np.abs(mla.samples[row, near]) ** 2
    assert error(found * (found @ exact) / (found @ found), exact) < 0.003


@pytest.mark.parametrize("rotation", [0.0, 7.0])
def test_kernels_are_brought_to_the_pixels_grid_as_they_are(rotation):
    """As a linear map, so that kernels whose sum is near zero are not blown up, and with their power."""
    place = np.arange(96) - 48
    wide, narrow = (np.exp(-(place**2 + place[:, None] ** 2) / (2 * size**2)).astype(np.float32) for size in (8, 6))
    narrow *= wide.sum() / narrow.sum() * 0.9999
    first, second, difference = lens_bank._on_grid(np.stack([wide, narrow, wide - narrow]), 1e-3, 1.7e-3, rotation)
    assert error(difference, first - second) < 1e-3
    assert first.sum() == pytest.approx(wide.sum(), rel=1e-3)


@pytest.mark.parametrize("distance", [NEAR, FAR])
def test_light_of_a_point_adds_up_to_one(distance):
    camera = small_camera()
    bank = bank_of(camera, distance)
    vergence = main_lens(camera).vergence(distance)
    radius = camera.aperture_radius
    place = (np.arange(400) / 200 - 1) * (radius + bank.reach(vergence))
    x, y = (part.ravel() for part in np.meshgrid(place, place))
    types = array_module()
    found = bank.coefficients(types.Float(x), types.Float(y), types.Float(np.full(len(x), vergence)))
    power = np.array(found).T @ bank.kernels.sum((1, 2))
    assert np.sum(power) * (place[1] - place[0]) ** 2 / (np.pi * radius**2) == pytest.approx(1, abs=0.008)
    middle = np.hypot(x, y) < radius / 3
    assert np.mean(power[middle]) == pytest.approx(1, abs=0.03)
    assert not power[np.hypot(x, y) > radius + bank.reach(vergence)].any()


def test_coefficients_that_are_not_wanted_are_zero():
    camera = small_camera()
    bank, types = bank_of(camera, FAR), array_module()
    place = types.Float(1.0, 1.0), types.Float(2.0, 2.0), types.Float(main_lens(camera).vergence(FAR))
    some, every = bank.coefficients(*place, types.Bool(True, False)), bank.coefficients(*place)
    assert bank.rank > 4 and all(part[0] != 0 for part in every)
    assert [list(part) for part in some] == [[part[0], 0] for part in every]


def test_bank_is_made_once_whatever_the_window():
    camera = small_camera(8)
    assert bank_of(camera, FAR) is bank_of(camera.replace(crop_offset=(3, 4), crop_size=(20, 30)), FAR)
    assert pickle.loads(pickle.dumps(bank_of(camera, FAR))) is bank_of(camera, FAR)


def test_convolution_in_tiles_its_bands_and_its_adjoint():
    camera = small_camera(crop_offset=(2, 3), crop_size=(200, 61)).replace(resolution=(512, 512))
    generator = np.random.default_rng(0)
    kernels = generator.random((2, 9, 9), dtype=np.float32)
    bank = LensBank(kernels, camera.pixel_size / 2, camera.detector_distance, None, ())
    plain, shared = Convolution(camera, bank.kernels, bank.pitch, 0), Convolution(camera, bank.kernels, bank.pitch, 2)
    images = generator.random((2, plain.box.rows, plain.box.columns), dtype=np.float32)
    m = -plain.box.left + 4
    whole = sum(scipy.signal.fftconvolve(image, kernel, "same") for image, kernel in zip(images, kernels, strict=True))
    fine = whole[m:-m, m:-m]
    expected = fine.reshape(61, 2, 200, 2).sum((1, 3))
    assert plain.forward(images).shape == (61, 200)
    np.testing.assert_allclose(plain.forward(images), expected, rtol=1e-5)
    bands, box = Convolution(camera, bank.kernels, bank.pitch, 0, size=(25, plain.box.columns)), plain.box
    total = np.zeros((1, 61, 200), np.float32)
    for top in range(0, box.rows, 25):
        rows = Box(box.left, box.top + top, box.columns, min(25, box.rows - top))
        reached = bands.reached(rows)
        part = bands.forward(images[:, top : top + rows.rows], rows, reached)
        assert part.shape == (reached.rows, 200) and reached.rows < 40
        add(Part(reached, part[None]), Box(0, 0, 200, 61), total)
    np.testing.assert_allclose(total[0], expected, rtol=1e-5)
    pixels = generator.random((61, 200), dtype=np.float32)
    back = sum(np.vdot(image.astype(float), part) for image, part in zip(images, shared.adjoint(pixels), strict=True))
    assert np.vdot(shared.forward(images).astype(float), pixels) == pytest.approx(back, rel=1e-5)
    # A part of the samples, and some beyond those that pixels feel.
    part = Box(box.left + 100, box.top - 7, box.columns - 60, 40)
    image = next(bands.adjoint(pixels, part))
    assert image.shape == (40, part.columns)
    np.testing.assert_allclose(image[:7], 0, atol=1e-4)
    np.testing.assert_allclose(image[7:, :-40], next(plain.adjoint(pixels))[:33, 100:], atol=1e-4)


def test_near_weight_goes_smoothly_from_focus():
    camera = small_camera()
    blur = np.linspace(0, 40, 400)
    vergence = (1 - blur * camera.mla_pitch / camera.aperture_diameter) / camera.mla_distance
    weight = near_weight(camera, vergence, 0.01)
    assert weight[0] == 1 and weight[-1] == 0
    assert (np.diff(weight) <= 0).all() and np.abs(np.diff(weight)).max() < 0.21
    assert (near_weight(camera, vergence, 0.0) == 1).all()


# Quicker ones are those of a scene in test_bank_capture, and of sums behind a real lens in test_real_lens_bank.
@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_walls_are_those_of_exact_spreads(name):
    camera = small_camera(12, **CAMERAS[name])
    points = wall(camera, FAR, per_lens=6)
    weights = np.ones(len(points))
    exact = capture(camera, points, weights, accuracy=0)
    image = capture(camera, points, weights, method="bank")
    assert error(image, exact) < 0.02
    # gaps and steps of the phase scatter light beyond what the exact spreads keep; the bank gives it back
    joined = name == "square"
    assert image.sum(dtype=float) == pytest.approx(exact.sum(dtype=float), rel=0.005 if joined else 0.012)


@pytest.mark.slow
def test_half_open_pupils():
    camera = small_camera(14)
    points = wall(camera, NEAR, per_lens=6)
    open_cells = np.zeros((len(points), 8, 8))
    open_cells[:, :, 4:] = 1
    weights = np.ones(len(points))
    exact = capture(camera, points, weights, accuracy=0, pupil_weights=open_cells)
    image = capture(camera, points, weights, method="bank", pupil_weights=open_cells)
    assert image.sum(dtype=float) == pytest.approx(exact.sum(dtype=float), rel=0.01)
    # the edge of what is open does not diffract here
    assert error(image, exact) < 0.12


@pytest.mark.slow
def test_near_and_far_points_together():
    camera = small_camera(10)
    points = np.concatenate([wall(camera, distance, per_lens=4) for distance in (240.0, 259.0, FAR)])
    weights = np.linspace(0, 1, len(points))
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="bank", accuracy=0.03)
    image = operator.forward(weights)
    assert error(image, capture(camera, points, weights, accuracy=0)) < 0.04
    np.testing.assert_array_equal(operator.forward(weights, job=Job(batch_map=Threads(1))), image)
    pixels = np.random.default_rng(1).random(camera.shape).astype(np.float32)
    assert operator.adjoint(pixels) @ weights == pytest.approx(np.vdot(image.astype(float), pixels), rel=1e-5)
    cost = operator.estimate()
    assert cost.seconds > 0 and cost.memory > 0
