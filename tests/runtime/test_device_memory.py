"""Memory on a CUDA device, by the stand-in: limits follow the active variant, and caches are not in the way."""

import drjit as dr
import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.runtime import limits
from mitsuba_plenoptic.runtime.limits import GIB, VARIABLE, check_memory, require_memory, work_limit

CAMERA = mp.PlenopticCamera(detector_width=0.256, resolution=(128, 128))


@pytest.fixture(autouse=True)
def machine(monkeypatch):
    """Leave the limit to the memory, which is 1024 GiB here."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(limits, "_machine_memory", lambda: 1024.0 * GIB)


@pytest.fixture
def flushed(device, monkeypatch):
    """Count how often Dr.Jit's cache is emptied."""
    calls = []
    monkeypatch.setattr(dr, "flush_malloc_cache", lambda: calls.append(device.free))
    return calls


def test_the_limit_is_the_devices_where_a_cuda_variant_is_active(device):
    device.free = 8 * GIB
    assert work_limit(1.0) == 6 * GIB
    words = "a field: it would need 7.0 GiB of device memory, at most 6.0 GiB"
    refuses(words, check_memory, 7 * GIB, "a field", most=16 * GIB)
    # What is read and decoded lies in the machine's memory.
    require_memory(700 * GIB, "a picture")
    refuses("it would need 800 GiB of memory, at most 768 GiB", require_memory, 800 * GIB, "a picture")


def test_without_a_device_the_limit_is_the_machines():
    assert work_limit(1.0) == 768 * GIB
    refuses("it would need 800 GiB of memory", check_memory, 800 * GIB, "a field", most=1024 * GIB)


def test_the_variable_limits_the_device_but_does_not_enlarge_it(device, monkeypatch):
    monkeypatch.setenv(VARIABLE, "2")
    assert work_limit(1.0) == 2 * GIB
    monkeypatch.setenv(VARIABLE, "64")
    assert work_limit(1.0) == 0.75 * device.free


def test_caches_are_emptied_before_a_refusal_and_only_then(device, flushed):
    device.free, device.kept = 1 * GIB, 7 * GIB
    check_memory(0.5 * GIB, "a field")
    assert not flushed and device.kept
    check_memory(3 * GIB, "a field")
    assert flushed == [1 * GIB] and not device.kept
    refuses("7.0 GiB of device memory, at most 6.0 GiB", check_memory, 7 * GIB, "a field", most=16 * GIB)


def test_caches_are_emptied_between_the_sums_of_a_job(device, flushed):
    operator = mp.CaptureOperator(CAMERA, [(0, 0, 240)], spectrum=mp.Spectrum.lines(633, 550, 500))
    assert operator.forward([[1, 1, 1]]).any() and len(flushed) == 3


def test_captures_and_reconstructions_name_the_device(device):
    device.free = 2**12
    image, options = np.ones(CAMERA.shape), {"camera": CAMERA, "wavelength": 633, "method": "coherent"}
    refuses("GiB of device memory", mp.reconstruct, image, 240.0, **options)
    scene = mp.load_scene("white", parameters={"resolution": "512"})
    refuses("capture of .* GiB of device memory", mp.render_capture, scene, spp=4)


def test_without_cupy_the_machine_limits_what_rays_need(device, monkeypatch):
    def missing():
        raise mp.InputError("waves on CUDA need CuPy")

    monkeypatch.setattr("mitsuba_plenoptic.runtime.backend._cuda", missing)
    assert work_limit(1.0) == 768 * GIB
