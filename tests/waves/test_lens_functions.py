"""Microlenses as parabolas, orders and functions of signed rays."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import LATTICES, WAVELENGTH, error, small_camera
from drjit.llvm import Float64
from scipy.special import j1

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.fields.microlens_orders import PlaneFactor, axis_orders
from mitsuba_plenoptic.fields.transmittance import transmission
from mitsuba_plenoptic.runtime import turn
from mitsuba_plenoptic.waves import array_kernels
from mitsuba_plenoptic.waves.phase_space import PhaseSpace, WaveAccuracy, coefficients_of
from mitsuba_plenoptic.waves.ray_sampler import LensPoints


def test_symmetric_lenses_have_the_kernels_that_all_lags_give(monkeypatch):
    plan = PhaseSpace.of(PlenopticCamera(mla_aperture="circle", mla_fill=0.5), 550.0, WaveAccuracy(degree=2))
    found = plan.kernels(0.002, 0.08)
    monkeypatch.setattr(array_kernels, "_symmetry", lambda *_: None)
    expected = plan.moved(plan.camera).kernels(0.002, 0.08)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


COUNT = 1 << 19


@pytest.fixture(scope="module", params=[{}, {"mla_aperture": "circle", "mla_fill": 0.5}], ids=["cells", "discs"])
def plan(request):
    return PhaseSpace.of(PlenopticCamera(**request.param), 633.0, WaveAccuracy(degree=1, radial=8))


@pytest.fixture(scope="module")
def points(plan):
    mi.set_variant("llvm_ad_mono")
    return LensPoints(plan)


@pytest.mark.parametrize(("radius", "angle"), [(0.6, 2.1), (0.99, 0.785)])
def test_drawn_points_carry_all_light_with_weights_near_the_least_variance(points, plan, radius, angle):
    rng = np.random.default_rng(1)
    random, chance = ([mi.Float(rng.random(COUNT).astype(np.float32)) for _ in range(n)] for n in (2, 4))
    place = plan.camera.pupil_radius * radius * np.array([np.cos(angle), np.sin(angle)])
    pupil = [dr.full(mi.Float, part, COUNT) for part in place]
    point, weight = points.draw(pupil, chance, random)
    values = [np.asarray(value * weight) for value in coefficients_of([plan])[0](point, pupil, chance, mi.Bool(True))]
    # The known integrals, in the corners of windows, too.
    assert values[0].mean() == pytest.approx(1, abs=0.01)
    assert [value.mean() for value in values[1:]] == pytest.approx([0, 0], abs=0.02)
    # No density does better than the coefficient's own size.
    assert np.mean(values[0] ** 2) <= 1.5 * np.mean(np.abs(values[0])) ** 2


SMALL = small_camera()

lattices = pytest.mark.parametrize("lattice", LATTICES.values(), ids=LATTICES)
some = pytest.mark.parametrize("name", ["circles", "stretched", "three focal lengths"])


def to_numpy(values):
    return np.array(values.real) + 1j * np.array(values.imag)


@lattices
def test_every_lens_is_a_parabola_in_its_aperture(lattice):
    camera = SMALL.replace(**lattice)
    i, j = 3, -2
    cx, cy = camera.lattice.centre(i, j)
    dx, dy = np.random.default_rng(0).uniform(-0.03, 0.03, (2, 500))
    dx, dy = (axis[camera.lattice.in_aperture(dx, dy)] for axis in (dx, dy))
    found = to_numpy(transmission(camera, WAVELENGTH, Float64(cx + dx), Float64(cy + dy)))
    focal_length = camera.mla_focal_lengths[int(camera.lattice.lens_type(i, j)) % len(camera.mla_focal_lengths)]
    expected = np.exp(-1j * np.pi * (dx**2 + dy**2) / (WAVELENGTH * 1e-6 * focal_length))
    assert np.abs(found - expected).max() < 1e-5


def test_orders_of_the_lens_array():
    x = (np.arange(200_000) + 0.5) / 200_000 * SMALL.mla_pitch
    t = np.exp(-1j * np.pi * (x - SMALL.mla_pitch / 2) ** 2 / (WAVELENGTH * 1e-6 * SMALL.mla_focal_length))
    q = np.arange(-20, 21)
    expected = [np.mean(t * np.exp(-2j * np.pi * k * x / SMALL.mla_pitch)) for k in q]
    assert np.allclose(axis_orders(SMALL, WAVELENGTH, 20, 0)[0], expected, atol=1e-8)
    # All of the light is in some order.
    assert np.sum(np.abs(axis_orders(SMALL, WAVELENGTH, 3000, 0)[0]) ** 2) == pytest.approx(1, abs=1e-4)


def test_orders_of_holes_are_airy_patterns():
    """Lenses of hardly any power on a hexagonal lattice, whose reciprocal lattice is hexagonal, too."""
    camera = SMALL.replace(mla_lattice="hexagonal", mla_aperture="circle", mla_fill=0.9, mla_focal_length=1e6)
    found = PlaneFactor(camera, WAVELENGTH, 0.2).orders()
    q = [np.arange(size) - size // 2 for size in found.shape]
    width, height = camera.lattice.period()
    argument = np.pi * 0.9 * camera.mla_pitch * np.hypot(q[1] / width, q[0][:, None] / height)
    with np.errstate(invalid="ignore"):
        airy = np.where(argument == 0, 1, 2 * j1(argument) / argument)
    there = (q[0][:, None] + q[1]) % 2 == 0
    expected = camera.lattice.lens_area / camera.lattice.cell_area * airy * there * (found != 0)
    # A lens's centre is on the axis, so that there is no other phase.
    assert np.abs(found - expected).max() < 3e-4
    assert np.abs(found[~there]).max() < 1e-5


@some
@pytest.mark.parametrize("parameter", [None, ("position", 0, 0), ("fresnel", 1, 0)])
def test_transmission_is_the_sum_of_its_orders(name, parameter):
    """Errors between samples of a table are far below those of a capture: gradients cancel nearly."""
    camera = SMALL.replace(**LATTICES[name])
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 500))
    factor = PlaneFactor(camera, WAVELENGTH, 0.2)
    found = to_numpy(factor.at(Float64(x), Float64(y), parameter=parameter))
    amplitudes = factor.orders(parameter)
    x, y = turn(x - camera.mla_offset[0], y - camera.mla_offset[1], -camera.mla_rotation)
    sides = camera.lattice.period(len(camera.mla_focal_lengths))
    along_x, along_y = (
        np.exp(2j * np.pi * np.outer(place, np.arange(size) - size // 2) / side)
        for place, size, side in zip((x, y), amplitudes.shape[::-1], sides, strict=True)
    )
    assert error(found, np.einsum("kj,ji,ki->k", along_y, amplitudes, along_x)) < 5e-5
