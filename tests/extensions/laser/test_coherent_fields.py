"""Coherent fields of many points against direct sums, single fields and captures; the adjoint; the transforms."""

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.extensions.laser import pupil_sums
from mitsuba_plenoptic.extensions.laser.nonuniform import PlaneWaves

CAMERA = small_camera(4, **HALF)
FAST = PlenopticCamera(
    focal_length=1, aperture_radius=0.25, focus_distance=6.4, mla_pitch=0.002, mla_focal_length=0.0044,
    detector_width=0.032, resolution=(160, 160),
)  # fmt: skip
"""A camera of f/2, of a fiftieth of the size of common ones."""


DEEP = scattered(6, distances=(100.0, 140.0))
"""Points in several layers."""
ALL_OVER = scattered(12, distances=(6.3, 6.5), image=0.016) * [120 / FAST.mla_distance, 120 / FAST.mla_distance, 1]
"""Points all over the fast camera's field."""


def amplitudes(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=count) + 1j * rng.normal(size=count)


def direct_pupil(camera, points, given, x, y):
    """Sum of point sources behind a thin lens with aberrations, each of unit power, in double precision."""
    k, f1, radius = 2 * np.pi / (WAVELENGTH * 1e-6), camera.focal_length, camera.aperture_radius
    rng = np.random.default_rng(5)
    r, angle = radius * np.sqrt(rng.random(20000)), 2 * np.pi * rng.random(20000)
    total = np.zeros(np.shape(x), complex)
    for (X, Y, g), amplitude in zip(points, given, strict=True):
        away = (r * np.cos(angle) - X) ** 2 + (r * np.sin(angle) - Y) ** 2 + g**2
        power = np.pi * radius**2 * np.mean((g / away) ** 2)
        square = (x - X) ** 2 + (y - Y) ** 2 + g**2
        if camera.lens_model == "parabolic":
            path = np.sign(g) * (np.sqrt(square) - np.sqrt(X**2 + Y**2 + g**2)) - (x**2 + y**2) / (2 * f1)
        else:
            # A sphere about the image.
            d = 1 / (1 / f1 - 1 / g)
            left, up = -X * d / g, -Y * d / g
            path = np.sign(d) * (np.sqrt(left**2 + up**2 + d**2) - np.sqrt((x - left) ** 2 + (y - up) ** 2 + d**2))
        total += amplitude * abs(g) / square / np.sqrt(power) * np.exp(1j * k * path)
    if any(camera.wavefront):
        # Noll 4, defocus, over the unit pupil.
        waves = camera.wavefront[3] * np.sqrt(3) * (2 * (x**2 + y**2) / radius**2 - 1)
        total = total * np.exp(2j * np.pi * waves * 633 / WAVELENGTH)
    return total


def error_on_pupil(points, given, camera=CAMERA, **options):
    """Return the error of the field on the pupil against the direct sum of the points that have an amplitude."""
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, method="full_field", **options)
    field, lit = operator.field(given, plane="pupil"), np.flatnonzero(given)
    x, y = np.meshgrid(*(start + np.arange(field.samples.shape[0]) * field.pitch for start in field.origin))
    some = np.flatnonzero(np.hypot(x, y) < camera.aperture_radius - 2 * field.pitch)[::97]
    exact = direct_pupil(camera, np.array(points)[lit], np.array(given)[lit], x.ravel()[some], y.ravel()[some])
    # Nothing outside the pupil.
    assert np.abs(field.samples[np.hypot(x, y) > camera.aperture_radius + 2 * field.pitch]).max() == 0
    return error(field.samples.ravel()[some], exact)


@pytest.mark.parametrize("model", ["ideal", "parabolic"])
@pytest.mark.parametrize(("camera", "points"), [(CAMERA.replace(wavefront=(0, 0, 0, 0.3)), DEEP), (FAST, ALL_OVER)])
def test_pupil_against_direct_sums(camera, points, model):
    assert error_on_pupil(points, amplitudes(len(points)), camera.replace(lens_model=model)) < 2e-5


@pytest.mark.slow
def test_a_point_far_from_thousands_of_others(monkeypatch):
    # The products of a layer are found from a part of its points, to which this one does not belong.
    monkeypatch.setattr(pupil_sums, "_BASIS", 200)
    monkeypatch.setattr(pupil_sums, "_TOGETHER", 300 * 36)
    points = np.column_stack([np.random.default_rng(0).uniform(-0.01, 0.01, (1000, 2)), np.full(1000, 120.0)])
    points[501] = 2, 2, 120
    for lit in ([501], [3, 990], [3, 501, 990]):
        given = np.zeros(1000, complex)
        given[lit] = amplitudes(len(lit))
        assert error_on_pupil(points, given, CAMERA.replace(lens_model="parabolic")) < 2e-5


def test_points_of_opposite_distances_are_one_layer():
    with np.errstate(all="raise"):
        assert error_on_pupil([(0, 0, 1e6), (10, 0, -1e6)], [1, 1j], virtual=True) < 2e-5


def test_the_light_of_a_layer_may_leave_an_ideal_lens_collimated():
    points = np.array([(0, 0, 98.5), (1, 0, 99.5)])
    with np.errstate(all="raise"):
        assert error_on_pupil(points, [1, 1j], CAMERA.replace(focal_length=1 / np.mean(1 / points[:, 2]))) < 2e-5


def test_plane_waves():
    frequencies, given = np.random.default_rng(0).uniform(-0.45, 0.2, (50, 2)), amplitudes(50).astype(np.complex64)
    waves, order = PlaneWaves(frequencies, 37), np.arange(37) - 18
    exact = np.exp(2j * np.pi * (order[:, None, None] * frequencies[:, 1] + order[None, :, None] * frequencies[:, 0]))
    assert error(np.concatenate([block for _, block in waves.forward(given)]), exact @ given) < 1e-6
    samples = amplitudes(37 * 37).reshape(37, 37).astype(np.complex64)
    assert error(waves.adjoint(iter([(slice(0, 37), samples)])), np.einsum("yxj,yx->j", exact.conj(), samples)) < 1e-6
