"""The stand-in for a CUDA device, for all tests of what runs on one."""

import coverage
import device_stand_in
import drjit as dr
import pytest

from mitsuba_plenoptic.refocus import methods
from mitsuba_plenoptic.runtime import backend as _backend


def measured_as(context):
    """Have lines that run from here on counted in a context of their own, where coverage is measured."""
    if measuring := coverage.Coverage.current():
        measuring.switch_context(context)


@pytest.fixture(autouse=True)
def on_the_processor():
    """Keep the lines that run without the stand-in apart; see ``tools/stand_in_coverage.py``."""
    measured_as("processor")
    yield
    measured_as("processor")


@pytest.fixture
def device(monkeypatch):
    """Have the stand-in chosen, beside Dr.Jit on LLVM, whose arrays count as lying on the device."""
    stand_in = device_stand_in.StandIn()

    def numpy(array):
        stand_in.to_host.append((dr.width(array),))
        return device_stand_in._dr_numpy(array)

    monkeypatch.setattr(_backend, "_cuda", lambda: stand_in.backend)
    monkeypatch.setattr(_backend, "array_module", lambda: dr.cuda)
    monkeypatch.setattr(dr, "backend_v", lambda array: dr.JitBackend.CUDA)
    monkeypatch.setattr(dr.ArrayBase, "numpy", numpy)
    methods._results.clear()
    device_stand_in.forget()
    measured_as("device")
    yield stand_in
    measured_as("processor")
    methods._results.clear()
    device_stand_in.forget()
