"""Derivatives of captures by signed rays by a scene's light: against differences, closed forms, and one another."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cameras import error
from cases import facing, radiating, scene_of, sensor

from mitsuba_plenoptic import InputError, PlenopticCamera, render_capture
from mitsuba_plenoptic.detector.noise import NonNegative
from mitsuba_plenoptic.waves import signed_rays
from mitsuba_plenoptic.waves.phase_space import PhaseSpace

POINT = {"type": "point", "position": [0.0, 40.0, 0.0], "intensity": 3e4}
RADIANCE, ROUGHNESS = "wall.emitter.radiance.value", "wall.bsdf.alpha.value"
SIGMA, ALBEDO = "fog.interior_medium.sigma_t.value.value", "fog.interior_medium.albedo.value.value"


def texture():
    channels = 1 if "mono" in mi.variant() else 3
    texels = np.random.default_rng(1).uniform(0.2, 1, (4, 4, channels)).astype(np.float32)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(texels)}


def lamp():
    """Return a lamp beside the camera that shines on what is before it."""
    aside = mi.ScalarTransform4f().translate([0, 20, 150]).rotate([1, 0, 0], 15).scale(3)
    return {"type": "rectangle", "to_world": aside, **radiating(50.0)}


def through(child, method="signed_rays", **options):
    return {"type": "plenoptic_wave", "method": method, "child": {"type": child, **options}}


def wall_of(bsdf, camera=None, child="path", light=POINT):
    """Return the scene of a wall smaller than the field."""
    return scene_of(camera or sensor(4, 8), through(child), wall=facing(250.0, 0.3, bsdf=bsdf), lamp=light)


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


def painted():
    """Return the scene of a wall with a colour at each corner."""
    mesh = mi.Mesh("wall", 4, 2, has_vertex_texcoords=True)
    values = mi.traverse(mesh)
    values["vertex_positions"] = [-1, -1, 240, 1, -1, 240, -1, 1, 240, 1, 1, 240]
    values["faces"] = [0, 2, 1, 1, 2, 3]
    values.update()
    mesh.add_attribute("vertex_color", 3, np.random.default_rng(0).uniform(0.2, 0.9, 12).astype(np.float32))
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    bsdf = mi.load_dict({"type": "twosided", "child": {"type": "diffuse", "reflectance": colour}})
    mesh.set_bsdf(bsdf)
    return scene_of(sensor(4, 8), through("path"), wall=mesh, sky={"type": "constant"})


@pytest.mark.parametrize(
    ("make", "key"),
    [
        pytest.param(gaussians, "gaussians.sh_coeffs", marks=pytest.mark.slow),
        (gaussians, "gaussians.opacities"),
        (painted, "wall.vertex_color"),
    ],
)
def test_attributes_of_shapes_against_differences_and_places_refused(make, key):
    mi.set_variant("llvm_ad_rgb")
    scene = make()
    params = mi.traverse(scene)
    gradient = np.random.default_rng(2).uniform(0, 1, captured(scene, spp=1).shape)
    start = type(params[key])(params[key])
    sides = []
    for side in (1, -1):
        params[key] = start + side * 5e-3
        params.update()
        sides.append(np.vdot(captured(scene), gradient))
    params[key] = start
    params.update()
    assert pulled(scene, key, gradient) == pytest.approx((sides[0] - sides[1]) / 1e-2, rel=0.01)
    place = key.rpartition(".")[0] + (".data" if make is gaussians else ".vertex_positions")
    dr.enable_grad(params[place])
    with pytest.raises(InputError, match=f"^plenoptic_wave: {place}: it has no gradient: places .* by rays"):
        scene.integrator().render_backward(scene, params, dr.ones(mi.TensorXf, (32, 32, 3)))
    dr.disable_grad(params[place])


def fog(**medium):
    cube = mi.ScalarTransform4f().translate([0, 0, 240]).scale([20, 20, 10])
    medium = {"type": "homogeneous", "sigma_t": 0.03, **medium}
    return {"type": "cube", "to_world": cube, "bsdf": {"type": "null"}, "interior": medium}


def textured(parameters, variant="llvm_ad_mono"):
    """Return the scene of a lit texture before a camera whose film has the variant's colours."""
    mi.set_variant(variant)
    camera = sensor(4, 8, **parameters)
    camera["film"]["pixel_format"] = "rgb" if mi.is_rgb else "luminance"
    return wall_of({"type": "diffuse", "reflectance": texture()}, camera), "wall.bsdf.reflectance.data"


