"""Captures of scenes by signed rays, against closed forms, rays, and one another."""

import mitsuba as mi
import numpy as np
import pytest
from cases import facing, radiating, scene_of, sensor, spot_filtered
from scipy.ndimage import gaussian_filter

from mitsuba_plenoptic import InputError, PlenopticCamera, estimate_capture, render_capture
from mitsuba_plenoptic.detector.noise import NonNegative
from mitsuba_plenoptic.fields.lens_kinds import LensKinds
from mitsuba_plenoptic.waves.signed_rays import SignedRaySum

BLACK = {"type": "diffuse", "reflectance": 0.0}


def wall(distance=240.0):
    return facing(distance, 60.0, **radiating())


def by_waves(scene, spp=16, **options):
    return render_capture(scene, model="wave", method="signed_rays", spp=spp, **options)


def quarters(image, lenses):
    """Return the means over quarters of the inner micro-images: (lenses, upper and lower, lenses, left and right)."""
    half = image.shape[0] // lenses // 2
    inner = image.reshape(2 * lenses, half, 2 * lenses, half).mean((1, 3))[4:-4, 4:-4]
    return inner.reshape(lenses - 4, 2, lenses - 4, 2)


def turned(x, y, power):
    """Return the slopes behind points of a lens of a ray that is parallel to its axis, by its direction cosines."""
    sx, sy = -x * power, -y * power
    along = np.sqrt(1 - sx * sx - sy * sy)
    return sx / along, sy / along


@pytest.mark.parametrize("parameters", [{"mla_focal_length": 0.2, "detector_distance": 0.2}, {"mla_fill": 0.5}])
def test_micro_images_are_darker_as_their_lenses_spread_light(parameters):
    camera = PlenopticCamera(**parameters)
    (focal_length,) = camera.mla_focal_lengths
    # A change of slope before a lens moves where light lands: by the lens's points, with finite differences.
    power, half, step = 1 / focal_length - 1 / camera.mla_distance, camera.mla_fill * 0.064 / 2, 1e-4
    x, y = np.meshgrid(*2 * [(np.arange(64) + 0.5) / 64 * 2 * half - half])
    across, up = (
        np.subtract(turned(x + du, y + dv, power), turned(x - du, y - dv, power)) / (2 * step)
        for du, dv in ((step / power, 0), (0, step / power))
    )
    brightness = np.mean(1 / (across[0] * up[1] - across[1] * up[0]))
    assert LensKinds(camera).enlargement(focal_length) ** -2 == pytest.approx(brightness, rel=1e-4)


@pytest.mark.slow
def test_enlarged_micro_images_keep_their_light(monkeypatch):
    focal = {"mla_focal_length": 0.256, "detector_distance": 0.256}
    scene = scene_of(sensor(6, 32, **focal), wall=wall())
    brightness = LensKinds(PlenopticCamera(**focal)).enlargement(0.256)
    enlarged = by_waves(scene).image
    monkeypatch.setattr(LensKinds, "enlargement", lambda *_: 1.0)
    before = by_waves(scene).image
    assert enlarged.sum() == pytest.approx(before.sum(), rel=2e-3)
    middle = np.s_[1:5, 14:18, 1:5, 14:18]
    enlarged, before = (image.reshape(6, 32, 6, 32)[middle].mean() for image in (enlarged, before))
    # Diffraction by the lenses smooths both.
    assert enlarged / before == pytest.approx(brightness**-2, abs=4e-3)


def smoothed_captures(**parameters):
    """Return captures of a wall by rays and by waves, with what lenses diffract smoothed away."""
    mi.set_variant("llvm_ad_mono")
    size = {"detector_width": 0.576, "resolution": (96, 96), "lens_model": "parabolic"}
    scene = scene_of(PlenopticCamera(**size, **parameters).to_sensor(), wall=facing(240.0, 30.0, **radiating()))
    rays, waves = render_capture(scene, model="ray", spp=256).image, by_waves(scene, spp=192).image
    # The ray capture is brighter by its thin phase elements' second order.
    assert waves.mean() == pytest.approx(rays.mean(), rel=0.025)
    # The border lacks what comes from beyond it.
    return [gaussian_filter(image, 2.5)[12:-12, 12:-12] for image in (rays, waves)]


@pytest.fixture(scope="module")
def by_the_even_array():
    return smoothed_captures()


@pytest.mark.slow
@pytest.mark.parametrize(
    "parameters",
    [
        {"mla_jitter": (0.003, 0.0), "mla_seed": 3},
        {"pixel_response": (0.0, 1.0, 3.0, 0.6)},
        {"mla_focal_length": (0.583, 0.524, 0.561), "mla_lattice": "hexagonal", "mla_pitch": 0.12744,
         "detector_distance": 0.3371, "focal_length": 49.885, "aperture_radius": 6.2356, "mla_distance": 56.86},
    ],
    ids=["displaced lenses", "angular response", "far out of focus"],
)  # fmt: skip
def test_irregular_arrays_change_a_capture_as_they_change_one_by_rays(parameters, by_the_even_array):
    by_rays, by_signed = np.subtract(smoothed_captures(**parameters), by_the_even_array)
    assert np.linalg.norm(by_signed - by_rays) < 0.3 * np.linalg.norm(by_rays)


