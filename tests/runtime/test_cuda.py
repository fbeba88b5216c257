"""The route through CUDA: with a stand-in for CuPy, so that every line of it runs anywhere; and on a device."""

import sys

import device_stand_in
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("mitsuba_plenoptic.extensions.inverse")

from camera_works import WORKS as CAMERA_WORKS
from camera_works import spread
from cameras import capture
from cases import bars, facing, scene_of, sensor
from stopped_runs import StoppedError, stopped_before

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.extensions.inverse.differentiable import CoherentRefocus
from mitsuba_plenoptic.optics.waves import propagate
from mitsuba_plenoptic.points.point_spread import point_fields
from mitsuba_plenoptic.runtime import backend as _backend
from mitsuba_plenoptic.waves.convolution import Convolution

# The inputs are random: the field fills its window, and the captures have light beside the micro-images.
pytestmark = pytest.mark.filterwarnings("ignore::mitsuba_plenoptic.PhysicsWarning")

CAMERA = mp.PlenopticCamera(detector_width=0.512, resolution=(256, 256))
SMALL = mp.PlenopticCamera(detector_width=0.256, resolution=(128, 128), aperture_radius=1.5)
TINY = SMALL.replace(detector_width=0.128, resolution=(64, 64))
SIDE = 2048
"""Numbers that may leave the device before the end: the sums of a grid's rows, by which the physics is guarded."""
TURNED = CAMERA.replace(mla_lattice="hexagonal", mla_rotation=7.0)
FOCUSED = TINY.replace(detector_distance=0.6)
GRID = np.array([(0.128 * i, 0.128 * j, 240.0) for i in range(-2, 3) for j in range(-2, 3)])
COARSE = mp.PlenopticCamera(detector_width=0.512, resolution=(128, 128))
_random = np.random.default_rng(0)
CAPTURE = _random.random(CAMERA.shape, dtype=np.float32)
_waves = np.zeros((60, 80), complex)  # the outer eighth of the spectrum is empty: a field that its grid resolves
_waves[:26, :35], _waves[-25:, -34:] = _random.standard_normal((26, 35)), _random.standard_normal((25, 34))
FIELD = np.fft.ifft2(_waves).astype(np.complex64)
POSITIONS = np.column_stack([_random.uniform(-0.4, 0.4, (20, 2)), _random.uniform(210, 275, 20)])
WEIGHTS = _random.random((20, 2))
WAVES = {"type": "plenoptic_wave", "method": "signed_rays", "child": {"type": "path"}}
PHASORS = np.exp(2j * np.pi * _random.random(20)).astype(np.complex64)
PUPILS = np.maximum(_random.random((20, 8, 8)) - 0.3, 0)


def fields():
    planes = point_fields(SMALL, POSITIONS[0], wavelength=633)
    return [planes.pupil.samples, planes.mla.samples, planes.detector.samples]


def refocused(camera=CAMERA, distances=(225.0, 240.0), **options):
    rows, columns = camera.shape
    image = CAPTURE[::2, ::2] if camera is COARSE else CAPTURE[:rows, :columns]
    options = {"wavelength": None if options["method"] == "ray" else 633, **options}
    return [result.image for result in mp.reconstruct(image, list(distances), camera=camera, **options)]


def operator(camera=SMALL, count=6, **options):
    return mp.CaptureOperator(camera, POSITIONS[:count], **{"wavelength": 633, **options})


def full_fields():
    return operator(TINY, 2, method="full_field")


def signed_rays(**parameters):
    scene = scene_of(sensor(4, 16, **parameters), **bars(240.0))
    return [mp.render_capture(scene, model="wave", method="signed_rays", spp=4).image]


def convolutions():
    made = Convolution(SMALL, [np.ones((5, 5), np.float32), _random_image(9, 9)])
    image = made.forward(_backend.active_backend().arrays.asarray(_random_image(2, made.box.rows, made.box.columns)))
    back = made.adjoint(_random_image(*SMALL.shape))
    return [_backend.active_backend().to_host(part) for part in (image, *back)]


