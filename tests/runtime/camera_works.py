"""Works of `test_cuda` for cameras and options of other kinds, which run what the paper's camera does not."""

import drjit as dr
import mitsuba as mi
import numpy as np
from cameras import HALF, small_camera
from cases import bars, scene_of, sensor

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.extensions.inverse.differentiable import CoherentRefocus, DeconvolvedRefocus, RayRefocus
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.arrival import SampledField
from mitsuba_plenoptic.points.full_field import full_field
from mitsuba_plenoptic.points.point_spread import point_fields

WAVELENGTH = 550.0
HALVED = small_camera(2, **HALF)
REAL = small_camera(2, main_lens="double_gauss", **HALF)
_MICROSCOPE = {
    "main_lens": mp.Objective(20, 0.5),
    "mla_pitch": 0.15,
    "mla_focal_length": 3.0,
    "mla_offset": (0.075, 0.075),
    "detector_width": 0.45,
    "resolution": (45, 45),
}
MICROSCOPE = mp.PlenopticCamera(**_MICROSCOPE)
FOURIER = mp.PlenopticCamera(
    main_lens=mp.Objective(20, 0.25, arrangement="fourier", fourier_focal_length=50),
    mla_pitch=0.5,
    mla_focal_length=20.0,
    mla_offset=(0.25, 0.25),
    detector_width=1.5,
    resolution=(150, 150),
)
TABLE = np.random.default_rng(3).uniform(0.2, 1.3, (3, 3))
POINT = (0.03, -0.02, 115.0)
POINTS = np.array([POINT, (-0.04, 0.01, 122.0)])
COPIES = np.array([(0.064 * i, 0.064 * j, 120.0) for i in range(-13, 13) for j in range(-13, 13)])
"""Enough points for derivatives to share spreads."""


def image_of(camera):
    """Return a capture with light everywhere."""
    return np.random.default_rng(4).random(camera.shape, dtype=np.float32)


def spread(camera, point=POINT, **options):
    return [mp.point_spread_function(camera, point, wavelength=WAVELENGTH, method="full_field", **options)]


def fields_of(camera, point):
    planes = point_fields(camera, np.array(point), wavelength=WAVELENGTH)
    return [planes.pupil.samples, planes.mla.samples, planes.detector.samples]


def refocused(camera, distance, method, **options):
    image = options.pop("image", image_of(camera))
    return [mp.reconstruct(image, distance, camera=camera, method=method, **options).image]


def gradients(camera, names, points=POINTS, **options):
    operator, weights = (
        mp.CaptureOperator(camera, points, wavelength=WAVELENGTH, **options),
        np.linspace(1, 2, len(points)),
    )
    found = operator.gradient(weights, image_of(camera), names)
    change = operator.derivative(weights, {name: np.ones_like(found[name]) * 1e-3 for name in found})
    return [change, *(np.atleast_1d(found[name]) / np.abs(found[name]).max() for name in found if found[name].any())]


def far_light(camera, radius, depth=np.inf):
    """Return the capture of a point's wave with a smooth aperture, given by samples on the pupil."""
    place = np.linspace(-1, 1, 96) * radius
    falloff = np.exp(-4 * (place / radius) ** 2).astype(np.complex64)
    incident = SampledField(np.outer(falloff, falloff), (place[0], place[0]), place[1] - place[0])
    system = OpticalSystem(camera.at_wavelength(WAVELENGTH), WAVELENGTH)
    return [full_field(system, np.array([0.0, 0.0, depth]), incident=incident)]


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


