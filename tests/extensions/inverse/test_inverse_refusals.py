"""What fits, designs, volumes and differentiable functions refuse: a call, or what it is given, and words."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import HALF, WAVELENGTH, scattered, small_camera
from refusals import refused, refuses

from mitsuba_plenoptic import Capture, Detector, PlenopticCamera, StoredOperator, expose, fit, volume_points
from mitsuba_plenoptic.extensions.inverse.point_rays import PointRays, vector_of
from mitsuba_plenoptic.fitting import View, coarse_fit, noise_of
from mitsuba_plenoptic.optimisation import DepthInformation, RefocusedContrast, maximise
from mitsuba_plenoptic.refocus import CoherentRefocus, DeconvolvedRefocus, RayRefocus
from mitsuba_plenoptic.views import white_image

CAMERA = small_camera(2)
TRUE = small_camera(2, **HALF)
POINTS = scattered(5, distances=(112.0, 128.0), image=0.05)
POINT = [(0.03, 0.01, 116.0)]
ONES = np.ones(len(POINTS))
BY_WAVES = CoherentRefocus(CAMERA, 225.0, WAVELENGTH)
HALVES = small_camera(4, **HALF, detector_distance=0.512, wavefront=(*(0.0,) * 10, 0.05))


def by_rays(camera=CAMERA, distance=225.0, **options):
    return RayRefocus(camera, distance, **options)


def view(image=1.0, weights=ONES, noise=None, **options):
    return View(np.broadcast_to(image, TRUE.shape), POINTS, weights, noise, **options)


def fitted(names="mla_pitch", seen=None, camera=TRUE, **options):
    return fit(camera, view() if seen is None else seen, names, **{"photons": 2000.0} | options)


def negative():
    image = np.ones(TRUE.shape)
    image[3, 5] = -0.2
    return image


def of_noise():
    seen = expose(Capture(np.zeros(TRUE.shape), TRUE), Detector(read_noise=3.0), photons=2000.0, seed=4)
    assert seen.image.max() > 0
    return fitted(seen=view(seen.image, noise=noise_of(seen)[0]), photons=None)


def followed(point=(0.0, 0.0, 120.0), **numbers):
    return PointRays(small_camera(2, **HALF, **numbers), np.array([point]), WAVELENGTH)


def contrast(frequencies=(0.5,), points=POINT):
    return RefocusedContrast(HALVES, points, frequencies)


def hill(bounds):
    return maximise(contrast(), HALVES, bounds)


test_refusals_of_refocusing = refused(
    (lambda: by_rays(footprint="disc"), "footprint = 'disc'"),
    (lambda: by_rays().forward(np.zeros((3, 3))), r"capture of shape \(3, 3\)"),
    (lambda: by_rays().adjoint(np.zeros((5, 3))), r"bins of shape \(5, 3\)"),
    (lambda: BY_WAVES.gradient(white_image(CAMERA), np.zeros((2, 2, 2))), "image_gradient of 2 channels"),
    (lambda: DeconvolvedRefocus(CAMERA.replace(main_lens="tessar"), 250.0), "^wavelength = None: .* must be stated"),
    (lambda: DeconvolvedRefocus(CAMERA, 250.0).forward(np.zeros(CAMERA.shape)), "^capture: none of its pixels is lit"),
)

test_refusals_of_fits = refused(
    (lambda: fitted("mla_distance", view(np.zeros(TRUE.shape))), "image: it is black"),
    (lambda: coarse_fit(TRUE, view(np.full(TRUE.shape, -0.1)), "mla_distance"), "image: it is black"),
    (of_noise, "image: it is black"),
    (lambda: fitted(seen=view(negative())), r"image: 1 of its pixels .* -0\.2, at \(3, 5\)"),
    (lambda: fitted(seen=view(negative(), mask=negative() < 0, saturation=0.5)), "image: all of its pixels"),
    (lambda: view(weights=[1, -2, 3, 4, 5]), r"weights\[1\] = -2: "),
    (lambda: view(mask=negative()), "mask of type float64"),
    (lambda: View(np.zeros((4, 4, 3)), POINTS, ONES), "one channel"),
    (lambda: view(weights=np.ones(2)), "weights of shape"),
    (lambda: fitted(seen=View(np.zeros((3, 3)), POINTS, ONES)), "the camera records"),
    (lambda: fitted(camera=PlenopticCamera.preset("lfm"), wavelength=WAVELENGTH), "fits of cameras refuse it"),
    (lambda: fitted("wavelength"), "wavelength: "),
    (lambda: fitted("wavefront"), "wavefront: the camera has no coefficients"),
    (lambda: vector_of(TRUE.replace(wavefront=(0.0,) * 6), "wavefront.7"), "wavefront.7': .* wavefront.2, "),
    (lambda: fitted("mla_fill", model="ray"), "mla_fill: "),
    (lambda: fitted(model="ray", accuracy=0.1), "accuracy = 0.1: "),
    (lambda: fitted(photons=None), "photons: "),
    (lambda: fitted(bounds={"mla_pitch": (0.07, 0.08)}), "bounds: mla_pitch starts at 0.064: "),
    (lambda: fitted(bounds={"mla_pitch": (1, 0)}), "bounds: mla_pitch = "),
    (lambda: followed(mla_fill=0.8), "mla_fill = 0.8"),
    (lambda: followed(mla_tilt=(0.1, 0.0)), r"mla_tilt = \(0.1, 0.0\): "),
    *(
        (
            lambda g=g: PointRays(PlenopticCamera(), np.array([(0.0, 0.0, g)]), WAVELENGTH),
            r"position = \(0, 0, .*\): its light would cover .* microlenses .* in metres\?$",
        )
        for g in (0.24, 10.0)
    ),
)

test_refusals_of_designs_and_volumes = refused(
    (lambda: hill({}), "bounds: "),
    (lambda: hill({"mla_focal_length": (0.6, 0.5)}), "bounds: .*mla_focal_length.* the lowest and the highest"),
    (lambda: hill({"wavefront": (-1, 1), "wavefront.5": (-1, 1)}), "bounds: a parameter has two"),
    (lambda: contrast().gradient(HALVES, ["mla_pitch"]), "mla_pitch: "),
    (lambda: contrast().value(HALVES.replace(focal_length=41.0)), r"focal_length = 41\.0: .* 40\.0"),
    (lambda: contrast(points=[(90.0, 0.0, 116.0)]).value(HALVES), "points: one of them sends no light"),
    (lambda: DepthInformation(POINT, 1e4, method="full_field", accuracy=0.02), r"accuracy = 0\.02: .* full_field"),
    (lambda: volume_points(np.ones((2, 2)), (0, 0, 0), (1, 1, 1)), r"values of shape \(2, 2\)"),
    (lambda: volume_points(np.full((1, 1, 1), np.nan), (0, 0, 0), (1, 1, 1)), "it must be finite"),
    (lambda: StoredOperator(TRUE, POINTS, wavelength=WAVELENGTH, budget=1e-7).forward(ONES), "^budget = 1e-07 GiB: "),
)


def test_refusals_of_variants_names_and_memory(monkeypatch):
    with pytest.raises(TypeError, match="did you mean wavelength"):
        StoredOperator(TRUE, POINTS, wavelenght=WAVELENGTH)
    mi.set_variant("llvm_ad_rgb")
    refocus = DeconvolvedRefocus(CAMERA, 250.0, iterations=4)
    monkeypatch.setattr("mitsuba_plenoptic.runtime.limits.MEMORY_LIMIT", 3e4)
    refuses(r"^derivatives of 4 steps in 1 channels[^\n]*$", refocus.forward, np.ones(CAMERA.shape))
