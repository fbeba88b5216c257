"""Signed rays against closed forms of apertures, and against exact sums of point spreads."""

import math
import weakref

import mitsuba as mi
import numpy as np
import pytest
from cases import relative
from scipy.special import j0, j1

from mitsuba_plenoptic import InputError, LensSystem, PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.rays.tracer import Walk
from mitsuba_plenoptic.waves.phase_space import PhaseSpace, Table, WaveAccuracy, coefficients_of
from tools.bench.cases import phase_space

PLACES = (0.0, 0.028, 0.036)
"""In a point's image, where light of a lens is looked for."""

DISCS = PlenopticCamera(mla_aperture="circle", mla_fill=0.5)
GAPS = PlenopticCamera(mla_fill=0.5)


def disc(s):
    return 2 / math.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))


@pytest.mark.parametrize(("camera", "theory", "degree"), [(DISCS, disc, 4), (GAPS, lambda s: 1 - s, 0)])
def test_the_first_kernel_has_the_transfer_function_of_its_aperture(camera, theory, degree):
    # Goodman, "Introduction to Fourier Optics", section 6.3.
    plan, step, width = PhaseSpace.of(camera, 633.0, WaveAccuracy(degree=degree)), 0.001, 0.032
    kernel = plan.kernels(step, 0.3)[0]
    frequency = np.arange(0, 0.9 * width / (633e-6 * 0.512), 5.0)
    place = (np.arange(len(kernel)) - len(kernel) // 2) * step
    found = np.exp(-2j * np.pi * np.outer(frequency, place)) @ kernel.sum(0)
    assert found.real == pytest.approx(theory(frequency * 633e-6 * 0.512 / width), abs=0.004)
    assert np.abs(found.imag).max() < 1e-3


def test_the_mean_over_the_pupil_is_airys_pattern(radius=0.25):
    # How much of the light of a point in focus falls into a lens, over its place: the lens convolved with the pattern.
    plan = PhaseSpace.of(PlenopticCamera(aperture_radius=radius), 633.0, WaveAccuracy(degree=0))
    mean = np.zeros(len(PLACES))
    for radial, (node, part) in enumerate(zip(plan.nodes, plan.table, strict=True)):
        t = 1 - radial / plan.accuracy.radial
        ring = part[..., 0]
        # The other quarters of the pupil are mirror images.
        ring = (ring + ring[:, ::-1] + ring[:, :, ::-1] + ring[:, ::-1, ::-1]) / 4
        turn = np.where(np.arange(len(ring)) % (len(ring) - 1), 1, 0.5)
        ring = np.tensordot(turn, ring, 1) / turn.sum()
        axis = (np.arange(ring.shape[1]) + 0.5) / ring.shape[1] * node.sides[0] - node.sides[0] / 2
        middle = ring[(len(ring) - 1) // 2 : len(ring) // 2 + 1].mean(0)
        mean += (1 - t * t) * t * np.interp(PLACES, axis, middle)
    mean /= sum((1 - t * t) * t for t in 1 - np.arange(plan.accuracy.radial + 1) / plan.accuracy.radial)
    step, scale = 0.001, math.pi * 2 * radius / (633e-6 * 120)
    axis = (np.arange(-480, 480) + 0.5) * step
    v = scale * np.hypot(axis, axis[:, None])
    airy = (scale * j1(v) / v) ** 2 / math.pi
    lens = np.abs(axis) < 0.032
    for place, found in zip(PLACES, mean, strict=True):
        expected = airy[np.ix_(lens, np.abs(axis + place) < 0.032)].sum() * step**2
        assert found == pytest.approx(expected, abs=0.0015), place


@pytest.mark.slow
@pytest.mark.parametrize(
    "camera",
    [PlenopticCamera.preset("paper_double_gauss"), PlenopticCamera.preset("lfm")],
    ids=["double Gauss", "objective"],
)
def test_walls_through_other_main_lenses_are_those_of_point_spreads(camera):
    wall = phase_space.Wall(camera, 0.0, 1, 12, 0.0)
    view = phase_space.around(camera, wall, 2)
    exact = phase_space.reference(view, wall)
    signed = phase_space.capture(PhaseSpace.of(camera, 633.0), view, wall, 256, 1, 0)
    # Its noise is a part of the error.
    assert relative(signed, exact) < 0.05
    assert signed.sum() / exact.sum() == pytest.approx(1, abs=0.01)


def test_the_pupil_off_the_axis_is_that_of_rays():
    camera = PlenopticCamera.preset("paper_double_gauss").replace(aperture_radius=13.0)
    mi.set_variant("llvm_ad_mono")
    pupil, lens = Walk.of(camera, OpticalSystem(camera, 633.0).lens), LensSystem.of(camera, 633.0)
    x, y = np.random.default_rng(0).uniform(-2.4, 2.4, (2, 20000)) * camera.pupil_radius
    for centre in ((0.0, 0.0), (3.5, -2.0), (0.0, 4.0)):
        u, v = pupil.round_pupil((mi.Float(x), mi.Float(y)), (mi.Float(centre[0]), mi.Float(centre[1])))
        is_open = np.hypot(u.numpy(), v.numpy()) <= camera.pupil_radius
        expected = lens.ray((x, y), (np.full_like(x, centre[0]), np.full_like(y, centre[1])))[2]
        assert np.mean(is_open != expected) < 2e-3
    # The pupil near the axis is another one.
    assert np.mean((np.hypot(x, y) <= camera.pupil_radius) != expected) > 0.005


@pytest.mark.parametrize("f_number", [2, 12, 60, 1000])
def test_windows_hold_the_airy_pattern(f_number):
    """All but 0.6 % of its light, by the encircled energy (Born and Wolf, "Principles of Optics", section 8.5.2)."""
    camera = PlenopticCamera(aperture_radius=120 / f_number / 2)
    half = min(PhaseSpace.of(camera, 633.0).nodes[-1].sides) / 2
    v = 2 * np.pi * camera.pupil_radius / (633e-6 * camera.pupil_distance) * half
    assert j0(v) ** 2 + j1(v) ** 2 < 0.006


def test_openings_of_a_few_wavelengths_are_refused():
    with pytest.raises(InputError, match=r"mla_fill = 0.05: .* 0.0989"):
        PhaseSpace.of(PlenopticCamera(mla_fill=0.05), 633.0)
    narrow = PhaseSpace.of(PlenopticCamera(mla_fill=0.1), 633.0, WaveAccuracy(degree=0))
    assert narrow.kernels(0.008, 0.128)[0].sum() == pytest.approx(1)


@pytest.mark.slow
def test_plans_of_many_cameras_keep_tables_of_bounded_size(monkeypatch):
    """As those of the steps of a fit, of which other caches keep the plans."""
    made = []

    def fill(table, arrays):
        made.append(weakref.ref(table.memory))

    monkeypatch.setattr("mitsuba_plenoptic.waves.phase_space._tables", {})
    monkeypatch.setattr(PhaseSpace, "tabulated", lambda plan: [])
    monkeypatch.setattr(Table, "fill", fill)
    plans = [PhaseSpace.of(PlenopticCamera(), 500.0, WaveAccuracy(degree=1, radial=2, window=9 + k)) for k in range(20)]
    sizes = [Table(plan.shapes).size for plan in plans]
    monkeypatch.setattr("mitsuba_plenoptic.waves.phase_space._BYTES", sum(sizes[-4:]))
    for plan in plans:
        assert plan.table is plan.table
    assert len(made) == 20
    assert [each() is not None for each in made] == [False] * 16 + [True] * 4
    # A capture gets all of its tables, however large they are.
    coefficients_of(plans[:8])
    assert len(made) == 28
    assert all(each() is not None for each in made[20:])


@pytest.mark.parametrize(("pitch", "pixels"), [pytest.param(0.5, 16, marks=pytest.mark.slow), (0.4, 4), (0.4, 9)])
def test_kernels_of_large_lenses_keep_the_light(pitch, pixels):
    """Far wider than their diffraction: samples of lenses repeat within the kernels' reach, and pixels are coarse."""
    camera = PlenopticCamera(
        focal_length=50, aperture_radius=5, focus_distance=1000, mla_pitch=pitch, mla_focal_length=5.2 * pitch,
        detector_width=8 * pitch, resolution=(8 * pixels,) * 2,
    )  # fmt: skip
    plan = PhaseSpace.of(camera, 633.0)
    assert plan.lands_by_point == (pitch == 0.5)
    light = plan.kernels(camera.pixel_size / plan.parts(False), 2 * pitch).sum((1, 2))
    np.testing.assert_allclose(light, np.eye(len(light))[0], atol=5e-5)
