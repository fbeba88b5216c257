"""The route through CUDA: with a stand-in for CuPy, so that every line of it runs anywhere; and on a device."""

import sys

import device_stand_in
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from stopped_runs import StoppedError, stopped_before
from wave_cases import capture

from mitsuba_plenoptic import (
    CaptureOperator,
    Checkpoint,
    InputError,
    Job,
    PlenopticCamera,
    point_spread_function,
    reconstruct,
)
from mitsuba_plenoptic.optics.waves import propagate
from mitsuba_plenoptic.points.point_spread import point_fields
from mitsuba_plenoptic.runtime import backend as _backend

# The inputs are random: the field fills its window, and the captures have light beside the micro-images.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_plenoptic.PhysicsWarning")

CAMERA = PlenopticCamera(detector_width=0.512, resolution=(256, 256))
SMALL = PlenopticCamera(detector_width=0.256, resolution=(128, 128), aperture_radius=1.5)
TINY = SMALL.replace(detector_width=0.128, resolution=(64, 64))
SIDE = 2048
"""Numbers that may leave the device before the end: the sums of a grid's rows, by which the physics is guarded."""
TURNED = CAMERA.replace(mla_lattice="hexagonal", mla_rotation=7.0)
COARSE = PlenopticCamera(detector_width=0.512, resolution=(128, 128))
_random = np.random.default_rng(0)
CAPTURE = _random.random(CAMERA.shape, dtype=np.float32)
_waves = np.zeros((60, 80), complex)  # the outer eighth of the spectrum is empty: a field that its grid resolves
_waves[:26, :35], _waves[-25:, -34:] = _random.standard_normal((26, 35)), _random.standard_normal((25, 34))
FIELD = np.fft.ifft2(_waves).astype(np.complex64)
POSITIONS = np.column_stack([_random.uniform(-0.4, 0.4, (20, 2)), _random.uniform(210, 275, 20)])
WEIGHTS = _random.random((20, 2))
PUPILS = np.maximum(_random.random((20, 8, 8)) - 0.3, 0)


def fields():
    planes = point_fields(SMALL, POSITIONS[0], wavelength=633)
    return [planes.pupil.samples, planes.mla.samples, planes.detector.samples]


def refocused(camera=CAMERA, **options):
    image = CAPTURE if camera is CAMERA else CAPTURE[::2, ::2]
    options = {"wavelength": None if options["method"] == "ray" else 633, **options}
    results = reconstruct(image, [225.0, 240.0], camera=camera, **options)
    return [result.image for result in results]