def _random_image(*shape):
    return np.random.default_rng(1).random(shape, dtype=np.float32)


def signed_gradient():
    wall = facing(240.0, 0.2, emitter={"type": "area", "radiance": 1.0})
    scene = scene_of(sensor(4, 8), WAVES, wall=wall)
    parameters, found = mi.traverse(scene), []
    for name in ("wall.emitter.radiance.value", "camera.mla_distance"):
        dr.enable_grad(parameters[name])
        parameters.update()
        image = mi.render(scene, parameters, spp=4)
        dr.backward(dr.sum(dr.square(image), axis=None))
        found.append(np.array(dr.grad(parameters[name]), np.float64).ravel())
        dr.disable_grad(parameters[name])
    return found


def coherent_sums():
    fields = operator(count=20).coherent_fields
    image = fields.intensity(PHASORS)
    samples = {plane: fields.at(PHASORS, plane).samples for plane in ("pupil", "array", "detector")}
    inner = [fields.adjoint(part, plane) for plane, part in samples.items()]
    return [image, *(_backend.active_backend().to_host(part) for part in samples.values()), *inner]


def derivatives():
    ours = operator(TINY, 2)
    changes = {"focal_length": 0.1, "mla_rotation": 0.5, "wavelength": 2.0, "mla_offset": (1e-3, 0)}
    image = ours.derivative(WEIGHTS[:2, 0], changes)
    found = ours.gradient(WEIGHTS[:2, 0], CAPTURE[:64, :64], changes)
    return [image, np.concatenate([np.ravel(found[name]) for name in sorted(found)])]


def refocus_derivatives(interleave):
    at = CoherentRefocus(CAMERA, 235.0, 633.0, interleave=interleave).at(CAPTURE)
    change = at.jvp(CAPTURE[::-1])
    return [change, at.vjp(change)]


