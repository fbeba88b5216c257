"""A detector's operator, against Gaussian convolutions by SciPy, and the captures that it records."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from cases import facing, radiating, scene_of
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic import PlenopticCamera, StrayLight, reconstruct, render_capture
from mitsuba_plenoptic.detector.operator import DetectorOperator
from mitsuba_plenoptic.io.captures import Capture

CAMERA = PlenopticCamera(resolution=(32, 32), detector_width=0.256)
"""Of 4 x 4 lenses with pixels of 8 micrometres."""

BLUR = 0.012
"""A blur of 1.5 pixels."""

TABLE = [[0.02, 0.1, 0.05], [0.2, 0.0, 0.15]]
"""Stray light from the top left of the picture on."""


def with_stray_light(image, camera):
    """An image with the stray light of `TABLE`, by SciPy."""
    columns, rows = camera.resolution
    places = np.mgrid[0:rows, 0:columns] + 0.5
    between = RegularGridInterpolator((np.linspace(0, rows, 2), np.linspace(0, columns, 3)), TABLE)
    (left, top), (width, height) = camera.crop_offset, camera.crop_size
    return image + between(np.moveaxis(places, 0, -1))[top : top + height, left : left + width] * image.mean()


def lit(camera, integrator, **film):
    sensor = camera.to_sensor()
    sensor["film"] |= film
    return scene_of(sensor, integrator, lamp=facing(238.0, 0.1, (0.05, 0.0), **radiating()))


def test_blurs_below_a_pixel_are_gaussian_and_take_no_light_away():
    impulse = np.zeros((1, 41))
    impulse[0, 20] = 1
    # Samples of a Gaussian would have too small a variance.
    narrow = DetectorOperator(blur=0.4).forward(impulse)
    # Nowhere does it take light away, however wide it is.
    for width in (1e-6, 0.05, 0.4, 1.0, 1.5, 30.0):
        assert DetectorOperator(blur=width).forward(impulse).min() >= 0
    smooth = 1 + np.cos(2 * np.pi * (np.arange(41) - 20) / 16)
    assert (narrow * smooth).sum() == pytest.approx(1 + np.exp(-0.5 * (0.4 * 2 * np.pi / 16) ** 2), abs=1e-3)


def test_stray_light_is_a_table_of_the_whole_detector(tmp_path):
    """Of which a crop has its place, and its own mean light; beside blur and crosstalk."""
    np.save(tmp_path / "stray.npy", TABLE)
    camera = CAMERA.replace(resolution=(32, 28), crop_offset=(3, 5), crop_size=(24, 20))
    mixing = {"detector_blur": BLUR, "pixel_crosstalk": 0.05}
    stray = camera.replace(stray_light=tmp_path / "stray.npy", **mixing)
    assert stray == camera.replace(stray_light=np.array(TABLE), **mixing) and stray.stray_light == StrayLight(TABLE)
    plain = np.random.default_rng(2).random(camera.shape)
    beside = np.pad(gaussian_filter(plain, BLUR / camera.pixel_size, mode="reflect", truncate=8), 1, mode="symmetric")
    mixed = 0.8 * beside[1:-1, 1:-1]
    mixed += 0.05 * (beside[:-2, 1:-1] + beside[2:, 1:-1] + beside[1:-1, :-2] + beside[1:-1, 2:])
    assert error(DetectorOperator.of(stray).forward(plain), with_stray_light(mixed, camera)) < 1e-6


def test_plain_and_frozen_renders_are_recorded_and_depth_as_it_is():
    camera = CAMERA.replace(detector_blur=BLUR, pixel_crosstalk=0.05, stray_light=TABLE)
    operator = DetectorOperator.of(camera)
    depth = {"type": "aov", "aovs": "d:depth", "image": {"type": "path"}}
    scenes = (lit(each, depth, pixel_format="luminance_alpha") for each in (CAMERA, camera))
    plain, found = (np.array(mi.render(scene, spp=16)) for scene in scenes)
    assert found.shape[2] == 3
    assert found[..., :1] == pytest.approx(operator.forward(plain[..., :1]), abs=1e-6)
    assert np.array_equal(found[..., 1:], plain[..., 1:])
    loaded = lit(camera, {"type": "prb"})
    frozen = dr.freeze(lambda loaded, seed: mi.render(loaded, spp=4, seed=seed))
    for seed in (1, 2):
        assert np.array_equal(frozen(loaded, mi.UInt32(seed)), mi.render(loaded, spp=4, seed=seed))


def test_a_changed_crop_of_the_film_is_recorded():
    loaded = lit(CAMERA.replace(detector_blur=BLUR), {"type": "path"})
    params = mi.traverse(loaded)
    params["camera.film.crop_size"], params["camera.film.crop_offset"] = [8, 6], [10, 12]
    params.update()
    assert np.shape(mi.render(loaded, spp=1)) == (6, 8, 1)
    assert PlenopticCamera.from_sensor(loaded.sensors()[0]).crop_size == (8, 6)


LENGTHS = CAMERA.replace(detector_blur=BLUR, pixel_crosstalk=0.05, stray_light=TABLE, stray_width=0.04)


def by_width(image, slope):
    """Difference of what detectors of two widths record, for an image and its derivative before the detector."""
    h = 1e-4
    sides = (
        DetectorOperator.of(LENGTHS.replace(detector_width=0.256 + side)).forward(np.float64(image + side * slope))
        for side in (h, -h)
    )
    return np.subtract(*sides) / (2 * h)


@pytest.mark.parametrize(
    "integrator",
    [{"type": "direct"}, pytest.param({"type": "plenoptic_wave"}, marks=pytest.mark.slow)],
    ids=["ray", "wave"],
)
def test_gradients_of_renders_by_the_width_hold_the_lengths_of_the_detector(integrator):
    """Forward and in reverse, with the samples of the derivative of a camera whose pixels are sharp."""
    name, other = "camera.detector_width", np.random.default_rng(0).random((*CAMERA.shape, 1), np.float32)

    def rendered(camera):
        loaded = lit(camera, integrator)
        params = mi.traverse(loaded)
        dr.enable_grad(params[name])
        params.update()
        image = mi.render(loaded, params, spp=8, seed_grad=5)
        dr.set_grad(params[name], 1.0)
        dr.enqueue(dr.ADMode.Forward, params[name])
        dr.traverse(dr.ADMode.Forward)
        change = np.array(dr.grad(image))
        dr.set_grad(params[name], 0.0)
        dr.backward(dr.sum(mi.render(loaded, params, spp=8, seed_grad=5) * mi.TensorXf(other), axis=None))
        return np.array(mi.render(loaded, spp=8, seed=5)), change, dr.grad(params[name])[0]

    right = by_width(*rendered(CAMERA)[:2])
    _, change, gradient = rendered(LENGTHS)
    assert error(change, right) < 1e-3
    assert gradient == pytest.approx(np.vdot(right, other), rel=1e-3)


@pytest.mark.slow
@pytest.mark.needs_extension("deconvolution")
def test_reconstructions_know_the_detector():
    """They show the lamp as the camera without it does; a blur by 1.5 of 8 pixels a lens moves light off lenses."""
    sharp, blurry = (
        render_capture(lit(camera, {"type": "direct"}), spp=1024)
        for camera in (CAMERA, CAMERA.replace(detector_blur=BLUR))
    )
    for method in ("ray", "coherent", "partial", "incoherent", "deconvolved"):
        options = {"method": method, "wavelength": None if method in ("ray", "deconvolved") else 633.0}
        found, expected = (reconstruct(each, 240, **options).image for each in (blurry, sharp))
        assert error(found, expected) < 0.05, method
    ignored = reconstruct(Capture(blurry.image, CAMERA, 633.0, "ray"), 240).image
    assert error(ignored, reconstruct(sharp, 240).image) > 0.2
