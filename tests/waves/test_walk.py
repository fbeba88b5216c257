"""Rays of signed captures: ways through lenses, evenly spread random numbers, and plans of cameras near another one."""

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.rays import random_numbers
from mitsuba_plenoptic.rays.tracer import Passage, Walk, follow_back
from mitsuba_plenoptic.waves.expansion import OF_KERNELS, ExpandedPlan, nearby
from mitsuba_plenoptic.waves.phase_space import PhaseSpace, WaveAccuracy

CAMERAS = {
    "square": {},
    "hexagonal": {"mla_lattice": "hexagonal", "mla_rotation": 7.0, "mla_focal_length": (0.44, 0.512, 0.6)},
    "parabolic": {"lens_model": "parabolic", "aperture_radius": 15.0},
    "medium": {"mla_medium": 1.5, "mla_focal_length": 0.768, "detector_distance": 0.768},
    "medium, parabolic": {"mla_medium": 1.5, "lens_model": "parabolic"},
    "real lens": {"main_lens": "double_gauss", "focus_distance": 240.0},
    "irregular": {"mla_jitter": (0.001, 0.02), "mla_figure_error": (1e-4, 0.05)},
    "aligned": {"mla_cra": (0.0, 0.0, 8.0, 5.0)},
    "microscope": {"main_lens": {"magnification": 20.0, "numerical_aperture": 0.5}, "mla_focal_length": 3.0},
}


@pytest.fixture(params=CAMERAS)
def walk(request):
    camera = PlenopticCamera(**CAMERAS[request.param])
    return Walk.of(camera, OpticalSystem(camera, 633.0).lens)


def drawn(walk, count=2000):
    """Return detector points, and passages through lenses near those of their chief rays."""
    rng = np.random.default_rng(0)
    pixel = tuple(rng.uniform(-1, 1, (2, count)))
    lens, offset = walk.lenslet(*walk.chief_cell(pixel)[1]), rng.uniform(-0.03, 0.03, (2, count))
    return pixel, Passage((lens.centre[0] + offset[0], lens.centre[1] + offset[1]), lens)


def test_rays_come_back_to_the_detector_point_that_they_left(walk):
    pixel, passage = drawn(walk)
    slope, weight, _ = walk.out_of_array(pixel, passage)
    pupil = tuple(walk.lens.pupil.point(m, t) for m, t in zip(passage.point, slope, strict=True))
    landed, back = walk.onto_detector(pupil, passage)
    assert np.allclose(landed, pixel, atol=1e-9) and np.allclose(back, weight)


def test_the_light_of_a_point_takes_the_way_of_the_rays_that_meet_it(walk):
    """The main lens is passed by the path of waves one way, and by traced rays the other way."""
    pixel, passage = drawn(walk, 20)
    (x, y, z), slope, is_open = walk.trace(pixel, passage)
    assert is_open.any()
    distance = 0.01 if walk.camera.main_lens and not walk.camera.lens_data.converges else 250.0
    met = np.column_stack([x + (distance - z) * slope[0], y + (distance - z) * slope[1], np.full(len(x), distance)])
    out, _, _ = walk.out_of_array(pixel, passage)
    pupil = tuple(walk.lens.pupil.point(m, t) for m, t in zip(passage.point, out, strict=True))
    for index in np.flatnonzero(is_open)[:4]:
        point, own = met[index : index + 1], tuple(np.array([[P[index]]]) for P in pupil)
        lens, scene = walk.lens.waves_of(point), tuple(part[:, None] for part in point.T)
        light = lens.bind(point)
        place = np.stack(np.broadcast_arrays(*light.land(own, scene)))
        if lens.pupil.finite:
            cosines = np.stack(np.broadcast_arrays(*light.cosines(own, scene)))
            straight = np.stack(own) + lens.pupil.distance * cosines / np.sqrt(1 - (cosines**2).sum(0))
            assert np.allclose(straight, place, atol=3e-4)
        assert np.allclose(np.ravel(place), [passage.point[axis][index] for axis in (0, 1)], atol=3e-4)


def test_paraxial_rays_are_those_of_an_ideal_camera():
    camera = PlenopticCamera()
    pixel, passage = drawn(Walk.of(camera))
    point, slope, _ = Walk.of(camera).trace(pixel, passage)
    for axis in (0, 1):
        pupil, place = follow_back(pixel[axis], passage.point[axis], passage.lens.centre[axis], 240.0, camera)
        assert np.allclose(pupil, point[axis])
        assert np.allclose(place, -120.0 / 240.0 * (point[axis] + 240.0 * slope[axis]))


