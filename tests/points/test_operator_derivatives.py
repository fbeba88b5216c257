"""Derivatives of captures: reverse against forward mode, and both against differences of the full field."""

from dataclasses import replace

import numpy as np
import pytest
from wave_cases import HALF, WAVELENGTH, error, scattered, small_camera

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.errors import InputError
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.optics.spectrum import Spectrum
from mitsuba_plenoptic.points.arrival import field_grids
from mitsuba_plenoptic.points.derivatives import DIFFERENTIABLE
from mitsuba_plenoptic.points.full_field import full_field
from mitsuba_plenoptic.points.operator import CaptureOperator
from mitsuba_plenoptic.runtime.batches import Job

CAMERAS = {
    "rectangular": {"mla_pitch": (0.064, 0.05), "mla_offset": (0.0, 0.013)},
    "turned, gaps, cropped": {
        "mla_rotation": -13.0, "mla_fill": 0.9, "detector_distance": 0.48,
        "crop_offset": (10, 5), "crop_size": (50, 51),
    },
    "three focal lengths": {
        "mla_lattice": "hexagonal", "mla_focal_length": (0.44, 0.512, 0.6), "wavefront": (0.0, 0.1, 0.0, 0.3),
    },
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_reverse_equals_forward(name):
    """<A' t, y> = <t, A'* y> to 1e-4 of |A' t| |y|, with every number changed so that it counts as much as another."""
    camera, rng = small_camera(2, **(HALF | CAMERAS[name])), np.random.default_rng(5)
    weights, gradient = rng.normal(size=(2, 2)), rng.normal(size=(*camera.shape, 2)).astype(np.float32)
    operator = CaptureOperator(
        camera,
        scattered(2, distances=(112.0, 128.0), image=0.05),
        spectrum=Spectrum.lines(633, 532),
        accuracy=0.02,
        pupil_weights=rng.uniform(0.2, 1, (2, 3, 3)),
    )
    found = operator.gradient(weights, gradient)
    assert set(found) == set(DIFFERENTIABLE)
    assert len(found["wavefront"]) == 36 and len(found["mla_pitch"]) == 2
    change = {key: rng.choice([-1, 1]) * given / np.vdot(given, given) for key, given in found.items()}
    forward = operator.derivative(weights, change).astype(np.float64)
    back = sum(np.vdot(change[key], given) for key, given in found.items())
    difference = abs(np.vdot(forward, gradient.astype(np.float64)) - back)
    assert difference < 1e-4 * np.linalg.norm(forward) * np.linalg.norm(gradient)


@pytest.mark.parametrize(
    ("name", "step", "limit"),
    [
        pytest.param("focal_length", 4e-3, 0.005, marks=pytest.mark.slow),
        pytest.param("mla_pitch", 7e-5, 0.005, marks=pytest.mark.slow),
        pytest.param("mla_rotation", 0.1, 0.005, marks=pytest.mark.slow),
        ("detector_width", 2e-4, 0.025),
        pytest.param("aperture_radius", 9e-3, 0.025, marks=pytest.mark.slow),
    ],
)
def test_derivatives_against_differences_of_the_full_field(name, step, limit):
    camera, point = small_camera(2, **HALF), np.array((0.03, -0.02, 115.0))
    base, sides = field_grids(OpticalSystem(camera, WAVELENGTH), point, 1.0, 1.0), []
    for side in (1, -1):
        changed = camera.replace(**{name: getattr(camera, name) + side * step})
        growth = changed.detector_width / camera.detector_width
        origin = tuple(growth * place for place in base.wide_origin)
        sides.append(
            full_field(
                OpticalSystem(changed, WAVELENGTH),
                point,
                grids=replace(base, pitch=base.pitch * growth, wide_origin=origin),
            )
        )
    operator = CaptureOperator(camera, [point], wavelength=WAVELENGTH, accuracy=0)
    assert error(operator.derivative([1.0], {name: 1.0}), (sides[0] - sides[1]) / (2 * step)) < limit


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


def test_aberrations_against_differences_of_the_full_field():
    camera, point, amounts = small_camera(2, **HALF), np.array((0.03, -0.02, 116.0)), np.zeros(15)
    amounts[[3, 6, 10]] = 1.0, -0.7, 0.5
    grids = field_grids(OpticalSystem(camera, WAVELENGTH), point, 1.0, 1.0)
    up, down = (
        full_field(OpticalSystem(camera.replace(wavefront=tuple(h * amounts)), WAVELENGTH), point, grids=grids)
        for h in (4e-3, -4e-3)
    )
    operator = CaptureOperator(camera, [point], wavelength=WAVELENGTH, accuracy=0)
    assert error(operator.derivative([1.0], {"wavefront": amounts}), (up - down) / 8e-3) < 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"f_number": 1.0}, "f_number.*: it is none of the parameters"),
        ({"mla_offset": 1.0}, "^mla_offset = 1.0: its change must be 2 numbers"),
        ({"focal_length": float("nan")}, "^focal_length"),
        ([1.0], "^changes = "),
    ],
)
def test_mistakes(changes, message):
    operator = CaptureOperator(small_camera(2), [(0, 0, 240.0)], wavelength=WAVELENGTH)
    with pytest.raises(InputError, match=message):
        operator.derivative([1.0], changes)


def test_the_method_without_derivatives_is_refused():
    operator = CaptureOperator(small_camera(2), [(0, 0, 240.0)], wavelength=WAVELENGTH, method="full_field")
    with pytest.raises(InputError, match=r"^method = full_field: it has no derivatives"):
        operator.gradient([1.0], np.zeros(operator.camera.shape))


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
