"""Derivatives of captures by signed rays by a scene's light: against differences, closed forms, and one another."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from cases import facing, radiating, scene_of, sensor

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.detector.noise import NonNegative
from mitsuba_plenoptic.waves import signed_rays

POINT = {"type": "point", "position": [0.0, 40.0, 0.0], "intensity": 3e4}
RADIANCE, ROUGHNESS = "wall.emitter.radiance.value", "wall.bsdf.alpha.value"
REFLECTANCE = "wall.bsdf.reflectance.data"
SIGMA, ALBEDO = "fog.interior_medium.sigma_t.value.value", "fog.interior_medium.albedo.value.value"


def texture():
    texels = np.random.default_rng(1).uniform(0.2, 1, (4, 4, 1 if "mono" in mi.variant() else 3)).astype(np.float32)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(texels)}


def lamp():
    aside = mi.ScalarTransform4f().translate([0, 20, 150]).rotate([1, 0, 0], 15).scale(3)
    return {"type": "rectangle", "to_world": aside, **radiating(50.0)}


def through(child, **options):
    return {"type": "plenoptic_wave", "method": "signed_rays", "child": {"type": child, **options}}


def wall_of(bsdf, light=POINT):
    return scene_of(sensor(4, 8), through("path"), wall=facing(250.0, 0.3, bsdf=bsdf), lamp=light)


def gaussians():
    """Return the scene of some Gaussians, which add up in sRGB."""
    random, count = np.random.default_rng(3), 12
    values = {
        "centers": random.uniform((-0.1, -0.1, 230), (0.1, 0.1, 250), (count, 3)),
        "scales": np.full((count, 3), 0.04),
        "quaternions": np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        "opacities": random.uniform(0.3, 0.8, (count, 1)),
        "sh_coeffs": random.uniform(-0.5, 1.0, (count, 3)),
    }
    shape = {"type": "ellipsoids", **{name: mi.TensorXf(value.astype(np.float32)) for name, value in values.items()}}
    return scene_of(sensor(4, 8), through("volprim_rf_basic"), gaussians=shape)


@pytest.mark.slow
def test_attributes_of_shapes_against_differences_and_places_refused():
    mi.set_variant("llvm_ad_rgb")
    scene, key, place = gaussians(), "gaussians.opacities", "gaussians.data"
    gradient = np.random.default_rng(2).uniform(0, 1, captured(scene, spp=1).shape)
    expected = np.vdot(difference(scene, key, 5e-3, 64), gradient)
    assert pulled(scene, key, gradient, 64) == pytest.approx(expected, rel=0.01)
    params = mi.traverse(scene)
    dr.enable_grad(params[place])
    with pytest.raises(InputError, match=f"^plenoptic_wave: {place}: "):
        scene.integrator().render_backward(scene, params, dr.ones(mi.TensorXf, (32, 32, 3)))
    dr.disable_grad(params[place])


def fog(**medium):
    cube = mi.ScalarTransform4f().translate([0, 0, 240]).scale([20, 20, 10])
    medium = {"type": "homogeneous", "sigma_t": 0.03, **medium}
    return {"type": "cube", "to_world": cube, "bsdf": {"type": "null"}, "interior": medium}


SCENES = {
    "lit texture": lambda: (wall_of({"type": "diffuse", "reflectance": texture()}, light=lamp()), REFLECTANCE),
    "lamp": lambda: (wall_of({"type": "plastic"}, light=lamp()), "lamp.emitter.radiance.value"),
    "rough conductor": lambda: (wall_of({"type": "roughconductor", "alpha": 0.3}), ROUGHNESS),
}


def captured(scene, seed=0, spp=16):
    return np.array(scene.integrator().render(scene, seed=seed, spp=spp), np.float64)


def direction_of(value):
    if isinstance(value, mi.TensorXf):
        return mi.TensorXf(np.random.default_rng(5).uniform(-0.2, 0.2, value.shape).astype(np.float32))
    return dr.full(type(value), 1.0, dr.width(value))


def difference(scene, key, step, spp=16):
    params = mi.traverse(scene)
    start = type(params[key])(params[key])
    direction, sides = direction_of(start), []
    for side in (step, -step):
        params[key] = start + side * direction
        params.update()
        sides.append(captured(scene, spp=spp))
    params[key] = start
    params.update()
    return (sides[0] - sides[1]) / (2 * step)


def pushed(scene, key, spp=16):
    params, amount = mi.traverse(scene), mi.Float(0)
    start = type(params[key])(params[key])
    dr.enable_grad(amount)
    params[key] = start + amount * direction_of(start)
    params.update()
    dr.forward(amount, dr.ADFlag.ClearEdges)
    change = np.array(scene.integrator().render_forward(scene, params, scene.sensors()[0], spp=spp), np.float64)
    dr.disable_grad(params[key])
    params[key] = start
    params.update()
    return change


def pulled(scene, key, gradient, spp=16):
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    params.update()
    given = mi.TensorXf(gradient.astype(np.float32))
    scene.integrator().render_backward(scene, params, given, scene.sensors()[0], spp=spp)
    found = np.vdot(np.ravel(np.array(dr.grad(params[key]))), np.ravel(np.array(direction_of(params[key]))))
    # Mitsuba follows parameters of all scenes that there are.
    dr.disable_grad(params[key])
    params.update()
    return found


def disagreement(scene, key, change):
    gradient = np.random.default_rng(2).normal(size=change.shape)
    back = pulled(scene, key, gradient)
    return abs(np.vdot(change, gradient) - back) / (np.linalg.norm(change) * np.linalg.norm(gradient))


@pytest.mark.parametrize("case", ["lit texture", pytest.param("lamp", marks=pytest.mark.slow), "rough conductor"])
def test_against_differences_of_captures_with_the_same_rays_and_reverse_against_forward(case):
    scene, key = SCENES[case]()
    change = pushed(scene, key)
    assert np.linalg.norm(change) > 0.01 * np.linalg.norm(captured(scene))
    assert error(change, difference(scene, key, 0.005)) < 0.01
    assert disagreement(scene, key, change) < 1e-6


@pytest.mark.slow
def test_nodes_of_wavelengths():
    """By the radiance of a wall, to which captures are proportional, projected as they are."""
    mi.set_variant("llvm_ad_rgb")
    camera = sensor(4, 8, glass='{"index": 1.5168, "abbe": 64.2}')
    camera["film"]["pixel_format"] = "rgb"
    colours = {"responses": "srgb", "nodes": 2}
    scene = scene_of(camera, through("path") | colours, wall=facing(250.0, 0.3, **radiating(0.5)))
    change = pushed(scene, RADIANCE)
    assert error(change, captured(scene) / 0.5) < 1e-5
    assert disagreement(scene, RADIANCE, change) < 1e-6


def test_absorbing_fog_darkens_by_its_thickness_and_light_scattered_once_is_proportional_to_the_albedo():
    scene = scene_of(sensor(4, 8), through("volpath"), fog=fog(albedo=0.0), wall=facing(260.0, 20.0, **radiating()))
    weights = np.ones((32, 32, 1))
    assert pulled(scene, SIGMA, weights, spp=256) == pytest.approx(-20 * captured(scene, spp=256).sum(), rel=0.01)
    scene = scene_of(sensor(4, 8), through("prbvolpath", max_depth=2), fog=fog(albedo=0.6), lamp=POINT)
    assert pulled(scene, ALBEDO, weights) == pytest.approx(captured(scene).sum() / 0.6, rel=0.01)


def test_in_blocks_and_lots(monkeypatch):
    scene = wall_of({"type": "diffuse", "reflectance": texture()})
    monkeypatch.setattr(signed_rays, "_BLOCK_BYTES", 2**22)
    monkeypatch.setattr(signed_rays, "_LANES", 2**17)
    assert disagreement(scene, REFLECTANCE, pushed(scene, REFLECTANCE)) < 1e-6


def test_what_is_black_has_a_derivative_too():
    scene = scene_of(sensor(4, 8), through("path"), wall=facing(250.0, 0.3, **radiating(0.0)))
    change = pushed(scene, RADIANCE)
    bright = captured(scene_of(sensor(4, 8), through("path"), wall=facing(250.0, 0.3, **radiating())))
    # What is projected below zero in the one is not in the other, which changes the sum a little, too.
    assert error(change, bright) < 0.1
    assert change.sum() == pytest.approx(bright.sum(), rel=0.01)


def test_projected_images_have_derivatives():
    rng = np.random.default_rng(0)
    image, change, gradient = (rng.normal(mean, 1, (21, 30)) for mean in (0.7, 0, 0))
    projection, step = NonNegative(image), 1e-6
    sides = [NonNegative(image + side * change).image for side in (step, -step)]
    assert error(projection.forward(change), (sides[0] - sides[1]) / (2 * step)) < 1e-6
    there, back = np.vdot(projection.forward(change), gradient), np.vdot(change, projection.backward(gradient))
    assert there == pytest.approx(back)
