"""Signed rays against closed forms of apertures, and against exact sums of point spreads."""

import math

import numpy as np
import phase_space_accuracy
import pytest
from scipy.special import j1

from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.optics.phase_space import PhaseSpace

DISCS = PlenopticCamera(mla_aperture="circle", mla_fill=0.5)


def test_the_kernels_of_a_plan_keep_energy():
    plan = PhaseSpace(PlenopticCamera(mla_lattice="hexagonal", mla_rotation=7.0), 633.0, degree=1)
    sums = plan.kernels(0.001, 0.16).sum((1, 2))
    assert sums == pytest.approx([1, 0, 0], abs=3e-3)


def test_the_first_transfer_function_is_that_of_a_disc():
    # Goodman, "Introduction to Fourier Optics", section 6.3.
    lags, transfer = PhaseSpace(DISCS, 633.0, degree=0)._transfer
    diameter, middle = 0.032, len(lags) // 2
    # Longer lags join neighbouring lenses.
    row = np.abs(lags) < diameter
    s = np.abs(lags[row]) / diameter
    expected = 2 / math.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))
    assert transfer[0, middle, row].real == pytest.approx(expected, abs=0.006)
    assert np.abs(transfer[0, middle, row].imag).max() < 1e-3


def test_the_mean_over_the_pupil_is_airys_pattern():
    # How much of the light of a point in focus falls into a lens, over its place: the lens convolved with the pattern.
    plan = PhaseSpace(PlenopticCamera(), 633.0, degree=0, window=5, samples=32)
    radial, angular = plan.shape[:2]
    t = 1 - np.arange(radial) / (radial - 1)
    weights = ((1 - t * t) * t)[:, None] * np.where(np.arange(angular) % (angular - 1), 1, 0.5)
    mean = np.tensordot(weights, plan.table[..., 0], 2) / weights.sum()
    # The other quarters of the pupil are mirror images.
    mean = (mean + mean[::-1] + mean[:, ::-1] + mean[::-1, ::-1]) / 4
    step, scale = 0.064 / 32, math.pi * 10 / (633e-6 * 120)
    axis = (np.arange(-480, 480) + 0.5) * (step / 2)
    v = scale * np.hypot(axis, axis[:, None])
    airy = (scale * j1(v) / v) ** 2 / math.pi
    lens = np.abs(axis) < 0.032
    for place in (0.0, 0.028, 0.036):
        inside = np.abs(axis + place) < 0.032
        expected = airy[np.ix_(lens, inside)].sum() * (step / 2) ** 2
        column = 79 + round(place / step)
        assert mean[79:81, column : column + 2].mean() == pytest.approx(expected, abs=0.01)


def test_every_ray_keeps_its_energy():
    plan = PhaseSpace(PlenopticCamera(), 633.0, degree=1, window=3, samples=16, radial=5, angular=3)
    assert plan.table[..., 0].mean((2, 3)) == pytest.approx(1 / 9, rel=1e-3)
    assert plan.table[..., 1:].mean((2, 3)) == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("blur", [0.0, pytest.param(0.5, marks=pytest.mark.slow)])
def test_a_wall_is_that_of_point_spreads(blur):
    camera = PlenopticCamera()
    wall = phase_space_accuracy.Wall(camera, blur, 1, 8, 0.0)
    view = phase_space_accuracy.around(camera, wall, 1)
    exact = phase_space_accuracy.reference(view, wall)
    plan = PhaseSpace(camera, 633.0, degree=2, window=5, samples=16, radial=8, angular=4)
    signed, rays = phase_space_accuracy.capture(plan, view, wall, 48)
    assert phase_space_accuracy.error(signed, exact) < 0.06
    assert phase_space_accuracy.error(rays, exact) > 0.15
    assert signed.sum() / exact.sum() == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize(
    "name, value",
    [("detector_distance", 0.6), ("wavefront", (0.0, 0.1)), ("main_lens", "lfm")],
)
def test_cameras_that_it_does_not_know_are_refused(name, value):
    camera = PlenopticCamera.preset(value) if name == "main_lens" else PlenopticCamera(**{name: value})
    with pytest.raises(InputError, match=rf"{name} = .*: for signed rays it must be"):
        PhaseSpace(camera, 633.0)


def test_microlenses_of_several_focal_lengths_are_refused():
    with pytest.raises(InputError, match=r"mla_focal_length = .*: for signed rays it must be one for all"):
        PhaseSpace(PlenopticCamera.preset("raytrix"), 633.0)
