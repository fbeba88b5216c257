"""Memory and kernels on a CUDA device, by the stand-in."""

import drjit as dr
import numpy as np
import pytest
from refusals import refuses

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import CaptureOperator, PlenopticCamera
from mitsuba_plenoptic.points import patch
from mitsuba_plenoptic.points.accuracy import band_for
from mitsuba_plenoptic.points.derivatives import plan
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


NARROW = PlenopticCamera(detector_width=0.128, resolution=(64, 64), aperture_radius=1.5)
TURNED = NARROW.replace(mla_rotation=7.0)
CHANGES = {"focal_length": 0.1, "wavelength": 2.0, "mla_pitch": (1e-5, 1e-5)}
_random = np.random.default_rng(0)
POINTS = np.column_stack([_random.uniform(-0.1, 0.1, (6, 2)), np.full(6, 240.0)])
IMAGE = _random.random(NARROW.shape, dtype=np.float32)
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
@pytest.mark.parametrize("camera", [NARROW, pytest.param(TURNED, marks=pytest.mark.slow)], ids=["square", "turned"])
@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "forward")) for n in WORKS])
def test_more_points_of_a_batch_start_no_more_kernels(name, camera, request, monkeypatch):
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
