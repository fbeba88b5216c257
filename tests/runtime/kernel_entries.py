"""The kernels of everything that hands NumPy's memory to Dr.Jit, with all of this memory aligned or none of it.

Run as a module with 0, for arrays at multiples of 64 bytes, or another number, and the names of entries; prints the
kernels of each as JSON. A handler (NEP 49) places all arrays of NumPy, whoever makes them: this package, SciPy, or
Dr.Jit when it converts numbers.
"""

import ctypes
import json
import os
import sys
import threading
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.optics.waves import propagate

_SIZE, _POINTER = ctypes.c_size_t, ctypes.c_void_p
_CALLS = (
    ("malloc", ctypes.CFUNCTYPE(_POINTER, _POINTER, _SIZE)),
    ("calloc", ctypes.CFUNCTYPE(_POINTER, _POINTER, _SIZE, _SIZE)),
    ("realloc", ctypes.CFUNCTYPE(_POINTER, _POINTER, _POINTER, _SIZE)),
    ("free", _POINTER),
)


class _Allocator(ctypes.Structure):
    """Functions of an allocator, of Python's and of NumPy's alike."""

    _fields_ = (("context", _POINTER), *_CALLS)


class _Handler(ctypes.Structure):
    """PyDataMem_Handler."""

    _fields_ = (("name", ctypes.c_char * 127), ("version", ctypes.c_uint8), ("allocator", _Allocator))


def put_arrays_at(offset):
    """Have NumPy lay all of its arrays at multiples of 64 bytes, or none; return what must be kept for it."""
    libc, api = ctypes.CDLL(None), ctypes.pythonapi
    for name, result, arguments in (
        ("malloc", _POINTER, [_SIZE]),
        ("aligned_alloc", _POINTER, [_SIZE, _SIZE]),
        ("free", None, [_POINTER]),
        ("malloc_usable_size", _SIZE, [_POINTER]),
    ):
        function = getattr(libc, name)
        function.restype, function.argtypes = result, arguments

    def malloc(_, size):
        # Large arrays have pages of the system's, which begin with a header of 16 bytes: none of them is ever aligned.
        if offset == 0:
            return libc.aligned_alloc(64, size)
        # Every other offset is as unaligned as the next; to wait for a certain one may take all memory.
        others, place = [], libc.malloc(size)
        while place and place % 64 == 0:
            others.append(place)
            place = libc.malloc(size + 16 * (len(others) % 4))
        for each in others:
            libc.free(each)
        return place

    def calloc(_, count, size):
        place = malloc(_, count * size)
        if place:
            ctypes.memset(place, 0, count * size)
        return place

    def realloc(_, old, size):
        place = malloc(_, size)
        if old:
            ctypes.memmove(place, old, min(size, libc.malloc_usable_size(old)))
            libc.free(old)
        return place

    # Python's own function frees memory: one in Python would be called while exceptions are on their way.
    python = _Allocator()
    api.PyMem_GetAllocator(0, ctypes.byref(python))
    functions = [kind(function) for (_, kind), function in zip(_CALLS, (malloc, calloc, realloc), strict=False)]
    handler = _Handler(b"offset", 1, _Allocator(None, *functions, python.free))
    api.PyCapsule_New.restype, api.PyCapsule_New.argtypes = ctypes.py_object, [_POINTER, ctypes.c_char_p, _POINTER]
    api.PyCapsule_GetPointer.restype = _POINTER
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    functions_of_numpy = api.PyCapsule_GetPointer(np._core._multiarray_umath._ARRAY_API, None)
    # PyDataMem_SetHandler, whose place in NumPy's table never changes.
    set_handler = ctypes.cast(functions_of_numpy, ctypes.POINTER(_POINTER))[304]
    name = b"mem_handler"
    capsule = api.PyCapsule_New(ctypes.addressof(handler), name, None)
    put = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)(set_handler)
    put(capsule)
    # Each thread starts without a handler.
    run = threading.Thread.run

    def placed(thread):
        put(capsule)
        run(thread)

    threading.Thread.run = placed
    return handler, name, capsule


CAMERA = mp.PlenopticCamera(resolution=(64, 64), detector_width=0.128)
POINTS = np.array([(0.01, -0.02, 215.0), (-0.03, 0.02, 240.0)])


def chance(*shape):
    """Return the same random numbers every time."""
    return np.random.default_rng(0).random(shape, np.float32)


def scene_of(camera):
    """Load a scene of a textured wall and a lamp behind the camera."""
    place = mi.ScalarTransform4f().translate([0, 0, camera.focus_distance]).rotate([0, 1, 0], 180)
    lamp = mi.ScalarTransform4f().translate([0, 0, -100]).scale(50)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(chance(8, 8, 1)), "raw": True}
    loaded = mp.load_scene(
        {
            "type": "scene",
            "integrator": {"type": "path"},
            "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": 5.0}},
            "wall": {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": texture}},
            "camera": camera.to_sensor(),
        }
    )
    # Mitsuba's threads load the parts of a scene together, whose kernels are one or several as they come.
    dr.kernel_history_clear()
    return loaded