CAMERA = PlenopticCamera(
    detector_width=3 * 0.064, resolution=(96, 96), mla_medium=1.2, mla_focal_length=0.6, mla_lattice="hexagonal"
)
PLAN = PhaseSpace.of(CAMERA, 633.0, WaveAccuracy(degree=1, radial=6))
STEP = CAMERA.pixel_size / 2


def changed(**parts):
    return CAMERA.replace(**{name: getattr(CAMERA, name) * (1 + part) for name, part in parts.items()})


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "mla_pitch")) for n in OF_KERNELS])
def test_kernels_are_those_computed_anew(name):
    """At the farthest place from the grid of an accuracy of 0.01."""
    camera = changed(**{name: 0.0025})
    step = STEP * camera.detector_width / CAMERA.detector_width
    before = PLAN.kernels(STEP, PLAN.reach)
    expected = PLAN.moved(camera).sampled_kernels(step, PLAN.waves.kernel_samples(STEP, PLAN.reach), 0)
    apart = np.linalg.norm(ExpandedPlan.about(PLAN, camera).kernels(step, PLAN.reach) - expected)
    assert apart < min(0.001 * np.linalg.norm(before), 0.05 * np.linalg.norm(before - expected))


@pytest.mark.parametrize("name", ["mla_distance", "mla_pitch"])
def test_tables_are_those_computed_anew(name):
    """Their overlaps are sampled, so that smooth sums over the table are compared."""

    def spread(plan):
        sums = []
        for values, node in zip(plan.tabulated(), plan.nodes, strict=True):
            across = np.cos(np.linspace(-np.pi, np.pi, node.counts[0], endpoint=False))
            sums.append((values[..., 0].astype(float) * across).mean())
        return np.array(sums)

    camera = changed(**{name: 0.02})
    before, expected, found = map(spread, (PLAN, PLAN.moved(camera), ExpandedPlan.about(PLAN, camera)))
    assert np.linalg.norm(found - expected) < 0.1 * np.linalg.norm(expected - before)


def test_the_camera_nearby_follows_from_the_camera_alone():
    start = nearby(CAMERA, ("mla_distance", "focal_length"), 0.01)
    assert 0 < abs(start.mla_distance / CAMERA.mla_distance - 1) < 0.0026
    assert start.replace(mla_distance=CAMERA.mla_distance) == CAMERA
    # A camera of the same cell of the grid has the same one.
    between = CAMERA.replace(mla_distance=0.75 * start.mla_distance + 0.25 * CAMERA.mla_distance)
    assert nearby(between, ("mla_distance",), 0.01) == start
    assert nearby(CAMERA, ("focal_length",), 0.01) is CAMERA


@pytest.mark.parametrize("start", [0, 2**22])
def test_numbers_follow_the_sequence_at_any_index(start):
    """In single precision an index of 2^22 leaves two bits of a fraction."""
    index = start + np.arange(1024)
    found = random_numbers.low_discrepancy(mi.UInt32(7), mi.UInt32(32), mi.UInt32(index), 3)
    for numbers, step in zip(found, random_numbers.even_steps(3).tolist(), strict=True):
        values = numbers.numpy().astype(float)
        assert values.min() >= 0 and values.max() < 1
        assert np.abs((values - values[0] - (index - start) * step + 0.5) % 1 - 0.5).max() < 1e-6


@pytest.mark.parametrize(
    "draw", [lambda lanes, key: random_numbers.low_discrepancy(lanes, key, mi.UInt32(0), 6), random_numbers.chances_of]
)
def test_numbers_of_lanes_are_even_and_independent(draw):
    count = 2**16
    values = np.array([each.numpy() for each in draw(mi.UInt32(np.arange(count)), mi.UInt32(0))], float)
    # Within five deviations of what uniform, independent numbers have.
    assert np.abs(values.mean(1) - 0.5).max() < 5 / np.sqrt(12 * count)
    neighbours = [np.corrcoef(a[1:], b[:-1])[0, 1] for a in values for b in values]
    assert np.abs(np.corrcoef(values) - np.eye(len(values))).max() < 5 / np.sqrt(count)
    assert np.abs(neighbours).max() < 5 / np.sqrt(count)
    held = np.array([np.bincount((each * 256).astype(int), minlength=256) for each in values])
    chi = (np.square(held - count / 256) / (count / 256)).sum(1)
    assert np.abs(chi - 255).max() < 5 * np.sqrt(510)
