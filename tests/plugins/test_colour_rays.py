"""Rays of each colour go their own way through lenses of glass: against traces in double precision, and each alone."""

import mitsuba as mi
import numpy as np
import pytest
from cameras import error

from mitsuba_plenoptic import LensSystem, PlenopticCamera, reconstruct, render_capture

RGB_WAVELENGTHS = (611.4, 549.1, 464.3)
"""Of red, green and blue in nanometres, as the documentation states them."""

SMALL = {"resolution": (64, 64), "detector_width": 0.128}
FLINT = {"index": 1.7, "abbe": 30.0}


def sensor_of(camera, pixel_format="rgb"):
    described = camera.to_sensor()
    described["film"]["pixel_format"] = pixel_format
    return mi.load_dict(described)


def rays(sensor, channel, count=256):
    """Rays of one channel, by the third of the random numbers that stands for it, and their weights."""
    random = np.random.default_rng(1).random((4, count)).astype(np.float32)
    lens = mi.Point2f((random[2] + channel) / 3 if mi.is_rgb else random[2], random[3])
    return sensor.sample_ray(0.0, mi.Float(random[3]), mi.Point2f(*random[:2]), lens)


@pytest.mark.parametrize("channel", [0, 2])
def test_channels_through_a_singlet(channel):
    """Slopes and places are those of the wavelength of the channel alone, traced in double precision."""
    mi.set_variant("llvm_ad_rgb")
    camera = PlenopticCamera(main_lens="singlet", focal_length=80, aperture_radius=4, **SMALL)
    ray, weight = rays(sensor_of(camera), channel)
    weight = np.array(weight)
    own = np.zeros(3)
    own[channel] = 3
    lit = weight[channel] > 0
    assert lit.sum() > 50 and np.all(weight[:, lit] == own[:, None])
    # Behind the array a ray goes from its pixel to the centre of its lens: what leaves the main lens must come back so
    # through it at that wavelength, and at no other.
    p = (np.random.default_rng(1).random((4, 256)).astype(np.float32)[:2, lit] - 0.5) * camera.detector_width
    chief = p * camera.pupil_distance / (camera.pupil_distance + camera.detector_distance)
    expected = ((np.floor(chief / camera.mla_pitch) + 0.5) * camera.mla_pitch - p) / camera.mla_focal_length
    origin, direction = np.array(ray.o, np.float64)[:, lit], np.array(ray.d, np.float64)[:, lit]
    misses = [
        LensSystem.of(camera, wavelength).through(tuple(origin), tuple(direction[:2] / direction[2]))[1] - expected
        for wavelength in RGB_WAVELENGTHS
    ]
    errors = [np.abs(miss).max() for miss in misses]
    assert errors[channel] < 2e-5 and min(errors[:channel] + errors[channel + 1 :]) > 1e-4


@pytest.mark.slow
def test_polarized_variants_record_the_same_light_through_glass():
    """Weights are Mueller matrices there: a product with a spectrum ended in `std::bad_cast`."""
    images = []
    for variant in ("llvm_ad_spectral", "llvm_ad_spectral_polarized"):
        mi.set_variant(variant)
        camera = PlenopticCamera(main_lens="double_gauss", **SMALL)
        light = {"sky": {"type": "constant"}, "integrator": {"type": "direct"}}
        scene = mi.load_dict({"type": "scene", "camera": camera.to_sensor()} | light)
        images.append(render_capture(scene, spp=2).image)
    np.testing.assert_allclose(images[1], images[0], rtol=1e-4, atol=1e-5)


def test_spectral_rays_follow_their_first_wavelength():
    mi.set_variant("llvm_ad_spectral")
    camera = PlenopticCamera(glass=FLINT, mla_glass=FLINT, **SMALL)
    ray, weight = rays(sensor_of(camera), 0)
    alone = PlenopticCamera(**SMALL)
    wavelengths = np.array(ray.wavelengths)[0]
    weight = np.array(weight)
    assert np.all(weight[1:] == 0) and np.any(weight[0] > 0)
    plain, _ = rays(sensor_of(alone), 0)
    for lane in np.flatnonzero(weight[0] > 0)[:3]:
        there = camera.at_wavelength(float(wavelengths[lane]))
        other, _ = rays(sensor_of(there), 0)
        assert np.abs(np.array(other.d)[:, lane] - np.array(ray.d)[:, lane]).max() < 2e-6
        if abs(wavelengths[lane] - 587.56) > 30:
            assert np.abs(np.array(plain.d)[:, lane] - np.array(ray.d)[:, lane]).max() > 1e-5


def wall(camera, variant):
    mi.set_variant(variant)
    described = camera.to_sensor()
    described["film"]["pixel_format"] = "rgb"
    T = mi.ScalarTransform4f
    texture = {"type": "checkerboard", "to_uv": T().scale([40, 40, 1]), "color0": 0.1, "color1": 0.9}
    board = {
        "type": "rectangle", "to_world": T().translate([0, 0, 240]).scale(10).rotate([0, 1, 0], 180),
        "emitter": {"type": "area", "radiance": texture},
    }  # fmt: skip
    return mi.load_dict({"type": "scene", "camera": described, "board": board, "integrator": {"type": "direct"}})


def test_every_channel_is_the_capture_at_its_wavelength():
    """Of thin lenses of glass, against cameras with the focal lengths of each wavelength, without dispersion."""
    camera = PlenopticCamera(glass=FLINT, mla_glass=FLINT, resolution=(64, 64), detector_width=0.128)

    def capture(camera, spp):
        image = render_capture(wall(camera, "llvm_ad_rgb"), spp=spp).image
        return image.reshape(16, 4, 16, 4, 3).mean((1, 3))

    found, plain = capture(camera, 768), capture(camera.replace(glass=None, mla_glass=None), 256)
    for channel, wavelength in ((0, RGB_WAVELENGTHS[0]), (2, RGB_WAVELENGTHS[2])):
        alone = capture(camera.at_wavelength(wavelength), 256)
        own, other = (error(found[..., channel], image[..., channel]) for image in (alone, plain))
        assert own < 0.03
    assert other > 0.1
    # Glasses of one index for all wavelengths leave all channels to every ray.
    _, weight = rays(sensor_of(PlenopticCamera(glass=1.5, **SMALL)), 1)
    assert set(np.unique(np.array(weight))) <= {0.0, 1.0}


@pytest.mark.filterwarnings("ignore:.*does not go back through the main lens")
def test_waves_refocus_each_channel_with_its_own_lens():
    """The plane that is sharp at a wavelength, where the stated focal length would blur it."""
    mi.set_variant("llvm_ad_mono")
    camera = PlenopticCamera(glass={"index": 1.5, "abbe": 20.0}, resolution=(128, 128), detector_width=0.256)
    image = np.random.default_rng(0).random((128, 128, 3)).astype(np.float32)
    wavelengths = (650.0, 550.0, 450.0)
    made = reconstruct(image, 240.0, method="coherent", camera=camera, wavelength=wavelengths).image
    for channel, wavelength in enumerate(wavelengths):
        own = {"camera": camera.at_wavelength(wavelength), "wavelength": wavelength}
        alone = reconstruct(image[..., channel], 240.0, method="coherent", **own).image
        assert np.array_equal(made[..., channel], alone, equal_nan=True)
