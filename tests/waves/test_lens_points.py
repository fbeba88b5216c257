"""Points that are drawn about lenses."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.waves.phase_space import PhaseSpace, coefficients_of
from mitsuba_plenoptic.waves.ray_sampler import LensPoints

COUNT = 1 << 19


@pytest.fixture(scope="module", params=[{}, {"mla_aperture": "circle", "mla_fill": 0.5}], ids=["cells", "discs"])
def plan(request):
    return PhaseSpace(PlenopticCamera(**request.param), 633.0, degree=1, radial=8)


@pytest.fixture(scope="module")
def points(plan, mono):
    return LensPoints(plan)


@pytest.fixture(scope="module")
def mono():
    mi.set_variant("llvm_ad_mono")


def drawn(points, plan, radius, angle):
    """Return points by random numbers, their weights, the pupil's point and the chances."""
    rng = np.random.default_rng(1)
    random, chance = ([mi.Float(rng.random(COUNT).astype(np.float32)) for _ in range(n)] for n in (2, 4))
    pupil = [
        dr.full(mi.Float, plan.camera.pupil_radius * radius * part, COUNT) for part in (np.cos(angle), np.sin(angle))
    ]
    return *points.draw(pupil, chance, random), pupil, chance


@pytest.mark.parametrize(("radius", "angle"), [(0.0, 0.3), (0.6, 2.1), (0.95, 0.02), (0.99, 0.785)])
def test_drawn_points_carry_all_light_with_weights_near_the_least_variance(points, plan, radius, angle):
    point, weight, pupil, chance = drawn(points, plan, radius, angle)
    values = [np.asarray(value * weight) for value in coefficients_of([plan])[0](point, pupil, chance, mi.Bool(True))]
    # The known integrals, in the corners of windows, too.
    assert values[0].mean() == pytest.approx(1, abs=0.01)
    assert [value.mean() for value in values[1:]] == pytest.approx([0, 0], abs=0.02)
    # No density does better than the coefficient's own size.
    assert np.mean(values[0] ** 2) <= 1.5 * np.mean(np.abs(values[0])) ** 2


def test_weights_are_one_over_the_density(points, plan):
    (x, y), weight, _, _ = drawn(points, plan, 0.8, 0.4)
    x, y, area = np.asarray(x), np.asarray(y), np.asarray(weight) * float(plan.lattice.lens_area)
    half = 0.3 * plan.camera.mla_pitch
    for inside, wanted in (
        ((np.abs(x) < half) & (np.abs(y) < half), 4 * half * half),
        ((x > half) & (x < 3 * half) & (y < -half) & (y > -2 * half), 2 * half * half),
    ):
        assert np.mean(area * inside) == pytest.approx(wanted, rel=0.03)


@pytest.mark.parametrize("aperture", ["cell", "circle"])
def test_kernels_of_small_lenses_stay_below_the_first(aperture):
    camera = PlenopticCamera(mla_aperture=aperture, mla_fill=0.5)
    kernels = PhaseSpace(camera, 633.0).kernels(camera.pixel_size, camera.mla_pitch)
    energy = np.square(kernels).sum((1, 2))
    assert energy.argmax() == 0
