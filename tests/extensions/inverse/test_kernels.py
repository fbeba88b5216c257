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
    ("lattice", "name", "values"),
    [
        ("hexagonal", "mla_distance", (119.9, 120.07)),
        pytest.param("hexagonal", "mla_rotation", (1.0, 1.01), marks=pytest.mark.slow),
        pytest.param("square", "wavefront", ((0, 0.1, 0.2), (0, 0.2, 0.1)), marks=pytest.mark.slow),
        pytest.param("square", "mla_offset", ((0.001, 0.002), (0.003, 0.001)), marks=pytest.mark.slow),
    ],
)
def test_a_camera_that_changes_compiles_nothing_after_the_first_step(lattice, name, values, kernels):
    camera = PlenopticCamera(resolution=(64, 64), detector_width=0.128, mla_lattice=lattice)

    def step(value):
        function = CameraCapture(lambda made: CaptureOperator(made, POINTS, wavelength=633), camera, (name,))
        capture = function.at(np.ones(2), np.array(value, float))
        capture.vjp(2 * capture.value, [True, True])
        return kernels()

    # No other test has a camera of the first values, whose tables would be remembered.
    first, second = map(step, values)
    assert first and not second - first
