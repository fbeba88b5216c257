"""What reconstructions and their white pictures refuse."""

import functools
import math

import mitsuba as mi
import numpy as np
import pytest
from cameras import CAMERAS, HALF, WAVELENGTH, small_camera

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.refocus import Volume
from mitsuba_plenoptic.refocus.conjugates import RealConjugates
from mitsuba_plenoptic.views import white_image
from refusals import refused, refuses

SMALL = mp.PlenopticCamera(detector_width=0.128, resolution=(64, 64))
NARROW = {"mla_pitch": 0.001, "mla_rotation": 71.67, "mla_aperture": "circle", "mla_fill": 0.51}
SHORT = mp.PlenopticCamera(detector_width=0.128, resolution=(16, 1), detector_distance=0.58)
NEEDS_DECONVOLUTION = pytest.mark.needs_extension("deconvolution")


def refocused(camera=SMALL, **changes):
    """Refocus even light by rays, with some arguments changed."""
    given = {"capture": np.ones(camera.shape), "distance": 240.0, "camera": camera} | changes
    return mp.reconstruct(**given)


def by_waves(camera=SMALL, **changes):
    return refocused(camera, **{"method": "partial", "wavelength": WAVELENGTH} | changes)


def magnified(distance=0.01, **options):
    capture = mp.Capture(np.ones((75, 75), np.float32), CAMERAS["microscope"], 550.0, "wave", {})
    return mp.reconstruct(capture, distance, **options)


def resolved(distance, wavelength=None):
    return mp.design.effective_resolution(SMALL, distance, wavelength)


def planes(*distances):
    """Gather planes in a volume."""
    image = np.ones((6, 6), np.float32)
    return Volume.of([mp.Reconstruction(image, g, SMALL.bin_size(g), "deconvolved", SMALL) for g in distances])


test_refused = refused(
    (lambda: refocused(distance=[240.0, math.nan]), "distance = nan"),
    (lambda: mp.reconstruct(np.ones((64, 64)), 240.0, camera=None), "camera"),
    (lambda: refocused(capture=np.ones((3, 3))), "the camera records 64 rows"),
    (lambda: by_waves(wavelength=None), "wavelength = None"),
    (lambda: by_waves(wavelength=(500, 600)), "the capture has 1 channels"),
    (lambda: by_waves(interleave=3), "interleave = 3: .*1 to 2"),
    (lambda: by_waves(oversample=0), "oversample = 0"),
    (lambda: refocused(SHORT, distance=160.0), "no light comes from any of the 4 bins there"),
    pytest.param(
        lambda: magnified(method="deconvolved", response="ray"),
        r"response = ray: .*main_lens = 20x/0\.5 objective",
        marks=NEEDS_DECONVOLUTION,
    ),
    pytest.param(lambda: magnified(-10, method="deconvolved"), "distance = -10", marks=NEEDS_DECONVOLUTION),
    (lambda: RealConjugates.of(OpticalSystem(CAMERAS["real"], WAVELENGTH), [120.0, 12.0], 1), "distance = 12"),
    (lambda: planes(math.inf), "a volume needs"),
    (lambda: planes(230.0, 230.0), "it is given twice"),
    (lambda: mp.estimate_reconstruction(mp.example("letters-wave"), 210.0, progress=print), "progress: "),
    (lambda: resolved(80.0), "distance = 80: .*80"),
    (lambda: resolved(math.nan), "distance = nan"),
)


@pytest.mark.parametrize(
    ("changes", "words"), [(NARROW, "less than a pixel"), ({"aperture_radius": 0.05}, "distance = 240: no light")]
)
def test_a_camera_without_white_is_refused(changes, words):
    """No pixel belongs to the lens beside the axis, or none is lit: images would be divided by nothing."""
    refuses(words, by_waves, SMALL.replace(**changes), capture=np.zeros(SMALL.shape), interleave="auto")