SCENES = {
    "shining texture": lambda: (
        scene_of(
            sensor(4, 8),
            through("path"),
            wall=facing(240.0, 0.2, (0.05, 0.02), emitter={"type": "area", "radiance": texture()}),
        ),
        "wall.emitter.radiance.data",
    ),
    "lit texture": lambda: (
        wall_of({"type": "diffuse", "reflectance": texture()}, light=lamp()),
        "wall.bsdf.reflectance.data",
    ),
    "lamp": lambda: (wall_of({"type": "plastic"}, light=lamp()), "lamp.emitter.radiance.value"),
    "rough conductor": lambda: (wall_of({"type": "roughconductor", "alpha": 0.3}), ROUGHNESS),
    "principled": lambda: (
        wall_of({"type": "principled", "roughness": 0.5, "metallic": 0.5}),
        "wall.bsdf.roughness.value",
    ),
    "three focal lengths": lambda: textured({"mla_lattice": "hexagonal", "mla_focal_length": "0.48, 0.512, 0.55"}),
    "discs": lambda: textured({"mla_aperture": "circle"}),
    "colours": lambda: textured({}, "llvm_ad_rgb"),
}
SLOW = ("shining texture", "principled", "three focal lengths", "discs", "colours")


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
    """Return how far reverse is from forward."""
    gradient = np.random.default_rng(2).normal(size=change.shape)
    back = pulled(scene, key, gradient)
    return abs(np.vdot(change, gradient) - back) / (np.linalg.norm(change) * np.linalg.norm(gradient))


@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.slow] * (case in SLOW)) for case in SCENES])
def test_against_differences_of_captures_with_the_same_rays_and_reverse_against_forward(case):
    scene, key = SCENES[case]()
    change = pushed(scene, key)
    assert np.linalg.norm(change) > 0.01 * np.linalg.norm(captured(scene))
    assert change.shape == ((32, 32, 3) if case == "colours" else (32, 32, 1))
    assert error(change, difference(scene, key, 0.005)) < 0.01
    assert disagreement(scene, key, change) < 1e-6


@pytest.mark.slow
def test_gloss_that_lamps_of_some_size_light():
    """Light paths change with the roughness, so that differences have noise of their own."""
    scene = wall_of({"type": "roughconductor", "alpha": 0.3}, child="prb", light=lamp())
    weights = np.ones((32, 32, 1))
    expected = np.vdot(difference(scene, ROUGHNESS, 0.01, spp=1024), weights)
    assert pulled(scene, ROUGHNESS, weights, spp=1024) == pytest.approx(expected, rel=0.01)


def proportional(scene):
    """Check derivatives by the radiance of a wall, to which captures are proportional, projected as they are."""
    start = np.ravel(np.array(mi.traverse(scene)[RADIANCE]))[0]
    change = pushed(scene, RADIANCE)
    assert error(change, captured(scene) / start) < 1e-5
    assert disagreement(scene, RADIANCE, change) < 1e-6


