"""Derivatives of captures: reverse against forward mode, and both against differences of the full field."""

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator, InputError, Job, PlenopticCamera, Spectrum


def test_the_opening_of_a_fast_stigmatic_lens_against_differences_of_captures():
    """A step of 2 % of the radius: for smaller ones the captures' own scatter counts, for larger ones the curvature."""
    camera = PlenopticCamera(
        focal_length=4.0, aperture_radius=4 / 3.6, mla_distance=4.04, mla_focal_length=0.004, mla_medium=1.5,
        mla_pitch=0.0028, detector_width=0.0224, resolution=(16, 16),
    )  # fmt: skip
    step = 0.02 * camera.aperture_radius
    operator, *sides = (
        CaptureOperator(camera.replace(aperture_radius=radius), [(0.1, -0.05, 404.0)], wavelength=550, accuracy=0)
        for radius in (camera.aperture_radius, camera.aperture_radius + step, camera.aperture_radius - step)
    )
    up, down = (side.forward([1.0]) for side in sides)
    assert error(operator.derivative([1.0], {"aperture_radius": 1.0}), (up - down) / (2 * step)) < 0.02


@pytest.mark.parametrize("amount", [0.05, 0.15])
def test_defocus_of_the_bare_main_lens_in_closed_form(amount):
    """On the axis of a lens of radius 1: [sin(u/4) / (u/4)]^2 (Born and Wolf, section 8.8), and its derivative."""
    camera = PlenopticCamera(
        aperture_radius=1.0,
        mla_distance=119.5,
        detector_distance=0.5,
        # One weak microlens about the axis.
        mla_focal_length=1e5,
        mla_pitch=2.0,
        mla_offset=(1.0, 1.0),
        detector_width=0.008,
        resolution=(4, 4),
    )
    point = [(0.0, 0.0, 240.0)]
    sharp = CaptureOperator(camera, point, wavelength=WAVELENGTH, accuracy=0).forward([1.0])[1:3, 1:3].mean()
    defocused = camera.replace(wavefront=(0.0, 0.0, 0.0, amount))
    operator = CaptureOperator(defocused, point, wavelength=WAVELENGTH, accuracy=0)
    # sqrt(3) (2 r^2 - 1) waves: u/4 is pi times the difference between rim and centre.
    growth = np.pi * 2 * np.sqrt(3)
    x = growth * amount
    value, slope = np.sinc(x / np.pi) ** 2, 2 * np.sinc(x / np.pi) * (np.cos(x) - np.sinc(x / np.pi)) / x * growth
    change = operator.derivative([1.0], {"wavefront": (0.0, 0.0, 0.0, 1.0)})[1:3, 1:3].mean()
    assert operator.forward([1.0])[1:3, 1:3].mean() / sharp == pytest.approx(value, rel=1e-3)
    assert change / sharp == pytest.approx(slope, rel=1e-3)


def test_several_directions_at_once_are_the_derivatives_by_each():
    """Directions that change the pupil, the microlenses, free space or the pixels alone, beside each other."""
    camera = small_camera(2, **HALF)
    operator = CaptureOperator(
        camera, scattered(2, distances=(112.0, 128.0), image=0.05), wavelength=WAVELENGTH, accuracy=0.1
    )
    weights = np.array([[1.0, 0.5], [0.0, -2.0]])
    directions = [{"focal_length": 1.0}, {"mla_pitch": 0.1}, {"detector_distance": 1.0}, {"detector_width": 1.0}]
    together = operator.jacobian(weights, directions)
    assert together.shape == (4, *camera.shape, 2)
    for found, changes in zip(together, directions, strict=True):
        np.testing.assert_allclose(
            found, operator.derivative(weights, changes), rtol=1e-5, atol=1e-7 * abs(found).max()
        )
    with pytest.raises(InputError, match=r"^directions: give at least one"):
        operator.jacobian(weights, [])


def test_directions_that_do_not_fit_into_memory_are_taken_in_turn(monkeypatch):
    """Of two wavelengths, each mixed into its channels."""
    camera = small_camera(2, **HALF)
    points = scattered(2, distances=(112.0, 128.0), image=0.05)
    operator = CaptureOperator(camera, points, spectrum=Spectrum.lines(550.0, WAVELENGTH), accuracy=0.1)
    weights = np.random.default_rng(1).uniform(0.5, 1, (2, 2))
    directions = [{"mla_pitch": 1e-3}, {"mla_offset": (1e-3, 0)}, {"focal_length": 0.1}]
    together = operator.jacobian(weights, directions)
    monkeypatch.setattr("mitsuba_plenoptic.points.derivatives.plan.MEMORY_LIMIT", 1.0)
    told = []
    found = operator.jacobian(weights, directions, job=Job(progress=lambda *done: told.append(done)))
    np.testing.assert_allclose(found, together, rtol=1e-5, atol=1e-6 * abs(together).max())
    assert told[-1] == (12, 12)
