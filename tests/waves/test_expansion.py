"""Plans of cameras near another one, against plans that are computed anew."""

import numpy as np
import pytest

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.waves.expansion import OF_KERNELS, ExpandedPlan, nearby
from mitsuba_plenoptic.waves.phase_space import PhaseSpace

CAMERA = PlenopticCamera(
    detector_width=3 * 0.064, resolution=(96, 96), mla_medium=1.2, mla_focal_length=0.6, mla_lattice="hexagonal"
)
PLAN = PhaseSpace(CAMERA, 633.0, degree=1, radial=6)
STEP = CAMERA.pixel_size / 2


def changed(**parts):
    return CAMERA.replace(**{name: getattr(CAMERA, name) * (1 + part) for name, part in parts.items()})


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "mla_pitch")) for n in OF_KERNELS])
def test_kernels_are_those_computed_anew(name):
    """At the farthest place from the grid of an accuracy of 0.01."""
    camera = changed(**{name: 0.0025})
    step = STEP * camera.detector_width / CAMERA.detector_width
    before = PLAN.kernels(STEP, PLAN.reach)
    expected = PLAN.moved(camera).sampled_kernels(step, PLAN.kernel_samples(STEP, PLAN.reach))
    found = ExpandedPlan.about(PLAN, camera).kernels(step, PLAN.reach)
    assert np.linalg.norm(found - expected) < min(
        0.001 * np.linalg.norm(before), 0.05 * np.linalg.norm(before - expected)
    )


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
    expected, found = PLAN.moved(camera), ExpandedPlan.about(PLAN, camera)
    before, expected, found = map(spread, (PLAN, expected, found))
    assert np.linalg.norm(found - expected) < 0.1 * np.linalg.norm(expected - before)


def test_the_camera_nearby_follows_from_the_camera_alone():
    start = nearby(CAMERA, ("mla_distance", "focal_length"), 0.01)
    assert 0 < abs(start.mla_distance / CAMERA.mla_distance - 1) < 0.0026
    assert start.replace(mla_distance=CAMERA.mla_distance) == CAMERA
    # A camera of the same cell of the grid has the same one.
    between = CAMERA.replace(mla_distance=0.75 * start.mla_distance + 0.25 * CAMERA.mla_distance)
    assert nearby(between, ("mla_distance",), 0.01) == start
    assert nearby(CAMERA, ("focal_length",), 0.01) is CAMERA
