"""What light fields, their views, depth and ground truth refuse."""

import functools
import math

import mitsuba as mi
import numpy as np
import pytest
import xarray as xr

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import Objective, PlenopticCamera, decode
from mitsuba_plenoptic.views import (
    LensGrid,
    depth_map,
    disparity,
    epipolar_image,
    estimate_lens_grid,
    focal_stack,
    lens_grid,
    micro_images,
    refocus,
    view,
    white_image,
)
from refusals import refused, refuses

SMALL = PlenopticCamera(resolution=(64, 64), detector_width=0.256)
FOURIER = PlenopticCamera(
    main_lens=Objective(20, 0.5, arrangement="fourier", fourier_focal_length=50), mla_pitch=0.5, mla_focal_length=20.0,
    mla_offset=(0.25, 0.25), detector_width=2.6, resolution=(260, 260),
)  # fmt: skip
MULTI_FOCUS = PlenopticCamera.preset("raytrix").replace(detector_width=2.64, resolution=(480, 384))
FOCUSED = PlenopticCamera.preset("paper").replace(
    detector_width=0.512, resolution=(256, 256), mla_focal_length=0.384, mla_distance=121.536, aperture_radius=4.9
)
CORNER = PlenopticCamera(crop_offset=(2075, 2075), crop_size=(4, 4))


WITHOUT_LATTICE = [
    np.ones((100, 100)), np.random.default_rng(0).random((200, 200)), np.ones((4, 4)),
    white_image(PlenopticCamera(detector_width=0.128, resolution=(64, 64))),
]  # fmt: skip
"""Of four lenses a lattice is not known."""


@functools.cache
def even(camera=SMALL):
    """Return the light field of even light."""
    return decode(np.ones(camera.shape, np.float32), camera=camera)


def unknown():
    """Return the light field of a white picture by a camera that is not known."""
    return decode(np.ones((64, 64)), white=np.ones((64, 64)), grid=lens_grid(SMALL))


@functools.cache
def scene():
    """Return a plane before a camera, rolled."""
    pose = mi.ScalarTransform4f().translate([30, -20, 55]).rotate([0, 1, 0], 35).rotate([0, 0, 1], 8)
    plane = {"type": "rectangle", "to_world": pose @ mi.ScalarTransform4f().translate([0, 0, 262])}
    return mp.load_scene({"type": "scene", "sensor": SMALL.to_sensor(pose), "plane": plane})


@functools.cache
def truth():
    return mp.ground_truth(scene(), ["depth"])


def patched(**changes):
    """Find depths by the micro-images of even light, of a camera of which some values differ."""
    other = MULTI_FOCUS.replace(**changes)
    images = micro_images(mp.Capture(np.ones(other.shape, np.float32), other)) if changes else None
    return depth_map(even(MULTI_FOCUS), 335, 385, planes=3, micro_images=images)


test_refused = refused(
    (lambda: even(FOURIER.replace(resolution=(10, 10))), "three pixels"),
    (lambda: even(PlenopticCamera.preset("lfm").replace(resolution=(64, 64))), "main_lens = .*method deconvolved"),
    (
        lambda: even(SMALL.replace(main_lens="singlet", focal_length=80, aperture_radius=5)),
        "main_lens = Plano-convex singlet",
    ),
    (lambda: refocus(even(FOURIER), -20.0), "distance = -20"),
    (lambda: depth_map(even(FOURIER), -0.01, math.inf), "distance = inf"),
    (lambda: mp.reconstruct(np.ones(FOURIER.shape), 0.0, camera=FOURIER, method="partial"), "no wave goes back"),
    *((lambda c=c: lens_grid(c), "no micro-image") for c in (CORNER, CORNER.replace(mla_lattice="hexagonal"))),
    (lambda: patched(), "micro_images = None"),
    (lambda: patched(mla_rotation=7.0, mla_offset=(0.03, -0.02)), "another camera"),
    (lambda: depth_map(even(FOCUSED).isel(u=slice(None, None, 2)), 232, 245, planes=3), "all of its views"),
    (
        lambda: micro_images(np.ones((384, 480)), grid=lens_grid(MULTI_FOCUS), white=np.ones((384, 480))),
        "camera = None",
    ),
    (lambda: mp.ground_truth(scene(), ["depth", "colour"]), "aov = 'colour'"),
    (lambda: mp.ground_truth(scene(), []), "virtual_depth"),
    (lambda: decode(np.ones(SMALL.shape), camera=SMALL.replace(aperture_radius=4.0), truth=truth()), "another camera"),
    (lambda: epipolar_image(even(), "?"), "axis = "),
    *((lambda image=image: estimate_lens_grid(image), "white") for image in WITHOUT_LATTICE),
    (lambda: LensGrid((0, 1), (0, 0), (2, 2)), "spacing"),
    (lambda: LensGrid((1, 1), (math.nan, 0), (2, 2)), "offset"),
    (lambda: LensGrid((1, 1), (0, 0), (2, 2), 0.0, 2), "shifted_rows"),
    (lambda: decode(np.ones((64, 64))), "camera = None"),
    (lambda: decode(np.ones((64, 64)), grid=LensGrid((16, 16), (8, 8), (4, 4))), "white = None"),
    (lambda: decode(np.ones((64, 64)), camera=SMALL, white=np.ones((3, 3))), r"white of shape \(3, 3\)"),
    (lambda: decode(np.ones((64, 64)), camera=PlenopticCamera(resolution=(32, 64))), "the camera records"),
    (lambda: disparity(unknown(), 240), "no camera"),
    (lambda: depth_map(even(), 50, 200), "focal length"),
    (lambda: depth_map(even(), math.nan, 200), "near"),
    (lambda: focal_stack(even(), []), "distances"),
    (lambda: view(xr.DataArray(np.ones((2, 2, 2, 2)), dims=("v", "u", "t", "s"))), "light field"),
)


def test_light_fields_estimate_their_memory_first(monkeypatch):
    lf = even()
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", "1e-6")
    refuses("it would need", depth_map, lf, 200, 300)
    refuses("it would need", focal_stack, lf, [240.0] * 10)
    refuses("it would need", even.__wrapped__)


@pytest.mark.parametrize("text", ["much", "0"])
def test_a_limit_of_memory_that_is_none_is_refused(monkeypatch, text):
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", text)
    refuses("MITSUBA_PLENOPTIC_MEMORY", mp.reconstruct, np.ones((64, 64), np.float32), 240.0, camera=SMALL)
