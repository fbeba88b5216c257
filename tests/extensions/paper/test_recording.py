"""What moved and strayed between a real camera's pictures is found in pictures in which both are known."""

import json

import numpy as np
import pytest
from PIL import Image
from refusals import refused
from scipy import ndimage

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.detector import SHARP, DetectorOperator
from mitsuba_plenoptic.extensions.calibrate.photon_transfer import electrons
from mitsuba_plenoptic.extensions.paper import recording as of_paper
from mitsuba_plenoptic.extensions.paper.real_light import grid
from mitsuba_plenoptic.views import lens_numbers, white_image

CAMERA = PlenopticCamera(
    focal_length=200, aperture_radius=3.06, mla_distance=400, mla_pitch=0.2973, mla_focal_length=18.6,
    detector_distance=18.6, detector_width=2.48, resolution=(384, 384), mla_rotation=0.13, detector_blur=0.01,
    stray_light=0.1,
)  # fmt: skip
"""8 x 8 lenses of 48 pixels."""


def recorded(moved=(0.0, 0.0), width=np.inf, counts=None):
    """Return a recording of a plane that is bright on the left and dark on the right, moved behind a still white."""
    sharp = white_image(CAMERA.replace(**SHARP))
    bright = np.where(np.arange(384) < 240, 1.2, 0.01) * sharp
    operator = DetectorOperator(1.5, 0.0, 0.1, width)
    white, light = (100 * operator.forward(picture.astype(np.float32)) for picture in (sharp, bright))
    light = ndimage.shift(light, moved[::-1], order=3, mode="nearest")
    if counts:
        random = np.random.default_rng(3)
        white, light = (random.poisson(counts * picture.clip(0)) / counts for picture in (white, light))
    return of_paper.Recording(light.astype(np.float32), white.astype(np.float32), CAMERA, {})


def test_the_displacement_of_a_light_field_is_found_to_three_hundredths_of_a_pixel():
    recording = recorded(moved=(0.29, -0.15), width=20.0, counts=60)
    moved = of_paper.moved_by(recording)
    assert moved == pytest.approx((0.29, -0.15), abs=0.03)
    brought = of_paper.aligned(recording, moved, None)
    bright = np.s_[48:-48, 48:180]
    after, before = (np.abs(each.light / 1.2 - each.white)[bright].mean() for each in (brought, recording))
    assert after < 0.8 * before


def test_paper_has_the_light_of_white_times_a_parabola_over_micro_images():
    white = recorded().white
    lenses, x = lens_numbers(CAMERA), np.indices(CAMERA.shape)[1]
    across = (x - ndimage.mean(x, lenses, np.arange(lenses.max() + 1))[lenses]) / 48
    shape = of_paper.Shape(390, {"region": (0, 0, 4, 8), "even": (1, 2, 2, 4)})
    light = (0.7 * white * (1 + 0.2 * across + 0.4 * across**2)).astype(np.float32)
    paper = of_paper.paper_of(of_paper.Recording(light, white, CAMERA, {"a": shape}))
    even = shape.pixels(CAMERA, "even")
    bright = white[even] > 0.5 * white.max()
    for picture, least, most in ((white, 0.03, 0.2), (paper, 0, 0.004)):
        ratio = (light / picture)[even][bright]
        assert least <= ratio.std() / ratio.mean() < most
    assert (paper == white)[:, 240:].all()


@pytest.mark.parametrize("width", [20.0, 64.0, np.inf])
def test_the_width_of_stray_light_is_found_between_micro_images(width):
    found = of_paper.stray_width(recorded(width=width, counts=60))
    assert (found is None) if width == np.inf else found == pytest.approx(width * CAMERA.pixel_size, rel=0.3)


def test_electrons_are_those_of_the_photon_noise():
    assert electrons(recorded(counts=60).white) == pytest.approx(60, rel=0.15)


def test_the_grid_is_what_repeats_from_lens_to_lens():
    rows, columns = np.indices((64, 48))
    area = 5 + 0.01 * rows - 0.02 * columns + 0.1 * np.cos(2 * np.pi * columns / 8)
    area = area + 0.3 * np.random.default_rng(0).standard_normal(area.shape)
    assert grid(area.astype(np.float32)) == pytest.approx(0.1 / np.sqrt(2) / area.mean(), rel=0.25)


SHAPES = {"a": {"distance": 385, "region": [0, 0, 4, 8]}, "b": {"distance": 410, "region": [4, 0, 4, 8]}}


def written(folder, shapes=SHAPES, names=("light", "white", "dark")):
    for name in names:
        Image.fromarray(np.full((384, 384), 9 if name == "dark" else 99, np.uint8)).save(folder / f"{name}.png")
    (folder / "camera.json").write_text(CAMERA.to_json())
    (folder / "shapes.json").write_text(json.dumps(shapes))
    return folder


def test_a_folder_is_read_with_its_nearest_shape_first(tmp_path):
    recording = of_paper.read_recording_of(written(tmp_path, dict(reversed(SHAPES.items()))))
    assert list(recording.shapes) == ["a", "b"]
    assert (recording.light == 90).all()
    assert recording.shapes["b"].window("region", 8) == (slice(0, 64), slice(32, 64))


def read_of(folder, shapes, names=("light", "white")):
    return of_paper.read_recording_of(written(folder, shapes, names))


test_a_folder_that_lacks_something_is_refused = refused(
    (lambda folder: read_of(folder, SHAPES, ["light"]), "white.png"),
    (lambda folder: read_of(folder, {"a": SHAPES["a"]}), "two distances"),
    (lambda folder: read_of(folder, SHAPES | {"a": {"distance": 385}}), "a: it has no region"),
    (lambda folder: read_of(folder, {"a": SHAPES["a"] | {"even": [1, 1, 0, 2]}}), "a: even = .1, 1, 0, 2."),
    (lambda folder: read_of(folder, []), "no shapes"),
)
