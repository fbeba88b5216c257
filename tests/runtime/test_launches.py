"""Kernels are started for each batch of points, not for each point, where the arrays lie on a device."""

import drjit as dr
import numpy as np
import pytest

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.points import patch
from mitsuba_plenoptic.points.accuracy import band_for
from mitsuba_plenoptic.points.derivatives import plan

CAMERA = PlenopticCamera(detector_width=0.128, resolution=(64, 64), aperture_radius=1.5)
TURNED = CAMERA.replace(mla_rotation=7.0)
CHANGES = {"focal_length": 0.1, "wavelength": 2.0, "mla_pitch": (1e-5, 1e-5)}
_random = np.random.default_rng(0)
POINTS = np.column_stack([_random.uniform(-0.1, 0.1, (6, 2)), np.full(6, 240.0)])
IMAGE = _random.random(CAMERA.shape, dtype=np.float32)
WEIGHTS = np.linspace(1, 2, 6)


def _gradients(operator, count):
    found = operator.gradient(WEIGHTS[:count], IMAGE, tuple(CHANGES))
    return np.concatenate([np.ravel(found[name]) / np.abs(found[name]).max() for name in CHANGES])


WORKS = {
    "forward": lambda operator, count: operator.forward(WEIGHTS[:count]),
    "adjoint": lambda operator, count: operator.adjoint(IMAGE),
    "derivative": lambda operator, count: operator.derivative(WEIGHTS[:count], CHANGES),
    "gradient": _gradients,
}


def launches(device, work):
    """Return the kernels that both libraries start for some work, whose kernels are compiled and whose plans made."""
    work()
    before = device.launches
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history()
        work()
        dr.sync_thread()
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    return device.launches - before, len(kernels)


@pytest.mark.filterwarnings("ignore::mitsuba_plenoptic.PhysicsWarning")  # the small patches
@pytest.mark.parametrize("camera", [CAMERA, pytest.param(TURNED, marks=pytest.mark.slow)], ids=["square", "turned"])
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in ("derivative", "gradient"))) for n in WORKS]
)
def test_more_points_of_a_batch_start_no_more_kernels(name, camera, request, monkeypatch):
    """And their sums are those that the processor computes point by point."""
    # The small patches that many points have, also for derivatives, in one chain of fields.
    monkeypatch.setattr(plan, "derivative_band_for", lambda accuracy, count: band_for(accuracy, 2**20))
    monkeypatch.setattr(patch, "_CUDA", patch._CUDA._replace(chain=2**23))

    def work(count):
        operator = CaptureOperator(camera, POINTS[:count], wavelength=633, accuracy=0.05)
        return lambda: WORKS[name](operator, count)

    expected = work(6)()
    device = request.getfixturevalue("device")
    np.testing.assert_allclose(work(6)(), expected, rtol=1e-4, atol=2e-5 * np.abs(expected).max())
    assert launches(device, work(2)) == launches(device, work(6))
