"""Smoothly displaced lenses: where micro-images lie by rays and by waves, points through them, and bad input."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import sky, small_camera, warped

from mitsuba_plenoptic import InputError, PlenopticCamera
from mitsuba_plenoptic.array import Displacement
from mitsuba_plenoptic.views import lens_grid, white_image


def centroids(image, camera, centres, half=13.0):
    """Return the centroids of micro-images within squares around expected centres, in pixels from these."""
    found = []
    for place in centres:
        aside = [camera.pixel_coordinates(axis) / camera.pixel_size - place[axis] for axis in (0, 1)]
        x, y = (np.clip(half + 0.5 - np.abs(values), 0, 1) for values in aside)
        part = image * x * y[:, None]
        found.append([part.sum(axis) @ aside[axis] / part.sum() for axis in (0, 1)])
    return np.array(found)


@pytest.mark.parametrize(
    ("light", "terms"),
    [
        ("rays", 18), ("computed", 18), ("grid", 7), ("grid", 18), pytest.param("waves", 18, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_micro_images_are_displaced_by_the_polynomial(light, terms):
    """To 0.02 pixels, of displacements by up to 3 pixels; the centres are c (b + z) / b."""
    mi.set_variant("llvm_ad_mono")
    camera, moved = warped(small_camera(8, crop_offset=(32, 0), crop_size=(224, 256)), 2.7, terms)
    assert PlenopticCamera.from_json(camera.to_json()) == camera
    index = np.array([(i, j) for i in range(-3, 3) for j in range(-3, 3)])
    regular = (index + 0.5) * camera.mla_pitch
    aside = moved(*regular.T).T
    expected = (regular + aside) * (1 + 0.512 / 120) / camera.pixel_size
    assert np.hypot(*aside.T).max() > 0.6 * camera.pixel_size
    if light == "grid":
        found = lens_grid(camera).centres().reshape(-1, 2) + np.array(camera.crop_offset) - 128
        near = np.hypot(*(found[:, None] - expected).transpose(2, 0, 1)).min(0)
        assert near.max() < 1e-9
        return
    if light == "computed":
        image = white_image(camera)
    else:
        image = sky(camera, 128, **({"model": "wave", "wavelength": 550} if light == "waves" else {}))
    assert np.abs(centroids(image, camera, expected)).max() < 0.02


@pytest.mark.parametrize("terms", [7, 18])
def test_polynomials_turn_with_their_frame(terms):
    camera, _ = warped(PlenopticCamera(), 3.0, terms)
    shifts, (x, y) = camera.lattice.displacement, np.random.default_rng(0).uniform(-4, 4, (2, 20))
    angle = np.radians(25)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    # A place of the turned frame, brought to the camera's, displaced and brought back.
    there = np.array(shifts.smooth(*(turn @ [x, y])))
    assert np.allclose(shifts.turned(25).smooth(x, y), turn.T @ there, atol=1e-12)
    assert np.allclose(shifts.regular(*np.add([x, y], shifts.smooth(x, y))), [x, y], atol=1e-6)


def test_a_steep_warp_is_refused_and_zeros_are_none():
    with pytest.raises(InputError, match=r"0\.1[0-9]* mm per mm"):
        small_camera(10).replace(mla_warp=(0.125, 0.125))
    assert PlenopticCamera(mla_warp=[0.0] * 9) == PlenopticCamera()
    assert [len(PlenopticCamera(mla_warp=(1e-6,) * count).mla_warp) for count in (1, 14, 36)] == [14, 14, 36]


def test_lenses_in_a_rectangle_are_those_whose_displaced_centres_lie_in_it():
    camera, _ = warped(small_camera(20), 5.0, 18)
    low, high = (-0.288, -0.2), (0.416, 0.48)
    found = {tuple(index) for index in camera.lattice.lenses_within(low, high)}
    i, j = (index.ravel() for index in np.mgrid[-15:15, -15:15])
    x, y = camera.lattice.centre(i.astype(float), j.astype(float))
    inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    assert found == set(zip(i[inside].tolist(), j[inside].tolist(), strict=True))
    assert found != {tuple(index) for index in camera.lattice.regular.lenses_within(low, high)}
    assert isinstance(camera.lattice.displacement, Displacement)
