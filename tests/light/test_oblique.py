"""Kernels for light that meets the microlenses obliquely, against an exact propagation and the laws of rays."""

import math

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.light.oblique import Oblique, phase, terms
from mitsuba_plenoptic.light.signed_colours import plan_of
from mitsuba_plenoptic.light.signed_draws import Draws, Pixels
from mitsuba_plenoptic.runtime.batches import Box

WAVELENGTH, STEP, COUNT = 633e-6, 0.0005, 1024
POWER, INDEX, ENLARGEMENT = 1 / 0.45, 1.3, 1.002


def exact_spot(
    camera: PlenopticCamera, lens: tuple[float, float], place: np.ndarray, centre: list[float]
) -> np.ndarray:
    """Propagate light from the middle of the pupil through a lens and its neighbours, without paraxial approximation.

    Returns the power per area of the lens, for unit irradiance, at positions `place` from a centre along both axes.
    """
    along = (np.arange(COUNT) - COUNT // 2 + 0.5) * STEP
    pitch, f2, z, b = camera.mla_pitch, camera.mla_focal_length, camera.detector_distance, camera.mla_distance
    m, n = np.meshgrid(along, along)
    u, v = ((each + pitch / 2) % pitch - pitch / 2 for each in (m, n))
    path = np.sqrt(b * b + (lens[0] + m) ** 2 + (lens[1] + n) ** 2) - (u * u + v * v) / (2 * f2)
    # Lenses farther away are dark, so that their light does not wrap around.
    lit = (np.abs(m) < 2.5 * pitch) & (np.abs(n) < 2.5 * pitch)
    spectrum = np.fft.fft2(np.where(lit, np.exp(2j * np.pi / WAVELENGTH * path), 0))
    frequency = np.fft.fftfreq(COUNT, STEP)
    fx, fy = np.meshgrid(frequency, frequency)
    spectrum *= np.exp(2j * np.pi * z * np.sqrt(1 / WAVELENGTH**2 - fx**2 - fy**2))
    waves = [np.exp(2j * np.pi * np.outer(place + c - along[0], frequency)) / COUNT for c in centre]
    return np.abs(waves[1] @ spectrum @ waves[0].T) ** 2 / pitch**2


def test_spots_of_oblique_light_are_those_of_an_exact_propagation():
    camera = PlenopticCamera(mla_focal_length=0.384, mla_distance=121.536)
    plan = plan_of(camera, 633.0, True, 633.0)
    lens = (61 * camera.mla_pitch, -45 * camera.mla_pitch)
    distance = math.hypot(camera.mla_distance, *lens)
    cosines = [c / distance for c in lens]
    slopes = [c / camera.mla_distance for c in lens]
    kernels = plan.kernels(0.001, plan.reach) / 0.001**2
    factors = plan.oblique.factors[:, 0] @ np.array(terms(*(s / plan.oblique.largest for s in cosines)))
    place = (np.arange(kernels.shape[1]) - kernels.shape[1] // 2) * 0.001
    enlargement = Draws(camera, [plan]).enlargements[0]
    exact = exact_spot(camera, lens, place, [enlargement * camera.detector_distance * t for t in slopes])
    middle = np.abs(place) < 0.03
    square = np.ix_(middle, middle)
    apart = camera.mla_pitch * (1 + camera.detector_distance / camera.mla_distance) / 0.001
    without, whole = (
        sum(shift(kernel, (i * apart, j * apart), order=5) for i in (-1, 0, 1) for j in (-1, 0, 1))
        for kernel in (kernels[0], kernels[0] + np.tensordot(factors, kernels[plan.functions.count :], 1))
    )
    # Frequencies at which lenses interfere that are farther apart than neighbours are removed.
    exact, without, whole = (gaussian_filter(image, 1.2) for image in (exact, without, whole))
    size = np.linalg.norm(exact[square])
    assert np.linalg.norm((whole - exact)[square]) / size < 0.006
    assert np.linalg.norm((without - exact)[square]) / size > 0.01


def test_the_phase_displaces_light_as_rays_of_direction_cosines_do():
    cosines, place, small = (0.11, -0.07), np.array([0.02, -0.03]), 1e-6

    def landing(m):
        # Behind the lens the path inclines by the cosines in the medium.
        behind = np.array(cosines) - m * POWER
        within = behind / INDEX
        return INDEX * within / np.sqrt(1 - within @ within)

    straight = landing(np.zeros(2))
    displaced = landing(place) - (ENLARGEMENT * straight - place * POWER)
    slope = [
        (
            phase(*(place + e), cosines, POWER, INDEX, ENLARGEMENT)
            - phase(*(place - e), cosines, POWER, INDEX, ENLARGEMENT)
        )
        / (2 * small)
        for e in small * np.eye(2)
    ]
    assert slope == pytest.approx(displaced, rel=1e-4)


def test_oblique_kernels_have_no_light_of_their_own():
    camera = PlenopticCamera(mla_lattice="hexagonal", mla_focal_length=(0.48, 0.512, 0.55))
    plan = plan_of(camera, 633.0, False, 633.0)
    assert plan.oblique.count > 0
    for kind in range(3):
        kernels = plan.kernels(camera.pixel_size, plan.reach, kind)
        assert abs(kernels[plan.functions.count :].sum((1, 2))).max() < 1e-4 * abs(kernels[0]).sum()


def test_fewer_kernels_leave_more_of_the_change():
    camera = PlenopticCamera()
    counts = [plan_of(camera, 633.0, fine, 633.0).oblique.count for fine in (False, True)]
    assert 0 < counts[0] < counts[1]


def test_there_are_at_most_twice_as_many_combinations_as_polynomials():
    fast = PlenopticCamera(mla_focal_length=0.128, detector_distance=0.128, aperture_radius=24.0)
    plan = plan_of(fast, 633.0, False, 633.0)
    assert plan.oblique.count == 2 * 15


def test_slopes_of_terms_are_their_differences():
    rng = np.random.default_rng(2)
    oblique, step = Oblique(0.2, *rng.normal(size=(2, 2, 3, 5))), 1e-3
    cosines = rng.uniform(-0.2, 0.2, (2, 7)).astype(np.float32)
    for found, along in zip(oblique.slopes(cosines), step * np.eye(2, dtype=np.float32), strict=True):
        before, after = (oblique.terms(cosines + side * along[:, None]) for side in (-1, 1))
        assert found == pytest.approx((after - before) / (2 * step), rel=1e-3, abs=1e-3)
    assert Oblique.nothing(3).terms(cosines).shape == Oblique.nothing(3).slopes(cosines).shape[1:] == (0, 7)


def test_pixels_know_the_direction_of_their_light():
    camera = PlenopticCamera(mla_rotation=20.0, mla_medium=1.4)
    draws = Draws(camera, [plan_of(camera, 633.0, False, 633.0)])
    (nearest,) = np.flatnonzero((draws.candidates == 0).all(axis=1)).tolist()
    pixels = Pixels(Box(40, 60, 8, 8), mi.UInt32(np.arange(64)), mi.UInt32(nearest))
    u, v = draws.cosines(pixels)
    aims = draws.aims(pixels)
    pupil = draws.seen(aims.middle, aims)
    across = [c.numpy() - P.numpy() for c, P in zip(aims.centre, pupil, strict=True)]
    x, y = (each / np.sqrt(camera.mla_distance**2 + across[0] ** 2 + across[1] ** 2) for each in across)
    turn = math.radians(20.0)
    assert u.numpy() == pytest.approx(x * math.cos(turn) + y * math.sin(turn), abs=1e-5)
    assert v.numpy() == pytest.approx(y * math.cos(turn) - x * math.sin(turn), abs=1e-5)