WORKS = {
    "step": lambda: [propagate(FIELD, 4e-3, 5.0, 633)],
    "sum of all": lambda: [capture(CAMERA, POSITIONS, WEIGHTS, accuracy=0)],
    "sum of patterns": lambda: [capture(CAMERA, POSITIONS, WEIGHTS - 0.5, accuracy=0.05, pupil_weights=PUPILS)],
    "sum on a turned array": lambda: [capture(TURNED, POSITIONS[:6], WEIGHTS[:6])],
    "full field": lambda: [point_spread_function(SMALL, POSITIONS[0], wavelength=633, method="full_field")],
    "fields": fields,
    "rays": lambda: refocused(method="ray"),
    "coherent": lambda: refocused(method="coherent"),
    "subdivided pixels": lambda: refocused(COARSE, method="coherent"),
    "partially coherent": lambda: refocused(method="partial"),
    "lens by lens": lambda: refocused(method="partial", interleave="auto"),
}
ADJOINTS = {
    "adjoint": lambda: [CaptureOperator(CAMERA, POSITIONS, wavelength=633, pupil_weights=PUPILS).adjoint(CAPTURE)],
    "adjoint on a turned array": lambda: [CaptureOperator(TURNED, POSITIONS[:6], wavelength=633).adjoint(CAPTURE)],
    "deconvolved": lambda: [
        reconstruct(CAPTURE[:64, :64], 253.0, camera=TINY, wavelength=633, method="deconvolved", iterations=3).image
    ],
}
"""They hand parts of the image to their batches, or the bins between steps, through the host."""
PLANNED = {"sum on a turned array"}
"""The orders of an array that is no product of two axes are transformed on the host, once for each optical system."""
LONG = {"sum of all", "sum on a turned array", "coherent", "partially coherent", "adjoint", "deconvolved"}
"""Run by `make slow`."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LONG)) for name in (*WORKS, *ADJOINTS)]
)
def test_the_device_computes_the_same_and_only_what_is_finished_leaves_it(name, request):
    work = (WORKS | ADJOINTS)[name]
    expected = work()
    device = request.getfixturevalue("device")
    for ours, theirs in zip(work(), expected, strict=True):
        assert type(ours) is np.ndarray and ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5 * np.abs(theirs).max())
    finished = sum(array.size for array in expected)
    sizes = [int(np.prod(shape)) for shape in device.to_host]
    assert name in {*ADJOINTS, *PLANNED} or sum(size for size in sizes if size > SIDE) <= 1.5 * finished


def test_a_field_on_the_device_stays_there(device):
    field = device.backend.arrays.asarray(FIELD)
    moved = propagate(field, 4e-3, 5.0, 633)
    assert isinstance(moved, device_stand_in.DeviceArray) and not device.to_host
    np.testing.assert_array_equal(device.backend.to_host(moved), propagate(FIELD, 4e-3, 5.0, 633))


def test_a_sum_goes_on_from_a_checkpoint(device, tmp_path):
    """Written from the device's memory, and taken back into it."""
    whole = capture(CAMERA, POSITIONS, WEIGHTS)
    path = tmp_path / "raw.checkpoint"
    with pytest.raises(StoppedError), stopped_before(len), Checkpoint(path) as keeper:
        capture(CAMERA, POSITIONS, WEIGHTS, job=Job(keeper=keeper))
    calls = []
    with Checkpoint(path, "resume") as keeper:
        resumed = capture(CAMERA, POSITIONS, WEIGHTS, job=Job(lambda *call: calls.append(call), keeper=keeper))
    assert calls[0][0] > 0
    np.testing.assert_array_equal(resumed, whole)


def test_the_estimate_waits_for_the_device(device, monkeypatch):
    waits = []
    monkeypatch.setattr(_backend.Backend, "synchronize", lambda self: waits.append(self))
    cost = CaptureOperator(CAMERA, POSITIONS, wavelength=633).estimate()
    assert cost.seconds > 0 and waits == [device.backend] * len(waits) and len(waits) >= 2


def test_without_cupy_waves_on_cuda_are_refused_with_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "cupy", None)
    _backend._cuda.cache_clear()
    with pytest.raises(InputError, match=r"waves on CUDA need CuPy.*pip install cupy-cuda12x"):
        _backend._cuda()


def test_the_stand_in_refuses_to_mix():
    array = device_stand_in.StandIn().backend.arrays.zeros(3)
    for mistake in (
        lambda: np.asarray(array),
        lambda: array + np.ones(3),
        lambda: np.ones(3) + array,
        lambda: array[np.arange(2)],
        lambda: array.__setitem__(slice(None), np.ones(3)),
    ):
        with pytest.raises(TypeError):
            mistake()


needs_device = pytest.mark.skipif(not dr.has_backend(dr.JitBackend.CUDA), reason="no CUDA device")


@needs_device
@pytest.mark.parametrize("work", (WORKS | ADJOINTS).values(), ids=WORKS | ADJOINTS)
def test_cuda_agrees_with_the_processor(work):
    pytest.importorskip("cupy")
    expected = work()
    mi.set_variant("cuda_ad_mono")
    for ours, theirs in zip(work(), expected, strict=True):
        assert np.linalg.norm(ours - theirs) <= 1e-4 * np.linalg.norm(theirs)
