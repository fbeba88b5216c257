"""Textured planes: what sensors see of them against closed forms and Mitsuba's shapes, derivatives, and fits."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_plenoptic import Capture, InputError, PlenopticCamera, render_capture
from mitsuba_plenoptic.fitting import Layers, fit_layers

CAMERA = PlenopticCamera(
    mla_pitch=0.016, mla_focal_length=0.128, aperture_radius=5.25, detector_width=0.064, resolution=(32, 32),
    lens_model="parabolic",
)  # fmt: skip
RNG = np.random.default_rng(0)
PAIR = Layers([238.0, 241.0], [0.2, 0.3], RNG.uniform(0, 1, (2, 8, 8)), RNG.uniform(0.1, 0.9, (2, 8, 8)))


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_mono")


def pinhole(width, pixels, distance, origin=(0, 0, 0)):
    """Return a pinhole camera that sees a square in some distance."""
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}}
    film |= {"pixel_format": "luminance", "component_format": "float32"}
    fov = float(2 * np.degrees(np.arctan(width / 2 / distance)))
    to_world = mi.ScalarTransform4f().translate(list(origin))
    return mi.load_dict({"type": "perspective", "fov": fov, "film": film, "to_world": to_world})


def seen(layers, sensor, spp=64):
    scene = layers.scene(CAMERA.to_sensor())
    return np.array(scene.integrator().render(scene, sensor, seed=0, spp=spp))[..., 0]


def test_one_plane_is_seen_as_its_texels():
    texels = np.repeat(np.repeat(RNG.uniform(0, 1, (4, 4)), 8, axis=0), 8, axis=1)
    layers = Layers([240.0], [0.5], texels[None], np.ones((1, 32, 32)))
    found = seen(layers, pinhole(0.5, 32, 240.0))
    inside = np.isin(np.arange(32) % 8, (0, 7), invert=True)
    np.testing.assert_allclose(found[np.ix_(inside, inside)], texels[np.ix_(inside, inside)], rtol=1e-4)


def test_planes_hide_each_other():
    """Even planes, of which the first is smaller: inside, both count by their opacity."""
    even = Layers([230.0, 240.0], [0.1, 0.5], [np.full((2, 2), 1.0), np.full((2, 2), 3.0)], np.full((2, 2, 2), 0.25))
    found = seen(even, pinhole(0.4, 20, 240.0))
    assert found[10, 10] == pytest.approx(0.25 * 1 + 0.75 * 0.25 * 3, rel=1e-5)
    assert found[1, 1] == pytest.approx(0.25 * 3, rel=1e-5)


def test_parallax_is_that_of_mitsubas_shapes():
    """An opaque plane with a texture against a rectangle with the same, from aside, in a ray and a wave capture."""
    texels = np.kron(RNG.uniform(0, 1, (4, 4)), np.ones((8, 8))).astype(np.float32)
    # The first row of a bitmap is at the lower end of a rectangle.
    layers = Layers([238.0], [0.2], texels[None, ::-1], np.ones((1, 32, 32)))
    bitmap = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(texels[..., None]), "wrap_mode": "clamp"}
    placed = mi.ScalarTransform4f().translate([0, 0, 238]).rotate([0, 1, 0], 180).scale(0.1)
    sensor = CAMERA.to_sensor(mi.ScalarTransform4f().translate([0.02, -0.01, 0]))
    rectangle = {"type": "rectangle", "to_world": placed, "emitter": {"type": "area", "radiance": bitmap}}
    scene = {"type": "scene", "sensor": sensor, "shape": rectangle, "integrator": {"type": "path", "max_depth": 1}}
    for model, options in (("ray", {}), ("wave", {"wavelength": 633.0})):
        made = [
            render_capture(each, model=model, spp=64, seed=1, **options).image
            for each in (layers.scene(sensor), mi.load_dict(scene))
        ]
        assert made[0].max() > 0.1
        assert np.linalg.norm(made[0] - made[1]) < 1e-4 * np.linalg.norm(made[1])


@pytest.mark.parametrize("model", ["ray", "wave"])
def test_derivatives_by_texels(model):
    """The reverse pass against differences of captures with the same rays, so many that hardly a pixel is negative."""
    scene = PAIR.scene(CAMERA.to_sensor())
    planes, sensor = scene.integrator(), scene.sensors()[0]
    integrator = planes if model == "ray" else mi.load_dict({"type": "plenoptic_wave", "child": planes})
    felt = RNG.uniform(size=(*CAMERA.shape, 1)).astype(np.float32)
    change = RNG.uniform(-1, 1, PAIR.texels.shape).astype(np.float32)

    def figure(step):
        planes.set_texels([mi.TensorXf(each) for each in PAIR.texels + np.float32(step) * change])
        return float((np.array(integrator.render(scene, sensor, seed=3, spp=64), np.float64) * felt).sum())

    difference = (figure(0.02) - figure(-0.02)) / 0.04
    texels = [mi.TensorXf(each) for each in PAIR.texels]
    dr.enable_grad(texels)
    planes.set_texels(texels)
    integrator.render_backward(scene, None, mi.TensorXf(felt), sensor, seed=3, spp=64)
    found = sum(float((np.array(dr.grad(each)) * one).sum()) for each, one in zip(texels, change, strict=True))
    assert found == pytest.approx(difference, rel=1e-3)


def test_fits_find_the_radiance_of_a_plane():
    """From two wave captures of one opaque plane, of which the start is grey."""
    truth = Layers([240.0], [0.15], [[[0.8, 0.2], [0.3, 0.6]]], np.ones((1, 2, 2)))
    poses = [mi.ScalarTransform4f().translate([x, 0, 0]) for x in (0.0, 0.02)]
    captures = [
        render_capture(truth.scene(CAMERA.to_sensor(pose)), model="wave", wavelength=633.0, spp=32) for pose in poses
    ]
    start, news = Layers([240.0], [0.15], np.full((1, 2, 2), 0.5), np.ones((1, 2, 2))), []
    found = fit_layers(captures, poses, start, rounds=18, rate=0.1, spp=12, progress=lambda *each: news.append(each))
    assert [done for done, _ in news] == list(range(1, 19))
    assert news[-1][1] < 0.7 * news[0][1]
    light = found.radiance[..., 0] * found.opacity
    assert np.abs(light - truth.radiance[..., 0]).max() < 0.05
    assert found.opacity.max() <= 1


def test_fits_in_colour_from_captures_by_rays():
    mi.set_variant("llvm_ad_rgb")
    radiance = np.array([[[[0.8, 0.2, 0.4], [0.1, 0.3, 0.7]]]])
    truth = Layers([240.0], [0.15], radiance, np.ones((1, 1, 2)))
    sensor = CAMERA.to_sensor()
    sensor["film"]["pixel_format"] = "rgb"
    captures = [render_capture(truth.scene(sensor), model="ray", spp=16)]
    assert captures[0].image.shape == (*CAMERA.shape, 3)
    start = Layers(truth.depths, truth.widths, np.full((1, 1, 2, 3), 0.5), np.ones((1, 1, 2)))
    found = fit_layers(captures, [mi.ScalarTransform4f()], start, rounds=20, rate=0.1, spp=8)
    assert np.abs(found.radiance * found.opacity[..., None] - radiance).max() < 0.1
    # What is the same in all channels would be fitted to a grey capture without a word.
    grey = Capture(captures[0].image[..., 0], CAMERA)
    with pytest.raises(InputError, match=r"^captures: number 1 has 1 channels, the planes have 3$"):
        fit_layers([captures[0], grey], [mi.ScalarTransform4f()] * 2, start)