WORKS = {
    "microscope, full field": lambda: spread(MICROSCOPE, (0.001, 0.0, 0.02)),
    "microscope, patches": lambda: [
        mp.CaptureOperator(MICROSCOPE, [(0.001, 0.0, 0.02)], wavelength=WAVELENGTH).forward([1.0])
    ],
    "microscope, fields": lambda: fields_of(MICROSCOPE, (0.001, 0.0, 0.02)),
    "Fourier microscope, full field": lambda: spread(FOURIER, (0.001, 0.0, 0.02)),
    "Fourier microscope, incoherent": lambda: refocused(FOURIER, 0.0, "incoherent", wavelength=WAVELENGTH),
    "Fourier microscope, deconvolved": lambda: refocused(
        FOURIER, 0.01, "deconvolved", wavelength=WAVELENGTH, iterations=2
    ),
    "irregular lenses, full field": lambda: spread(HALVED.replace(mla_jitter=(1e-3, 1e-3))),
    "gaps, full field": lambda: spread(HALVED.replace(mla_fill=0.8)),
    "unequal lenses, full field": lambda: spread(HALVED.replace(mla_transmissions=TABLE)),
    "unequal lenses, patches": lambda: [
        mp.CaptureOperator(HALVED.replace(mla_transmissions=TABLE), POINTS, wavelength=WAVELENGTH).forward([1.0, 2.0])
    ],
    "vignetting, full field": lambda: spread(HALVED.replace(vignetting=mp.Vignetting(30.0, 4.0))),
    "real lens, full field": lambda: spread(REAL),
    "real lens, gradients": lambda: gradients(REAL, ("focal_length", "wavefront", "wavelength")),
    "gradients by all parameters": lambda: gradients(HALVED, None),
    "gradients of a turned array": lambda: gradients(
        HALVED.replace(mla_rotation=7.0), ("mla_pitch", "mla_offset", "mla_focal_length", "mla_fill")
    ),
    "gradients of copies": lambda: gradients(
        HALVED, ("mla_distance", "mla_rotation", "detector_width"), points=COPIES, accuracy=0.05
    ),
    "far light, full field": lambda: far_light(HALVED, 2.0),
    "far light, Fourier microscope": lambda: far_light(FOURIER, 2.0, 0.0),
    "coherent field": lambda: coherent_field(HALVED),
    "turned array, coherent": lambda: refocused(
        HALVED.replace(mla_rotation=7.0), 118.0, "coherent", wavelength=WAVELENGTH
    ),
    "coarse pixels, deconvolved": lambda: refocused(
        HALVED.replace(resolution=(20, 20)), 118.0, "deconvolved", wavelength=WAVELENGTH, iterations=2
    ),
    "refocusing in Dr.Jit": lambda: in_drjit(CoherentRefocus(HALVED, 118.0, WAVELENGTH)),
    "real lens, coherent": lambda: refocused(REAL, 118.0, "coherent", wavelength=WAVELENGTH),
    "negative pixels, lens by lens": lambda: refocused(
        HALVED,
        118.0,
        "partial",
        wavelength=WAVELENGTH,
        interleave="auto",
        oversample=2,
        image=image_of(HALVED) - np.float32(0.02),
    ),
    "white capture, coherent": lambda: refocused(
        HALVED,
        118.0,
        "coherent",
        wavelength=WAVELENGTH,
        image=mp.Capture(image_of(HALVED), HALVED),
        white=mp.Capture(0.5 + image_of(HALVED), HALVED),
    ),
    "estimate of signed rays": lambda: [
        np.zeros(1, np.float32)
        * mp.estimate_capture(scene_of(sensor(4, 8), **bars(240.0)), model="wave", spp=2).seconds
    ],
    "points of a scene": lambda: [
        mp.render_capture(scene_of(sensor(4, 8), **bars(240.0)), model="wave", method="points", spp=2).image
    ],
    "planes by rays, deconvolved": lambda: [
        part.image
        for part in mp.reconstruct(image_of(HALVED), [116.0, 124.0], camera=HALVED, method="deconvolved", iterations=2)
    ],
    "derivatives of deconvolution": lambda: of_refocus(DeconvolvedRefocus(HALVED, 118.0, WAVELENGTH, iterations=2)),
    "derivatives of refocusing by rays": lambda: of_refocus(RayRefocus(HALVED, 118.0)),
}
