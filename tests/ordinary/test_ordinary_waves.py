"""An ordinary camera, without a microlens array, by waves: against sums over the pupil that are computed here."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cases import ORDINARY_WAVELENGTH, diffracted, facing, ordinary_camera, relative, scene_of, textured_wall

import mitsuba_plenoptic as mp
from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.waves.pupil_diffraction import PupilDiffraction
from mitsuba_plenoptic.waves.pupil_sampler import PupilSampler
from tools.bench.cases.ordinary_cameras import noisy_scene


def by_waves(scene, spp, **options):
    options = {"wavelength": ORDINARY_WAVELENGTH} | options
    return mp.render_capture(scene, model="wave", spp=spp, **options).image.astype(float)


# Path in waves of 550 nm, with Noll's coefficients in waves of 633 nm: coma, astigmatism.
COMA = (0.0,) * 7 + (0.15,)
ASTIGMATISM = (0.0,) * 5 + (0.06,)
PATHS = {
    COMA: lambda x, y: 0.15 * 633 / 550 * np.sqrt(8) * (3 * (x * x + y * y) - 2) * x,
    ASTIGMATISM: lambda x, y: 0.06 * 633 / 550 * np.sqrt(6) * (x * x - y * y),
    (): None,
}


@pytest.mark.parametrize(
    ("airy", "blur", "texel", "wavefront", "limit"),
    [
        (1, 0, 4, (), 0.008),
        pytest.param(10, 1, 2, (), 0.012, marks=pytest.mark.slow),
        # Somewhere in the pupil the defocus undoes the aberration.
        pytest.param(1, 4, 4, COMA, 0.011, marks=pytest.mark.slow),
        pytest.param(1, -1, 4, ASTIGMATISM, 0.012, marks=pytest.mark.slow),
    ],
)
def test_textured_walls_in_focus_and_blurred(airy, blur, texel, wavefront, limit):
    """Rays alone differ by two to fifty times the limit; what noise there is is included in it."""
    camera = ordinary_camera(airy, 32, wavefront=wavefront)
    scene, picture = textured_wall(camera, texel, blur)
    expected = diffracted(camera, picture, texel, blur, PATHS[wavefront])
    found = by_waves(scene, 1024)
    assert relative(found, expected) < limit
    assert found.sum() == pytest.approx(expected.sum(), rel=3e-3)


def test_coarse_pixels_displace_rays_by_finite_steps():
    """At borders of cells of the point spread function, too, of which a capture of some 10^7 rays meets a few."""
    camera = mp.PlenopticCamera.preset("full_frame_50mm")
    plan = PupilDiffraction(camera, 633.0)
    assert plan.is_coarse
    borders = np.array([0, 1e-8, 0.5, 1 - 1.2e-7, 1 - 6e-8], np.float32)
    random = [mi.Float(values.ravel()) for values in np.meshgrid(borders, borders)]
    assert np.isfinite(np.array(PupilSampler(camera, [plan])._displacement(random))).all()


def test_white_has_hardly_any_noise():
    """Every coefficient but the first is of light less its mean; far beyond the film some pixels stand for others."""
    image = by_waves(scene_of(ordinary_camera(1.0, 16).to_sensor(), "path", sky={"type": "constant"}), 8)
    assert np.allclose(image, 1, atol=1e-3)


def textured(camera):
    texture = mi.Bitmap(np.random.default_rng(0).random((8, 8, 3)).astype(np.float32))
    reflectance = {"type": "bitmap", "bitmap": texture, "filter_type": "nearest"}
    card = facing(250.0, 3.0, bsdf={"type": "diffuse", "reflectance": reflectance})
    return scene_of(camera.to_sensor(), "path", wall=card, sky={"type": "constant"})


SMALL = {"mla_lattice": "none", "resolution": (24, 16), "detector_width": 24 * 0.008}
F10 = SMALL | {"focal_length": 80, "aperture_radius": 4, "focus_distance": 240}


def test_noise_is_no_larger_than_that_of_rays():
    """Neighbours share rays, where diffraction blurs."""
    scene, _ = textured_wall(ordinary_camera(1.0, 24), 3, 0.5)
    spread = {}
    for model, options in (("ray", {}), ("wave", {"wavelength": ORDINARY_WAVELENGTH})):
        images = [mp.render_capture(scene, model=model, spp=32, seed=seed, **options).image for seed in range(6)]
        spread[model] = np.var(images, axis=0, ddof=1).mean()
    assert spread["wave"] < 1.2 * spread["ray"]


@pytest.mark.slow
def test_few_samples_have_the_mean_of_many(kind="textured wall", airy=2.0, seen=0.05):
    """Means over captures of two samples each, whose noise would show a difference of `seen`."""
    scene, taken = noisy_scene(kind, airy, 16), {}
    for spp, seeds in ((2, range(48)), (512, range(100, 104))):
        images = [by_waves(scene, spp, seed=seed) for seed in seeds]
        taken[spp] = np.mean(images, 0), np.var(images, 0, ddof=1) / len(images)

    def disagreement(factor):
        (few, noise), (many, least) = taken[2], taken[512]
        return ((factor * few - many) ** 2).sum() / (noise + least).sum()

    assert disagreement(1.0) < 1.7 and min(disagreement(1 - seen), disagreement(1 + seen)) > 2


def test_what_waves_refuse():
    with pytest.raises(InputError, match=r"detector_width = 0.01: pixels of 0.000417 mm"):
        by_waves(textured(mp.PlenopticCamera(**F10 | {"detector_width": 0.01})), 2)
    with pytest.raises(InputError, match="mla_lattice = none"):
        by_waves(textured(mp.PlenopticCamera(**F10)), 2, method="points")
    scene = textured(mp.PlenopticCamera(**F10))
    parameters = mi.traverse(scene)
    (key,) = (key for key in parameters.keys() if key.endswith("focal_length"))  # noqa: SIM118
    dr.enable_grad(parameters[key])
    parameters.update()
    image = mi.render(scene, parameters, integrator=mi.load_dict({"type": "plenoptic_wave"}), spp=2)
    with pytest.raises(Exception, match=r"derivatives of .*mla_lattice = none"):
        dr.backward(dr.sum(image, axis=None))
