"""Wave captures of any scene: mirrors, panes, glass, fog, light from infinity; variants, seeds, energy, films."""

import cases
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import WAVELENGTH, disk, error
from cases import film
from scipy.ndimage import convolve1d

from mitsuba_plenoptic import InputError, design, reconstruct, render_capture
from mitsuba_plenoptic.plugins.wave_base import developed


@pytest.fixture(scope="module")
def bars_directly():
    mi.set_variant("llvm_ad_mono")
    return [cases.contrast(capture, 300.0) for capture in cases.captures(cases.bars_through("directly", 20), 16)]


@pytest.mark.parametrize(
    "way", ["mirror", *(pytest.param(way, marks=pytest.mark.slow) for way in ("slab", "half-open mask", "fog"))]
)
def test_bars_come_back_into_focus_at_their_virtual_distance(way, bars_directly):
    by_rays, by_waves = cases.captures(cases.bars_through(way, 20), 16)
    assert cases.energy(by_rays, by_waves) == pytest.approx(0.99, abs=0.015)
    rays, waves = (cases.contrast(capture, 300.0) for capture in (by_rays, by_waves))
    directly_by_rays, directly = bars_directly
    assert waves == pytest.approx(directly * rays / directly_by_rays, abs=0.03)


def through_card(pane):
    return cases.by_signed_rays(cases.square_behind(pane)).image


@pytest.fixture(scope="module")
def without_card():
    mi.set_variant("llvm_ad_mono")
    return through_card(None)


@pytest.mark.slow
@pytest.mark.parametrize("card", ["mask", "thindielectric"])
def test_a_transparent_card_changes_nothing(card, without_card):
    assert error(through_card(cases.TRANSPARENT[card]), without_card) <= 0.02


@pytest.mark.slow
def test_the_edge_of_a_surface_seen_slantwise_lies_where_rays_see_it():
    """At 5 degrees one side of the pupil gets 1.5 times the light of the other, which would move blurred edges."""
    found = cases.captures(cases.slanted("transparent mask"), spp=16)
    rays, waves = (capture.image.reshape(16, 16, -1).mean(axis=(1, 2))[3:11] for capture in found)
    assert (waves - rays).sum() / rays.max() == pytest.approx(0, abs=0.03)


@pytest.mark.slow
def test_a_sky_does_not_shine_through_a_black_card():
    capture = cases.by_signed_rays(cases.card_before(10, 2.0, sky={"type": "constant"}), spp=16)
    columns = reconstruct(capture, 1000.0).image[4:-4].mean(axis=0)
    middle = len(columns) // 2
    assert columns[middle - 3] <= 0.03 and columns[middle + 2] > 0.8


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(cases.in_fog, marks=pytest.mark.slow),
        pytest.param(lambda: cases.lamp_behind_glass(True), marks=pytest.mark.slow),
        lambda: cases.lit_mirror(2),
        pytest.param(lambda: cases.plastic(6), marks=pytest.mark.slow),
    ],
    ids=["fog", "lamp behind glass, hidden", "mirror", "plastic"],
)
def test_energy_is_that_of_rays(scene):
    assert cases.energy(*cases.captures(scene())) == pytest.approx(0.995, abs=0.015)


@pytest.mark.slow
def test_a_shiny_metal_lights_the_half_of_the_pupil_that_its_lamp_shines_to():
    """Rays, blurred by the diffraction of a square microlens."""
    metal = {"type": "roughconductor", "material": "none", "alpha": 0.005}
    by_rays, by_waves = cases.captures(cases.half_lit(metal, 0.0), spp=256)
    camera = by_rays.camera
    x = (np.arange(9 * 65) - 9 * 32 - 4) / 9 * camera.pixel_size
    spot = (np.sinc(x / design.spot_radius(camera, WAVELENGTH)) ** 2).reshape(65, 9).sum(axis=1)
    blurred = convolve1d(convolve1d(by_rays.image, spot / spot.sum(), axis=0), spot / spot.sum(), axis=1)
    inside = (slice(16, -16), slice(16, -16))
    assert error(by_waves.image[inside], blurred[inside]) <= 0.05
    shares = []
    for image in (by_waves.image, blurred):
        left, right = (half.mean() for half in np.split(image[inside].reshape(-1, 2, 8).mean(axis=0), 2))
        shares.append(max(left, right) / min(left, right))
    assert shares[1] > 3.5 and shares[0] == pytest.approx(shares[1], rel=0.03)