def capture(camera, **options):
    """Render a capture of the wall."""
    return mp.render_capture(scene_of(camera), spp=4, seed=1, **options)


def phone():
    """Return a camera of lenses of a few wavelengths, and the photodiodes below them."""
    return mp.PlenopticCamera.preset("phone_quad").replace(crop_offset=(4000, 2992), crop_size=(8, 8))


def step():
    """Make a step of a training loop."""
    from mitsuba_plenoptic.array_functions import CameraCapture

    camera = CAMERA.replace(mla_lattice="hexagonal")
    function = CameraCapture(lambda made: mp.CaptureOperator(made, POINTS, wavelength=633), camera, ("mla_offset",))
    made = function.at(np.ones(2), np.array((0.001, 0.002)))
    made.vjp(2 * made.value, [True, True])


def differentiated(**integrator):
    """Differentiate a rendering by the wall's texture."""
    from mitsuba_plenoptic.scene_functions import RenderedValue, Rendering

    scene = scene_of(CAMERA)
    child = {"type": "prb"}
    made = mi.load_dict(child if not integrator else integrator | {"child": child})
    key = next(name for name, _ in mi.traverse(scene) if name.endswith("reflectance.data"))
    function = RenderedValue(Rendering(scene, {key: (8, 8, 1)}, integrator=made, spp=4, seed=0), [chance(8, 8, 1)])
    function.vjp(2 * np.array(function.value), [True])


def seen(method):
    """Sum the spreads of points, and take a picture back to them."""
    operator = mp.CaptureOperator(CAMERA, POINTS, wavelength=633, method=method)
    operator.adjoint(operator.forward(np.ones(2)))


def reconstructed(method, **options):
    """Reconstruct two planes from a capture."""
    made = mp.Capture(chance(*CAMERA.shape), CAMERA, 633, "wave")
    mp.reconstruct(made, distance=[119.0, 126.0], method=method, **options)


def fitted():
    """Fit the array's distance to a picture of points."""
    image = mp.CaptureOperator(CAMERA, POINTS, wavelength=633).forward(np.ones(2))
    mp.fit(CAMERA, mp.fitting.View(image, POINTS, np.ones(2)), "mla_distance", wavelength=633, photons=1e4, model="ray")


def layers_fitted():
    """Fit the texels of a plane to a capture."""
    start = mp.fitting.Layers([120.0], [0.3], chance(1, 8, 8), np.full((1, 8, 8), 0.5))
    made = mp.Capture(chance(*CAMERA.shape), CAMERA)
    mp.fitting.fit_layers([made], [mi.ScalarTransform4f()], start, rounds=2, spp=4)


def laser():
    """Render the speckle of a laser spot on a wall."""
    scene = mp.load_scene("speckle", parameters={"detector_width": "0.128", "resolution": "64"})
    dr.kernel_history_clear()
    mp.render_capture(scene, spp=1, seed=1)


def propagated(size):
    """Propagate a field in NumPy's memory."""
    propagate(chance(size, size).astype(np.complex64), 0.01, 5.0, 633.0)


QUICK = {
    "ray capture": lambda: capture(CAMERA),
    "wave capture": lambda: capture(CAMERA, model="wave", wavelength=633),
    "wave capture by points": lambda: capture(CAMERA, model="wave", wavelength=633, method="points"),
    "ground truth": lambda: mp.ground_truth(scene_of(CAMERA)),
    "patches": lambda: seen("patch"),
    "ray": lambda: reconstructed("ray"),
    "coherent": lambda: reconstructed("coherent"),
    "partial": lambda: reconstructed("partial"),
    "small field": lambda: propagated(64),
    "large field": lambda: propagated(512),
}
SLOW = {
    "full fields": lambda: seen("full_field"),
    "incoherent": lambda: reconstructed("incoherent"),
    "deconvolved": lambda: reconstructed("deconvolved", iterations=2),
}
OF_EXTENSIONS = {
    "ray capture of photodiodes": lambda: capture(phone()),
    "bank of photodiodes": lambda: mp.psf_bank(phone(), [1000.0]),
    "training step": step,
    "gradient by rays": differentiated,
    "gradient by waves": lambda: differentiated(type="plenoptic_wave", wavelength=633),
    "fit": fitted,
    "fit of layers": layers_fitted,
}
SLOW_OF_EXTENSIONS = {
    "wave capture of photodiodes": lambda: capture(phone(), model="wave", wavelength=550),
    "laser": laser,
}


def main():
    kept = put_arrays_at(int(sys.argv[1]))
    assert (np.empty(1000, np.uint8).ctypes.data % 64 == 0) == (sys.argv[1] == "0")
    mi.set_variant("llvm_ad_mono")
    warnings.simplefilter("ignore")
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    found = {}
    for name in sys.argv[2:]:
        dr.kernel_history_clear()
        (QUICK | SLOW | OF_EXTENSIONS | SLOW_OF_EXTENSIONS)[name]()
        found[name] = sorted({each["hash"] for each in dr.kernel_history() if each["type"] == dr.KernelType.JIT})
    print(json.dumps(found), flush=True)
    # Arrays outlive the functions that free their memory.
    del kept
    os._exit(0)


if __name__ == "__main__":
    main()