def test_lenses_of_uneven_focal_lengths_are_of_the_nearest_kind():
    mi.set_variant("llvm_ad_mono")
    camera = PlenopticCamera(mla_jitter=(0.0, 0.02), mla_seed=7)
    kinds, i, j = LensKinds(camera), *np.random.default_rng(0).integers(-60, 60, (2, 500))
    number = kinds.number(mi.Float(i), mi.Float(j), 0.0).numpy()
    given = np.array([kind.focal_length for kind in kinds.every])[number]
    own = camera.lenslet(i, j).focal_length
    step = camera.mla_focal_length * (kinds.every[1].focal_length / kinds.every[0].focal_length - 1)
    assert np.abs(given - own).max() < 0.55 * step < 0.005
    assert len(set(number)) == len(kinds.every) > 3


def test_what_covers_half_of_the_pupil_darkens_halves_of_micro_images():
    pane = facing(1.0, (10.0, 20.0), (10.0, 0.0), bsdf={"type": "mask", "opacity": 0.7, "nested": BLACK})
    scene = scene_of(sensor(10, 16), pane=pane, wall=wall())
    # Diffraction carries a little across the border.
    by_rays = spot_filtered(render_capture(scene, model="ray", spp=64).image, scene.sensors()[0].camera)
    rays, waves = (quarters(image, 10).mean((0, 1, 2)) for image in (by_rays, by_waves(scene).image))
    assert waves.min() / waves.max() == pytest.approx(rays.min() / rays.max(), abs=0.03)
    assert np.argmin(waves) == np.argmin(rays)


def test_what_differs_from_lens_to_lens_behind_a_pane_is_seen():
    # Of four lenses, before a wall far behind.
    stripes = {f"stripe_{i}": facing(240.0, (0.256, 20.0), (1.024 * i, 0.0), bsdf=BLACK) for i in range(-8, 9)}
    scene = scene_of(sensor(16, 8), **stripes, wall=wall(262.0))
    rays, waves = (
        image[:, 16:-16].reshape(128, -1, 8).mean((0, 2))
        for image in (render_capture(scene, model="ray", spp=64).image, by_waves(scene, spp=32).image)
    )
    contrast = [np.ptp(lenses) / lenses.mean() for lenses in (rays, waves)]
    assert contrast[0] > 1.5 and contrast[1] == pytest.approx(contrast[0], rel=0.03)


def test_estimates_abandon_the_capture_and_state_the_memory_that_is_refused(monkeypatch):
    scene = scene_of(sensor(4, 8), wall=wall())
    monkeypatch.setattr("mitsuba_plenoptic.runtime.progress.SETTLED", 0.0)
    monkeypatch.setattr("mitsuba_plenoptic.waves.signed_rays._LANES", 2**12)
    with monkeypatch.context() as patched:
        patched.setattr(SignedRaySum, "image", lambda *_: pytest.fail("not abandoned"))
        cost = estimate_capture(scene, model="wave", method="signed_rays")
    assert 0 < cost.seconds < 600
    monkeypatch.setenv("MITSUBA_PLENOPTIC_MEMORY", f"{0.99 * cost.memory / 2**30:.9f}")
    with pytest.raises(InputError, match=r"wave capture of 32 x 32 pixels, nodes = 1"):
        by_waves(scene)


def test_black_scenes_are_black_and_said_to_be():
    with pytest.warns(UserWarning, match="none of the rays meets anything that shines"):
        image = by_waves(scene_of(sensor(4, 8), card=facing(240.0, 5.0, bsdf=BLACK))).image
    assert not image.any()


def test_few_samples_have_the_light_of_many():
    """Rays whose own light were among what is subtracted would keep a part of it undiffracted."""
    scene = scene_of(sensor(4, 16), lamp=facing(240.0, 0.1, **radiating()))
    few = np.mean([by_waves(scene, 2, seed=seed).image.sum() for seed in range(20)])
    assert few == pytest.approx(by_waves(scene, 256).image.sum(), rel=0.02)


def test_compensation_keeps_the_sum_and_moves_light_little():
    image = np.random.default_rng(0).standard_normal((37, 50)) + 0.2
    projection = NonNegative(image).image
    assert projection.min() >= 0
    assert projection.sum() == pytest.approx(image.sum(), rel=1e-12)
    # No square of 4 x 4 pixels gains light, and those below zero become black.
    before, after = (each[:36, :48].reshape(9, 4, 12, 4).sum((1, 3)) for each in (image, projection))
    assert (after <= np.maximum(before, 0) + 1e-12).all()
    assert not NonNegative(-np.abs(image)).image.any()
