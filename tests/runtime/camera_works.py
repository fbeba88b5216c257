"""Works of `test_cuda` for cameras and options of other kinds, which run what the paper's camera does not."""

import drjit as dr
import mitsuba as mi
import numpy as np
from cameras import HALF, small_camera
from cases import bars, scene_of, sensor

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.extensions.inverse.differentiable import CoherentRefocus, DeconvolvedRefocus, RayRefocus
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points.arrival import SampledField
from mitsuba_plenoptic.points.full_fields import full_field

WAVELENGTH = 550.0
HALVED = small_camera(2, **HALF)
REAL = small_camera(2, main_lens="double_gauss", **HALF)
MICROSCOPE = mp.PlenopticCamera(
    main_lens=mp.Objective(20, 0.5), mla_pitch=0.15, mla_focal_length=3.0, mla_offset=(0.075, 0.075),
    detector_width=0.45, resolution=(45, 45),
)  # fmt: skip
FOURIER = mp.PlenopticCamera(
    main_lens=mp.Objective(20, 0.25, arrangement="fourier", fourier_focal_length=50), mla_pitch=0.5,
    mla_focal_length=20.0, mla_offset=(0.25, 0.25), detector_width=1.5, resolution=(150, 150),
)  # fmt: skip
TABLE = np.random.default_rng(3).uniform(0.2, 1.3, (3, 3))
POINT, NEAR = (0.03, -0.02, 115.0), (0.001, 0.0, 0.02)
POINTS = np.array([POINT, (-0.04, 0.01, 122.0)])
COPIES = np.array([(0.064 * i, 0.064 * j, 120.0) for i in range(-13, 13) for j in range(-13, 13)])
"""Enough points for derivatives to share spreads."""


def image_of(camera):
    """Return a capture with light everywhere."""
    return np.random.default_rng(4).random(camera.shape, dtype=np.float32)


def spread(camera, point=POINT):
    return [mp.point_spread_function(camera, point, wavelength=WAVELENGTH, method="full_field")]


def refocused(camera, method, distance=118.0, image=None, wavelength=WAVELENGTH, **options):
    image, options = image_of(camera) if image is None else image, {"wavelength": wavelength} | options
    return [mp.reconstruct(image, distance, camera=camera, method=method, **options).image]


def gradients(camera, names, points=POINTS, **options):
    operator = mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, **options)
    weights = np.linspace(1, 2, len(points))
    found = operator.gradient(weights, image_of(camera), names)
    change = operator.derivative(weights, {name: np.ones_like(found[name]) * 1e-3 for name in found})
    return [change, *(np.atleast_1d(found[name]) / np.abs(found[name]).max() for name in found if found[name].any())]


def far_light(camera, radius):
    """Return the capture of a point's wave with a smooth aperture, given by samples on the pupil."""
    place = np.linspace(-1, 1, 96) * radius
    falloff = np.exp(-4 * (place / radius) ** 2).astype(np.complex64)
    incident = SampledField(np.outer(falloff, falloff), (place[0], place[0]), place[1] - place[0])
    system = OpticalSystem(camera.at_wavelength(WAVELENGTH), WAVELENGTH)
    return [full_field(system, np.array([0.0, 0.0, np.inf]), incident=incident)]


def coherent_field(camera):
    operator = mp.CaptureOperator(camera, POINTS, wavelength=WAVELENGTH)
    field = operator.field([1, 1j])
    return [field.samples, operator.field_adjoint(field.samples)]


def in_drjit(refocus):
    """Return the gradient of a refocused tensor's norm, and its change along another one."""
    pixels = mi.TensorXf(image_of(refocus.camera))
    dr.enable_grad(pixels)
    dr.backward(dr.sum(dr.square(refocus(pixels)), axis=None))
    gradient = np.array(dr.grad(pixels))
    moved = mi.TensorXf(image_of(refocus.camera))
    dr.enable_grad(moved)
    dr.set_grad(moved, moved)
    return [gradient, np.array(dr.forward_to(refocus(moved)))]


def of_refocus(refocus):
    image = image_of(refocus.camera)
    found = refocus.at(image) if isinstance(refocus, DeconvolvedRefocus) else refocus
    if isinstance(refocus, RayRefocus):
        return [refocus.forward(image), refocus.adjoint(np.ones(refocus.shape))]
    return [refocus.forward(image), found.jvp(image[::-1]), found.vjp(np.ones(refocus.shape)).astype(np.float32)]


TURNED = HALVED.replace(mla_rotation=7.0)
OF_ARRAY = ("mla_pitch", "mla_offset", "mla_focal_length", "mla_fill")
NEGATIVE = {"interleave": "auto", "oversample": 2, "image": image_of(HALVED) - np.float32(0.02)}
WITH_WHITE = {"image": mp.Capture(image_of(HALVED), HALVED), "white": mp.Capture(0.5 + image_of(HALVED), HALVED)}


def planes():
    parts = mp.reconstruct(image_of(HALVED), [116.0, 124.0], camera=HALVED, method="deconvolved", iterations=2)
    return [part.image for part in parts]


def of_scene():
    return [mp.render_capture(scene_of(sensor(4, 8), **bars(240.0)), model="wave", method="points", spp=2).image]


WORKS = {
    "microscope, full field": lambda: spread(MICROSCOPE, NEAR),
    "Fourier microscope, incoherent": lambda: refocused(FOURIER, "incoherent", 0.0),
    "Fourier microscope, deconvolved": lambda: refocused(FOURIER, "deconvolved", 0.01, iterations=2),
    "irregular lenses, full field": lambda: spread(HALVED.replace(mla_jitter=(1e-3, 1e-3))),
    "unequal lenses, patches": lambda: [
        mp.CaptureOperator(HALVED.replace(mla_transmissions=TABLE), POINTS, wavelength=WAVELENGTH).forward([1.0, 2.0])
    ],
    "vignetting, full field": lambda: spread(HALVED.replace(vignetting=mp.Vignetting(30.0, 4.0))),
    "real lens, gradients": lambda: gradients(REAL, ("focal_length", "wavefront", "wavelength")),
    "real lens, coherent": lambda: refocused(REAL, "coherent"),
    "gradients by all parameters": lambda: gradients(HALVED, None),
    "gradients of a turned array": lambda: gradients(TURNED, OF_ARRAY),
    "gradients of copies": lambda: gradients(
        HALVED, ("mla_distance", "mla_rotation", "detector_width"), points=COPIES, accuracy=0.05
    ),
    "far light, full field": lambda: far_light(HALVED, 2.0),
    "coherent field": lambda: coherent_field(HALVED),
    "coarse pixels, deconvolved": lambda: refocused(HALVED.replace(resolution=(20, 20)), "deconvolved", iterations=2),
    "negative pixels, lens by lens": lambda: refocused(HALVED, "partial", **NEGATIVE),
    "white capture, coherent": lambda: refocused(HALVED, "coherent", **WITH_WHITE),
    "planes by rays, deconvolved": planes,
    "refocusing in Dr.Jit": lambda: in_drjit(CoherentRefocus(HALVED, 118.0, WAVELENGTH)),
    "derivatives of deconvolution": lambda: of_refocus(DeconvolvedRefocus(HALVED, 118.0, WAVELENGTH, iterations=2)),
    "derivatives of refocusing by rays": lambda: of_refocus(RayRefocus(HALVED, 118.0)),
    "points of a scene": of_scene,
}
