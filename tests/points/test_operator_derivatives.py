"""Derivatives of captures: reverse against forward mode, and both against differences of the full field."""

import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, error, in_every_lens, scattered, small_camera

from mitsuba_plenoptic import CaptureOperator, Job, PlenopticCamera, Spectrum
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.lenses.fitted_lens import lens_change
from mitsuba_plenoptic.points import accuracy
from mitsuba_plenoptic.points.derivatives import DIFFERENTIABLE, plan


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


def test_defocus_of_the_bare_main_lens_in_closed_form():
    """On the axis of a lens of radius 1: [sin(u/4) / (u/4)]^2 (Born and Wolf, section 8.8), and its derivative."""
    # One weak microlens about the axis.
    camera = PlenopticCamera(
        aperture_radius=1.0, mla_distance=119.5, detector_distance=0.5, mla_focal_length=1e5, mla_pitch=2.0,
        mla_offset=(1.0, 1.0), detector_width=0.008, resolution=(4, 4),
    )  # fmt: skip
    point, amount = [(0.0, 0.0, 240.0)], 0.15
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


MOVING = {"mla_pitch": (1.0, -0.5), "mla_distance": 1.0, "mla_rotation": 1.0, "detector_distance": 1.0}
"""Numbers by which copies change otherwise than their spreads."""


@pytest.fixture
def many(monkeypatch):
    """Let a few points count as many."""
    monkeypatch.setattr(accuracy, "_FEW", 8)


def operator_of(lattice):
    camera = small_camera(2, **(HALF | lattice))
    points = in_every_lens(camera, 4, 118.0)
    return CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0.1), np.linspace(0.3, 1, len(points))


def test_copies_change_as_points_of_their_own(many, monkeypatch):
    """Without what tells copies from their spreads the derivative by the pitch is off by more than itself."""
    operator, weights = operator_of({})
    shared = operator.jacobian(weights, [{name: change} for name, change in MOVING.items()])
    assert len(
        plan.DerivativePlan(OpticalSystem(operator.camera, WAVELENGTH), operator.points, None, 0.1)._positions
    ) < len(weights)
    monkeypatch.setattr(plan, "derivatives_share", lambda accuracy, count: False)
    alone, _ = operator_of({})
    own = alone.jacobian(weights, [{name: change} for name, change in MOVING.items()])
    for name, found, expected in zip(MOVING, shared, own, strict=True):
        assert error(found, expected) < 0.07, name
    image = np.random.default_rng(3).normal(size=operator.camera.shape)
    gradient = operator.gradient(weights, image)
    assert set(gradient) == set(DIFFERENTIABLE)
    for (name, change), slope in zip(MOVING.items(), shared, strict=True):
        product = np.vdot(slope.astype(float), image) - np.vdot(change, gradient[name])
        assert abs(product) < 1e-4 * np.linalg.norm(slope) * np.linalg.norm(image), name


def behind(name="double_gauss", **numbers):
    return small_camera(2, main_lens=name, **(HALF | numbers))


def test_changes_of_the_light_against_refitted_lenses():
    """The path, but for its piston, by lenses that are fitted anew to either side."""
    camera = behind("singlet")
    points = np.array([(0.5, -0.3, 110.0)])
    lens = OpticalSystem(camera, WAVELENGTH).waves_of(points)
    change = lens_change(lens, "wavelength")
    rng = np.random.default_rng(1)
    pupil = tuple(part[None] for part in 0.6 * lens.pupil.radius * rng.uniform(-1, 1, (2, 50)))
    fields, inverse_distance = lens.fitted.pupils.field(points)
    lanes = [np.array([[number]]) for number in change.aberration.at(fields, inverse_distance)[0]]
    field = fields[:, :1], fields[:, 1:]
    found = change.aberration.over_pupil(lanes, field).value(pupil)
    high, low = (
        OpticalSystem(camera, WAVELENGTH + step).waves_of(points).bind(points).length(pupil) for step in (1, -1)
    )
    expected = (high - low) / 2
    found, expected = found - found.mean(), expected - expected.mean()
    assert np.abs(expected).max() > 1e-6
    assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()