WORKS = {
    "step": lambda: [propagate(FIELD, 4e-3, 5.0, 633)],
    "sum of all": lambda: [capture(CAMERA, POSITIONS, WEIGHTS, accuracy=0)],
    "sum of patterns": lambda: [capture(CAMERA, POSITIONS, WEIGHTS - 0.5, accuracy=0.05, pupil_weights=PUPILS)],
    "sum on a turned array": lambda: [capture(TURNED, POSITIONS[:6], WEIGHTS[:6])],
    "full field": lambda: spread(SMALL, POSITIONS[0]),
    "fields": fields,
    "signed rays": signed_rays,
    "signed rays by three focal lengths": lambda: signed_rays(
        mla_lattice="hexagonal", mla_focal_length="0.48, 0.512, 0.55"
    ),
    "coherent sums": coherent_sums,
    "stored operator": lambda: [mp.StoredOperator(TINY, POSITIONS[:3], wavelength=633).forward(WEIGHTS[:3, 0])],
    "full field on a turned array": lambda: spread(TINY.replace(mla_rotation=7.0), POSITIONS[0]),
    "sum of full fields": lambda: [full_fields().forward(WEIGHTS[:2, 0]), full_fields().adjoint(CAPTURE[:64, :64])],
    "convolution": convolutions,
    "copies": lambda: [capture(SMALL, GRID, np.linspace(1, 2, len(GRID))[:, None])],
    "incoherent": lambda: refocused(TINY, [240.0], method="incoherent"),
    "focused camera": lambda: refocused(FOCUSED, [240.0], method="partial"),
    "gradient of signed rays": signed_gradient,
    "derivatives": derivatives,
    "derivatives of a reconstruction": lambda: refocus_derivatives(1),
    "derivatives of subsets": lambda: refocus_derivatives(4),
    "rays": lambda: refocused(method="ray"),
    "coherent": lambda: refocused(method="coherent"),
    "subdivided pixels": lambda: refocused(COARSE, method="coherent"),
    "partially coherent": lambda: refocused(method="partial"),
    "lens by lens": lambda: refocused(method="partial", interleave="auto"),
    **CAMERA_WORKS,
}
ADJOINTS = {
    "adjoint": lambda: [mp.CaptureOperator(CAMERA, POSITIONS, wavelength=633, pupil_weights=PUPILS).adjoint(CAPTURE)],
    "adjoint on a turned array": lambda: [mp.CaptureOperator(TURNED, POSITIONS[:6], wavelength=633).adjoint(CAPTURE)],
    "deconvolved": lambda: refocused(TINY, [253.0], method="deconvolved", iterations=3),
}
HANDED = {
    # The image of the intensity, and of its changes as the pixels move.
    "derivatives": 15_000,
    "gradients by all parameters": 23_000,
    "gradients of copies": 23_000,
    "real lens, gradients": 7_000,
    # Pixels and bins, which NumPy takes from Dr.Jit's tensors.
    "refocusing in Dr.Jit": 11_000,
    # The bins, and the image of each step.
    "deconvolved": 27_000,
    "incoherent": 10_000,
    "planes by rays, deconvolved": 33_000,
    "derivatives of deconvolution": 27_000,
    "Fourier microscope, incoherent": 87_000,
    "Fourier microscope, deconvolved": 134_000,
    # Gradients are brought from the images to the rays by NumPy.
    "gradient of signed rays": 2_300_000,
    "sum of full fields": 12_000,
    # Light and the visible part of the pupil, by which points are chosen.
    "points of a scene": 101_000,
    # Its matrix is one of SciPy's.
    "stored operator": 8_000,
    # The orders of an array that is no product of two axes, and once for each array the shape of its lenses.
    "sum on a turned array": 150_000,
    "signed rays": 2**17 + 30_000,
    "signed rays by three focal lengths": 2**17 + 30_000,
    # The square roots of the bins' intensities, of which the image is the sum.
    "derivatives of a reconstruction": 70_000,
    "derivatives of subsets": 90_000,
}
"""Numbers beside the result that leave the device."""
SCALARS = 48
"""Single numbers that may leave it: what arrived of each batch, of the image and of its white, and guarded powers."""
QUICK = (
    "step", "sum of patterns", "full field", "fields", "convolution", "derivatives of a reconstruction",
    "rays", "subdivided pixels", "lens by lens",
)  # fmt: skip
"""The others are run by `make slow`."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in (*WORKS, *ADJOINTS)]
)
def test_the_device_computes_the_same_and_only_what_is_finished_leaves_it(name, request):
    work = (WORKS | ADJOINTS)[name]
    expected = work()
    device = request.getfixturevalue("device")
    # Sums of gradients cancel, so that their rounding, which depends on where memory lies, is larger.
    error = 5e-5 if "gradients" in name else 1e-5
    for ours, theirs in zip(work(), expected, strict=True):
        assert type(ours) is np.ndarray and ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=error * np.abs(theirs).max())
    # What depends on the camera alone is planned, partly on the host, and kept. Once it is, only results leave.
    device.to_host.clear()
    before = device.scalars
    work()
    finished = sum(array.size for array in expected)
    sizes = [int(np.prod(shape)) for shape in device.to_host]
    assert sum(size for size in sizes if size > SIDE) <= 1.5 * finished + HANDED.get(name, 0)
    assert device.scalars - before <= SCALARS


@pytest.mark.slow
def test_a_sum_goes_on_from_a_checkpoint(device, tmp_path):
    """Written from the device's memory, and taken back into it; threads of a device add in any order."""
    points, path = (CAMERA, POSITIONS, WEIGHTS), tmp_path / "raw.checkpoint"
    whole = capture(*points)
    with pytest.raises(StoppedError), stopped_before(len), mp.Checkpoint(path) as keeper:
        capture(*points, job=mp.Job(keeper=keeper))
    calls = []
    with mp.Checkpoint(path, "resume") as keeper:
        resumed = capture(*points, job=mp.Job(lambda *call: calls.append(call), keeper=keeper))
    assert calls[0][0] > 0
    np.testing.assert_allclose(resumed, whole, rtol=1e-5, atol=1e-6 * whole.max())


