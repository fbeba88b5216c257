"""Kernels for light that meets the microlenses obliquely, against an exact propagation and the laws of rays."""

import math

import mitsuba as mi
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.runtime.batches import Box
from mitsuba_plenoptic.waves.oblique import Oblique, terms
from mitsuba_plenoptic.waves.ray_sampler import LensSampler, Pixels
from mitsuba_plenoptic.waves.scheme import plan_of

WAVELENGTH, STEP, COUNT = 633e-6, 0.0005, 1024


def exact_spot(
    camera: PlenopticCamera, lens: tuple[float, float], place: np.ndarray, centre: list[float]
) -> np.ndarray:
    """Return a lens's power per area at `place` from a centre, for unit irradiance, without paraxial approximation."""
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
    bent = terms(*(s / plan.oblique.largest for s in cosines), plan.oblique.degree)
    factors = plan.oblique.factors[:, 0] @ np.array(bent)
    place = (np.arange(kernels.shape[1]) - kernels.shape[1] // 2) * 0.001
    enlargement = LensSampler(camera, [plan]).enlargements[0]
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
    assert np.linalg.norm((without - exact)[square]) / size > 0.009


def fast_lens(medium: float) -> PlenopticCamera:
    return PlenopticCamera(
        focal_length=10.0, aperture_radius=2.5, mla_distance=12.0, mla_pitch=0.04, mla_focal_length=0.0955 * medium,
        mla_medium=medium, detector_width=0.4, resolution=(100, 100),
    )  # fmt: skip


@pytest.mark.parametrize(("cosines", "medium"), [((0.0, 0.0), 1.0), ((0.14, 0.14), 1.0), ((0.14, 0.14), 1.4)])
def test_spots_of_fast_lenses_are_those_of_an_exact_propagation(cosines, medium):
    camera, count, step = fast_lens(medium).replace(mla_fill=0.96), 1024, 0.04 * 0.96 / 128
    plan = plan_of(camera, 633.0, False, 633.0)
    kind, b = plan.waves.kinds[0], camera.pupil_distance
    along = (np.arange(count) - count // 2 + 0.5) * step
    x, y = np.meshgrid(along, along)
    tilt = np.array(cosines) / math.sqrt(1 - math.hypot(*cosines) ** 2)
    path = np.sqrt(b * b + (x + b * tilt[0]) ** 2 + (y + b * tilt[1]) ** 2) - (x * x + y * y) / (2 * kind.focal_length)
    inside = np.maximum(abs(x), abs(y)) < 0.0192
    frequency = np.fft.fftfreq(count, step)
    fx, fy = np.meshgrid(frequency, frequency)
    across = np.sqrt(np.maximum((medium / WAVELENGTH) ** 2 - fx**2 - fy**2, 0))
    spectrum = np.fft.fft2(np.where(inside, np.exp(2j * np.pi / WAVELENGTH * path), 0))
    exact = np.abs(np.fft.ifft2(spectrum * np.exp(2j * np.pi * medium * kind.distance * across))) ** 2 / inside.sum()
    # The lens alone, at the same places by a plain sum over its points.
    reach = (np.arange(160) + 0.5) / 160 * 0.04 - 0.02
    _, field, share = plan.waves.transmission(tuple(np.meshgrid(reach, reach)), kind, cosines)
    own = np.where(share > 0, field, 0)
    behind = np.array(cosines) / math.sqrt(1 - (math.hypot(*cosines) / medium) ** 2)
    landing = kind.distance * LensSampler(camera, [plan]).enlargements[0] * behind
    near = [np.abs(along - p) < 0.012 for p in landing]
    waves = [
        np.exp(-2j * np.pi * np.outer(along[n] - p, reach) / (WAVELENGTH * kind.distance))
        for n, p in zip(near, landing, strict=True)
    ]
    found = np.abs(waves[1] @ own @ waves[0].T) ** 2
    pixels = [gaussian_filter(each, 4) for each in (found, exact[np.ix_(near[1], near[0])])]
    pixels = [each / each.sum() for each in pixels]
    assert np.linalg.norm(pixels[0] - pixels[1]) / np.linalg.norm(pixels[1]) < 0.006


def test_pixels_know_the_direction_of_their_light():
    camera = PlenopticCamera(mla_rotation=20.0, mla_medium=1.4)
    sampler = LensSampler(camera, [plan_of(camera, 633.0, False, 633.0)])
    pixels = Pixels(Box(40, 60, 8, 8), mi.UInt32(np.arange(64)), mi.UInt32(sampler.choice.lenses.index((0, 0))))
    u, v = sampler.cosines(pixels)
    lenses = sampler.lenses(pixels)
    pupil = sampler.seen(lenses.position, lenses)
    across = [c.numpy() - P.numpy() for c, P in zip(lenses.centre, pupil, strict=True)]
    x, y = (each / np.sqrt(camera.mla_distance**2 + across[0] ** 2 + across[1] ** 2) for each in across)
    turn = math.radians(20.0)
    assert u.numpy() == pytest.approx(x * math.cos(turn) + y * math.sin(turn), abs=1e-5)
    assert v.numpy() == pytest.approx(y * math.cos(turn) - x * math.sin(turn), abs=1e-5)


def test_slopes_of_terms_are_their_differences():
    degree, rng = 4, np.random.default_rng(2)
    count, step = degree * (degree + 3) // 2, 1e-3
    basis = np.eye(1 + count) + np.tril(rng.uniform(-0.1, 0.1, (1 + count, 1 + count)), -1)
    oblique = Oblique(0.2, *rng.normal(size=(2, 2, 3, count)), basis)
    assert oblique.degree == degree == plan_of(fast_lens(1.0), 633.0, False, 633.0).oblique.degree
    cosines = rng.uniform(-0.2, 0.2, (2, 7)).astype(np.float32)
    for found, along in zip(oblique.slopes(cosines), step * np.eye(2, dtype=np.float32), strict=True):
        before, after = (oblique.terms(cosines + side * along[:, None]) for side in (-1, 1))
        assert found == pytest.approx((after - before) / (2 * step), rel=1e-3, abs=1e-3)
    assert Oblique.nothing(3).terms(cosines).shape == Oblique.nothing(3).slopes(cosines).shape[1:] == (0, 7)