@pytest.mark.parametrize(
    ("variant", "colours", "parameters"),
    [
        pytest.param("llvm_ad_mono", {"bandwidth": 100.0, "nodes": 2}, {}, marks=pytest.mark.slow),
        pytest.param("llvm_ad_rgb", {"responses": "srgb", "nodes": 2}, {}, marks=pytest.mark.slow),
        pytest.param(
            "llvm_ad_rgb",
            {"wavelength": "650, 550, 450"},
            {"glass": '{"index": 1.5168, "abbe": 64.2}'},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["band", "responses", "lines through a glass"],
)
def test_nodes_of_wavelengths(variant, colours, parameters):
    mi.set_variant(variant)
    camera = sensor(4, 8, **parameters)
    camera["film"]["pixel_format"] = "rgb" if "rgb" in variant else "luminance"
    proportional(scene_of(camera, through("path") | colours, wall=facing(250.0, 0.3, **radiating(0.5))))


@pytest.mark.parametrize(
    "parameters",
    [
        {"pixel_response": (0.0, 1.0, 3.0, 0.6), "wavefront": (0, 0, 0, 0.1), "mla_jitter": (0.003, 0.0)},
        # Each ray lands by its own point of a lens.
        {"detector_distance": 0.4, "mla_focal_length": 0.6, "mla_tilt": (1.0, -0.5)},
    ],
    ids=["angular response", "far out of focus"],
)
def test_other_cameras(parameters):
    camera = PlenopticCamera(resolution=(32, 32), detector_width=0.384, lens_model="parabolic", **parameters)
    assert PhaseSpace(camera, 633.0).lands_by_point == ("mla_tilt" in parameters)
    proportional(scene_of(camera.to_sensor(), through("path"), wall=facing(250.0, 0.3, **radiating(0.5))))


@pytest.mark.slow
def test_a_double_gauss():
    camera = PlenopticCamera.preset("paper_double_gauss")
    camera = camera.replace(resolution=(32, 32), detector_width=4 * camera.mla_pitch)
    distance = camera.focus_distance
    scene = scene_of(camera.to_sensor(), through("path"), wall=facing(distance, 0.3, **radiating(0.5)))
    proportional(scene)
    params = mi.traverse(scene)
    dr.enable_grad(params["camera.mla_distance"])
    with pytest.raises(InputError, match=r"main_lens = .*derivatives of wave captures of scenes by the ca"):
        scene.integrator().render_forward(scene, params)
    dr.disable_grad(params["camera.mla_distance"])


@pytest.mark.slow
def test_spectral_variants_are_differentiated_in_reverse():
    mi.set_variant("llvm_ad_spectral")
    integrator = through("path") | {"wavelength": 550.0}
    grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
    scene = scene_of(sensor(4, 8), integrator, wall=facing(250.0, 0.3, bsdf=grey), lamp=POINT)
    key, weights = "wall.bsdf.reflectance.value", np.ones((32, 32, 1))
    # Light that is reflected once is proportional to the reflectance.
    assert pulled(scene, key, weights) == pytest.approx(2 * captured(scene).sum(), rel=1e-3)
    params = mi.traverse(scene)
    with pytest.raises(InputError, match="variant llvm_ad_spectral: Mitsuba differentiates it in reverse alone"):
        scene.integrator().render_forward(scene, params)


@pytest.mark.slow
def test_drawn_wavelengths_are_differentiated_in_reverse():
    mi.set_variant("llvm_ad_spectral")
    camera = sensor(4, 8)
    camera["film"]["pixel_format"] = "rgb"
    light = {"type": "area", "radiance": {"type": "uniform", "value": 0.5}}
    integrator = through("path") | {"responses": "srgb", "nodes": 2}
    scene = scene_of(camera, integrator, wall=facing(250.0, 0.3, emitter=light))
    gradient = np.random.default_rng(2).normal((1, 2, 3), size=(32, 32, 3))
    expected = 2 * np.vdot(captured(scene), gradient)
    assert pulled(scene, RADIANCE, gradient) == pytest.approx(expected, rel=1e-4)


def test_absorbing_fog_darkens_by_its_thickness():
    scene = scene_of(sensor(4, 8), through("volpath"), fog=fog(albedo=0.0), wall=facing(260.0, 20.0, **radiating()))
    weights = np.ones((32, 32, 1))
    assert pulled(scene, SIGMA, weights, spp=256) == pytest.approx(-20 * captured(scene, spp=256).sum(), rel=0.01)


def test_light_scattered_once_is_proportional_to_the_albedo():
    scene = scene_of(sensor(4, 8), through("prbvolpath", max_depth=2), fog=fog(albedo=0.6), lamp=POINT)
    weights = np.ones((32, 32, 1))
    assert pulled(scene, ALBEDO, weights) == pytest.approx(captured(scene).sum() / 0.6, rel=0.01)


def test_in_blocks_and_lots(monkeypatch):
    scene = wall_of({"type": "diffuse", "reflectance": texture()})
    monkeypatch.setattr(signed_rays, "_BLOCK_BYTES", 2**22)
    monkeypatch.setattr(signed_rays, "_LANES", 2**17)
    assert disagreement(scene, "wall.bsdf.reflectance.data", pushed(scene, "wall.bsdf.reflectance.data")) < 1e-6


def test_progress_comes_lot_by_lot(monkeypatch):
    monkeypatch.setattr(signed_rays, "_LANES", 2**12)
    calls, scene = [], wall_of({"type": "diffuse"})
    render_capture(scene, model="wave", spp=64, progress=lambda *call: calls.append(call))
    done = [count / total for count, total in calls]
    assert done == sorted(done) and done[0] == 0 and done[-1] == 1
    # Four steps of the plan come first.
    assert len(set(done)) > 20


@pytest.mark.slow
def test_a_changed_camera_compiles_no_kernels_again():
    scene = wall_of({"type": "diffuse"})
    params = mi.traverse(scene)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for _ in range(2):
            for name in ("focal_length", "mla_distance", "detector_distance"):
                key = next(key for key in params.keys() if key.endswith(name) and "mla_" + name not in key)  # noqa: SIM118
                params[key] = params[key] * 1.0001
                dr.enable_grad(params[key])
            params.update()
            dr.kernel_history_clear()
            dr.backward(dr.sum(mi.render(scene, params, spp=4).array))
            kernels = dr.kernel_history([dr.KernelType.JIT])
    assert kernels and all(kernel["cache_hit"] for kernel in kernels)


def test_what_is_black_has_a_derivative_too():
    scene = scene_of(sensor(4, 8), through("path"), wall=facing(250.0, 0.3, **radiating(0.0)))
    change = pushed(scene, RADIANCE)
    params = mi.traverse(scene)
    params[RADIANCE] = mi.Float(1.0)
    params.update()
    bright = captured(scene)
    # What is projected below zero in the one is not in the other, which changes the sum a little, too.
    assert error(change, bright) < 0.1
    assert change.sum() == pytest.approx(bright.sum(), rel=0.01)


def test_projected_images_have_derivatives():
    rng = np.random.default_rng(0)
    image, change, gradient = (rng.normal(mean, 1, (21, 30)) for mean in (0.7, 0, 0))
    projection, step = NonNegative(image), 1e-6
    sides = [NonNegative(image + side * change).image for side in (step, -step)]
    assert error(projection.forward(change), (sides[0] - sides[1]) / (2 * step)) < 1e-6
    assert np.vdot(projection.forward(change), gradient) == pytest.approx(
        np.vdot(change, projection.backward(gradient))
    )


@pytest.mark.slow
def test_camera_and_light_together_reverse_against_forward():
    """All parameters change at once."""
    scene = wall_of({"type": "diffuse", "reflectance": texture()}, sensor(4, 8), light=lamp())
    steps = {
        "lamp.emitter.radiance.value": 1.0,
        "camera.focal_length": 4e-2,
        "camera.mla_distance": 6e-2,
        "camera.mla_focal_length": 4e-3,
        "camera.mla_pitch": 5e-4,
        "camera.mla_offset": [6e-4, -4e-4],
        "camera.detector_distance": 4e-3,
        "camera.detector_width": 4e-3,
    }
    params, amount = mi.traverse(scene), mi.Float(0)
    start = {key: type(params[key])(params[key]) for key in steps}
    dr.enable_grad(amount)
    for key, step in steps.items():
        params[key] = start[key] + amount * type(start[key])(step)
    params.update()
    dr.forward(amount, dr.ADFlag.ClearEdges)
    change = np.array(scene.integrator().render_forward(scene, params, spp=4), np.float64)
    for key, value in start.items():
        params[key] = value
        dr.enable_grad(params[key])
    params.update()
    gradient = np.random.default_rng(2).normal(size=change.shape)
    scene.integrator().render_backward(scene, params, mi.TensorXf(gradient.astype(np.float32)), spp=4)
    back = sum(np.vdot(np.ravel(dr.grad(params[key])), np.ravel(step)) for key, step in steps.items())
    for key in steps:
        dr.disable_grad(params[key])
    assert abs(np.vdot(change, gradient) - back) < 1e-6 * np.linalg.norm(change) * np.linalg.norm(gradient)