@pytest.mark.parametrize(
    "tell", [mp.design.field_of_view, mp.design.refocus_range, mp.design.best_distances, mp.PlenopticCamera.defocus]
)
def test_numbers_of_a_lens_at_a_finite_distance_are_refused_behind_an_objective(tell):
    distance = [1.0] if tell is mp.PlenopticCamera.defocus else []
    refuses("is not defined behind an objective", tell, mp.PlenopticCamera.preset("lfm"), *distance)


@pytest.mark.needs_extension("inverse")
def test_gradients_of_reconstructions_refuse_a_warp():
    from mitsuba_plenoptic.extensions.inverse.differentiable import RayRefocus

    warped = small_camera(4, **HALF, mla_warp=(0.001,) * 14)
    refuses(r"mla_warp = .*derivatives of reconstructions refuse it", RayRefocus, warped, 114.0)


CAMERA = mp.PlenopticCamera(detector_width=0.512, resolution=(128, 128))
CROPS = [CAMERA.replace(crop_offset=offset, crop_size=(64, 96)) for offset in ((0, 0), (64, 32))]


@functools.cache
def white():
    return white_image(CAMERA)


def rgb():
    return np.stack([white(), 0.8 * white(), 0.6 * white()], axis=-1)


def ray(image=None, camera=CAMERA):
    return mp.Capture(white() if image is None else image, camera)


def wave(image=None, wavelength=633.0):
    return mp.Capture(white() if image is None else image, CAMERA, wavelength, "wave")


def lit(lenses):
    """Return the white of an array in the light of all lenses but some at the left."""
    return np.where(np.arange(128) < 16 * lenses, 0, white())


def square_white(distance):
    """Render a square of radiance 1, half as wide as the view and seen by a small part of the pupil only."""
    place = mi.ScalarTransform4f().translate([0, 0, distance]).rotate([0, 1, 0], 180).scale(0.32)
    sheet = {"type": "rectangle", "emitter": {"type": "area", "radiance": 1.0}, "to_world": place}
    scene = {"type": "scene", "integrator": {"type": "direct"}, "sheet": sheet, "camera": CAMERA.to_sensor()}
    return mp.render_capture(mp.load_scene(scene), spp=16)


WHITES = {
    "camera": (lambda: (ray(), ray(camera=CAMERA.replace(aperture_radius=4.0))), "aperture_radius = 4.0.* 5.0"),
    "crop": (lambda: tuple(mp.Capture(white_image(c), c) for c in CROPS), r"crop_offset = \(64, 32\).*\(0, 0\)"),
    "wavelength": (lambda: (wave(), wave(None, 532.0)), "532.0 nm: .*633.0 nm"),
    "model": (lambda: (ray(), wave()), "waves.*rays"),
    "mosaic": (lambda: (ray(), mp.expose(ray(rgb()), mp.Detector(mosaic="RGGB"), photons=1e4)), "mosaic = RGGB"),
    "channels": (lambda: (ray(), rgb()), r"white of shape \(128, 128, 3\)"),
    "NaN": (lambda: (ray(), np.where(white() > 0, np.nan, 0)), "NaN"),
    "dark": (lambda: (ray(), -white()), "dark"),
    "part": (lambda: (ray(), lit(3)), "24 of 64 lenses .*0.125"),
    "saturated": (lambda: (ray(), mp.expose(ray(), mp.Detector(), photons=2e4)), "16384 pixels are saturated"),
    "half a pupil": (lambda: (ray(), square_white(300)), "16% of its light"),
}


@pytest.mark.parametrize(("make", "words"), WHITES.values(), ids=WHITES)
def test_whites_that_do_not_suit_are_refused(make, words):
    capture, reference = make()
    refuses(f"^white.*{words}|^{words}", mp.reconstruct, capture, 210.0, white=reference)
    if "lenses" in words or "16%" in words:
        refuses(words, mp.decode, capture, white=reference)


def test_a_dim_white_is_named():
    with pytest.warns(UserWarning, match="white: 8 of 64 lenses"):
        mp.reconstruct(ray(), 240.0, white=white() * np.where(np.arange(128) < 16, 0.3, 1))
    with pytest.warns(UserWarning, match="method ray has no use for interleave"):
        mp.estimate_reconstruction(ray(), 240.0, method="ray", interleave=2)
