"""The stand-in for a CUDA device, for all tests of what runs on one."""

import device_stand_in
import drjit as dr
import pytest

from mitsuba_plenoptic.runtime import backend as _backend


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
    device_stand_in.forget()
    yield stand_in
    device_stand_in.forget()