SHARED = {"resolution": 128, "detector_width": 0.256}
"""Four lenses across: the camera of most tests, so that what is planned for it is planned once a wavelength."""


@pytest.mark.parametrize("method", ["signed_rays", "points"])
def test_negative_light_is_refused(camera_dict, method):
    """Negative pixels are taken for noise, and points that do not shine are left out."""
    dark = disk((0.0, 0.0, 240.0), 2.0, emitter={"type": "area", "radiance": -1.0})
    scene = cases.scene_of(camera_dict(resolution=16, detector_width=0.128), dark=dark)
    assert render_capture(scene, spp=2).image.min() == -1
    with pytest.raises(InputError, match=r"^scene: 100%"):
        render_capture(scene, model="wave", method=method, spp=4)


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name != "llvm_ad_spectral_polarized"))
        for name in mi.variants()
        if name.startswith("llvm")
    ],
)
def test_every_variant_records_the_same_light(variant, camera_dict):
    mi.set_variant(variant)
    coloured = variant == "llvm_ad_rgb"
    sensor = camera_dict(**SHARED, film={"pixel_format": "rgb" if coloured else "luminance"})
    even = {"type": "uniform", "value": 0.5}  # of all wavelengths; a number would mean daylight
    scene = cases.scene_of(sensor, wall=disk((0, 0, 240.0), 20.0, emitter={"type": "area", "radiance": even}))
    wave = cases.by_signed_rays(scene, wavelength="611.4, 549.1, 464.3" if mi.is_rgb else 549.1)
    ray = render_capture(scene, spp=256)
    assert wave.wavelength == ((611.4, 549.1, 464.3) if coloured else 549.1)
    assert wave.image.shape == ray.image.shape == ((128, 128, 3) if coloured else (128, 128))
    assert ray.image.max() == pytest.approx(0.5, rel=0.1)
    np.testing.assert_allclose(wave.image.mean((0, 1)) / ray.image.mean((0, 1)), 0.995, rtol=0.01)


def test_models_wrap_and_unwrap_the_scenes_integrator(camera_dict):
    waves = {"type": "plenoptic_wave", "method": "signed_rays", "child": {"type": "direct"}}
    scene = cases.scene_of(camera_dict(**SHARED), waves, point=disk((0, 0, 240.0), 0.3))
    own = render_capture(scene, spp=1)
    assert (own.model, own.wavelength, own.metadata["method"]) == ("wave", 633, "signed_rays")
    changed = render_capture(scene, spp=1, wavelength=549.1)
    assert (changed.wavelength, changed.metadata["method"]) == (549.1, "signed_rays")
    assert render_capture(scene, model="ray", spp=1).metadata["integrator"] == "DirectIntegrator"
    assert "method = signed_rays" in str(scene.integrator())


@pytest.mark.parametrize(
    ("variant", "channels", "pixel_format"), [("llvm_ad_mono", 1, "rgb"), ("llvm_ad_rgb", 3, "luminance")]
)
def test_film_forward_and_back(variant, channels, pixel_format):
    mi.set_variant(variant)
    plate = mi.load_dict(film(7, 5) | {"pixel_format": pixel_format})
    x = np.random.default_rng(0).normal(size=(5, 7, channels)).astype(np.float32)
    light, image = developed(plate, np.ones_like(x))
    dr.set_grad(light, mi.TensorXf(x))
    change = np.array(dr.forward_to(image))
    y = np.random.default_rng(1).normal(size=change.shape).astype(np.float32)
    light, image = developed(plate, np.ones_like(x))
    dr.backward(dr.sum(image * mi.TensorXf(y), axis=None))
    assert np.vdot(change, y) == pytest.approx(np.vdot(x, dr.grad(light)), rel=1e-5)