def test_without_cupy_waves_on_cuda_are_refused_with_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "cupy", None)
    _backend._cuda.cache_clear()
    with pytest.raises(mp.InputError, match=r"waves on CUDA need CuPy.*pip install cupy-cuda12x"):
        _backend._cuda()


@pytest.mark.parametrize("mistake", [
    lambda _, array: np.asarray(array),
    lambda _, array: array[np.arange(2)],
    lambda libraries, array: libraries.arrays.multiply(array, array, out=np.ones(3)),
    lambda libraries, _: libraries.transforms.set_workers,
    lambda _, array: array.tolist(),
])  # fmt: skip
def test_the_stand_in_refuses_to_mix_lacks_what_cupy_lacks_and_counts_what_leaves(mistake):
    stand_in = device_stand_in.StandIn()
    with pytest.raises((TypeError, AttributeError)):
        mistake(stand_in.backend, stand_in.backend.arrays.zeros(3))
    one = stand_in.backend.arrays.ones(3)
    assert float(one[0]) == int(one.sum()) / 3 == 1 and bool(one.all())
    assert stand_in.scalars == 3 and not stand_in.to_host
    assert (stand_in.backend.to_host(one) == 1).all() and stand_in.to_host == [(3,)]


def test_cupy_has_what_the_stand_in_has():
    """Where CuPy is installed, with or without a device."""
    cupy = pytest.importorskip("cupy")
    transforms = pytest.importorskip("cupyx.scipy.fft")
    found = {"functions": cupy, "methods": cupy.ndarray, "transforms": transforms, "ufunc methods": cupy.add}
    for title, names in device_stand_in.NAMES.items():
        assert not {name for name in names if not hasattr(found[title], name)}, title


needs_device = pytest.mark.skipif(not dr.has_backend(dr.JitBackend.CUDA), reason="no CUDA device")


@pytest.mark.gpu
@needs_device
@pytest.mark.parametrize("work", (WORKS | ADJOINTS).values(), ids=WORKS | ADJOINTS)
def test_cuda_agrees_with_the_processor(work):
    pytest.importorskip("cupy")
    expected = work()
    mi.set_variant("cuda_ad_mono")
    for ours, theirs in zip(work(), expected, strict=True):
        assert np.linalg.norm(ours - theirs) <= 1e-4 * np.linalg.norm(theirs)


def scene_capture(scene, model, variant, seed):
    """Capture a scene of few pixels with its noise."""
    device_stand_in.forget()
    loaded = mp.load_scene(scene, variant=variant, parameters={"resolution": "512"})
    return mp.render_capture(loaded, model=model, spp=16, seed=seed, noise=True)


@pytest.mark.gpu
@needs_device
@pytest.mark.parametrize("model", ["ray", "wave"])
@pytest.mark.parametrize("scene", ["letters", "still_life", "vitrine"])
def test_captures_of_other_seeds_differ_by_their_noise(scene, model):
    """Means by a thousandth beside three standard deviations; pixels by their estimated noise, within a tenth."""
    ours = scene_capture(scene, model, "cuda_ad_mono", 1)
    theirs = scene_capture(scene, model, "llvm_ad_mono", 2)
    sigma = np.hypot(*(np.sqrt(np.sum(each.noise**2)) / each.image.sum() for each in (ours, theirs)))
    assert abs(ours.image.mean() / theirs.image.mean() - 1) <= 1e-3 + 3 * sigma
    difference = np.linalg.norm((ours.image - theirs.image).astype(float))
    assert difference / np.linalg.norm(np.hypot(ours.noise, theirs.noise)) == pytest.approx(1, abs=0.1)
