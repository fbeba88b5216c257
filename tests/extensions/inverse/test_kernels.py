"""Kernels that Dr.Jit compiles where a camera changes from step to step, as in a training loop."""

import drjit as dr
import numpy as np
import pytest

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.array_functions import CameraCapture

POINTS = np.array([(0.01, -0.02, 215.0), (-0.03, 0.02, 240.0)])


@pytest.fixture
def kernels():
    """Return a function that lists the kernels since it was called last, in memory, on disk or compiled."""
    before = dr.flag(dr.JitFlag.KernelHistory)
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    dr.kernel_history_clear()
    yield lambda: {each["hash"] for each in dr.kernel_history() if each["type"] == dr.KernelType.JIT}
    dr.set_flag(dr.JitFlag.KernelHistory, before)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("mla_distance", (119.9, 120.07, 120.13)),
        pytest.param("focal_length", (79.99, 80.01, 80.03), marks=pytest.mark.slow),
        pytest.param("detector_distance", (0.511, 0.513, 0.515), marks=pytest.mark.slow),
        pytest.param("mla_offset", ((0.001, 0.002), (0.003, 0.001), (0.002, 0.004)), marks=pytest.mark.slow),
        ("mla_rotation", (1.0, 1.01, 1.02)),
        ("wavefront", ((0, 0.1, 0.2), (0, 0.2, 0.1), (0, 0.15, 0.3))),
    ],
)
@pytest.mark.parametrize("lattice", [pytest.param("square", marks=pytest.mark.slow), "hexagonal"])
def test_a_camera_that_changes_compiles_nothing_after_the_first_step(name, values, lattice, kernels):
    camera = PlenopticCamera(resolution=(64, 64), detector_width=0.128, mla_lattice=lattice)

    def step(value):
        function = CameraCapture(lambda made: CaptureOperator(made, POINTS, wavelength=633), camera, (name,))
        capture = function.at(np.ones(2), np.array(value, float))
        capture.vjp(2 * capture.value, [True, True])
        return kernels()

    # No other test has a camera of the first values, whose tables would be remembered.
    first, *later = map(step, values)
    for own in later:
        assert not own - first
        first |= own
