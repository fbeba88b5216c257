"""Gradients of wave captures through `mi.render`: by the scene's light, against differences, and by the camera."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scene_cases import film
from wave_cases import HALF, WAVELENGTH, error

from mitsuba_plenoptic import InputError
from mitsuba_plenoptic.capture.full_field import full_field
from mitsuba_plenoptic.capture.full_field_grids import field_grids
from mitsuba_plenoptic.capture.units import brightness_of
from mitsuba_plenoptic.plugins.films import develop, develop_back

WALL = "wall.bsdf.reflectance.data"
LAMP = "lamp.intensity.value"


ABERRATED = {"wavefront": "0, 0, 0, 0.1"}
GAUSS = {"main_lens": "double_gauss"}


def scene_of(method="patch", child="path", half_width=0.1, accuracy=0.02, main_lens=ABERRATED, **objects):
    """Return a small textured wall, lit by a point so that its light has no noise, before two lenses."""
    turned = mi.ScalarTransform4f().translate([0.02, 0.01, 116.0]).rotate([0, 1, 0], 180).scale(half_width)
    texture = mi.Bitmap(np.random.default_rng(1).uniform(0.2, 1, (4, 4, 1)).astype(np.float32))
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "plenoptic_wave",
                "radiators_per_lens": 2,
                "method": method,
                "accuracy": accuracy,
                "child": {"type": child},
            },
            "camera": {
                "type": "plenoptic",
                "detector_width": 0.128,
                **main_lens,
                "film": film(64, 64),
                "sampler": {"type": "independent", "sample_count": 1},
                **HALF,
            },
            "wall": {
                "type": "rectangle",
                "to_world": turned,
                "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texture, "raw": True}},
            },
            "lamp": {"type": "point", "position": [0.0, 40.0, 0.0], "intensity": 3e4},
            **objects,
        }
    )


def pushed(scene, directions):
    """Return the image and its derivative along changes of parameters."""
    params, theta = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(theta)
    for key, direction in directions.items():
        kind = type(params[key])
        params[key] = kind(params[key]) + theta * kind(direction)
    params.update()
    dr.forward(theta, dr.ADFlag.ClearEdges)
    image = mi.render(scene, params)
    change = np.array(dr.forward_to(image))
    for key in directions:
        params[key] = dr.detach(params[key])
    params.update()
    return np.array(dr.detach(image)), change


def pulled(scene, keys, gradient):
    """Return the gradients of parameters from that of the image."""
    params = mi.traverse(scene)
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params) * mi.TensorXf(gradient), axis=None))
    found = {key: np.array(dr.grad(params[key]), np.float64) for key in keys}
    for key in keys:
        dr.disable_grad(params[key])
    return found


def test_light_against_differences_and_reverse_against_forward():
    scene, rng = scene_of(), np.random.default_rng(2)
    directions = {WALL: mi.TensorXf(rng.uniform(-0.2, 0.2, (4, 4, 1)).astype(np.float32)), LAMP: 5e3}
    base, change = pushed(scene, directions)
    params, step = mi.traverse(scene), 0.1
    sides = []
    for side in (step, -2 * step):
        for key, direction in directions.items():
            params[key] = params[key] + side * type(params[key])(direction)
        params.update()
        sides.append(np.array(mi.render(scene)))
    assert np.linalg.norm(change) > 0.05 * np.linalg.norm(base)
    assert error(change, (sides[0] - sides[1]) / (2 * step)) < 0.001

    scene = scene_of()
    gradient = rng.normal(size=base.shape).astype(np.float32)
    found = pulled(scene, list(directions), gradient)
    back = sum(np.vdot(found[key], np.array(direction, np.float64)) for key, direction in directions.items())
    forward = np.vdot(change.astype(np.float64), gradient)
    assert abs(forward - back) < 1e-5 * np.linalg.norm(change) * np.linalg.norm(gradient)


STEPS = {
    "focal_length": 4e-3,
    "mla_distance": 6e-3,
    "mla_focal_length": 4e-4,
    "mla_pitch": 5e-5,
    "mla_rotation": 0.05,
    "mla_offset": [6e-5, -4e-5],
    "detector_distance": 4e-4,
    "wavefront": [0.0, 4e-3, 0.0, 4e-3],
}


@pytest.mark.slow
@pytest.mark.parametrize("main_lens", [ABERRATED, GAUSS], ids=["thin", "double Gauss"])
def test_camera_against_differences_of_the_full_field_and_reverse_against_forward(main_lens):
    """All numbers change at once, so that one pair of fields a radiator tells of all."""
    scene = scene_of(half_width=0.035, accuracy=0.0, main_lens=main_lens)
    steps = {name: step for name, step in STEPS.items() if name != "wavefront" or main_lens is ABERRATED}
    directions = {f"camera.{name}": step for name, step in steps.items()}
    image, change = pushed(scene, directions)
    capture = scene.integrator()._capture(scene, scene.sensors()[0])
    camera = capture.camera
    (radiators,) = capture.radiators("patch", 0, 1)
    assert 0 < len(radiators.positions) <= 8
    weights = (capture.scale(radiators) * radiators.radiance)[:, 0]
    sides = []
    for side in (1, -1):
        moved = camera.replace(
            **{name: np.add(getattr(camera, name), np.multiply(side, step)).tolist() for name, step in steps.items()}
        )
        growth = brightness_of(moved) / brightness_of(camera)
        sides.append(
            sum(
                growth
                * weight
                * full_field(moved, place, WAVELENGTH, grids=field_grids(camera, place, WAVELENGTH, 1, 1))
                for weight, place in zip(weights, radiators.positions, strict=True)
            )
        )
    assert error(change[..., 0], (sides[0] - sides[1]) / 2) < 0.01

    gradient = np.random.default_rng(3).normal(size=image.shape).astype(np.float32)
    found = pulled(scene, list(directions), gradient)
    back = sum(np.vdot(np.ravel(found[key]), np.ravel(direction)) for key, direction in directions.items())
    assert abs(np.vdot(change, gradient) - back) < 1e-4 * np.linalg.norm(change) * np.linalg.norm(gradient)


@pytest.mark.slow
def test_light_that_a_lens_cuts_off_grows_less_with_its_opening():
    """A corner that the lens darkens: radiators are found anew for the differences."""

    def scene(radius):
        lens = {"main_lens": "cooke_triplet", "focal_length": 40.0, "focus_distance": 120.0, "aperture_radius": radius}
        corner = {"crop_offset_x": 20, "crop_offset_y": 20, "crop_width": 64, "crop_height": 64}
        wall = mi.ScalarTransform4f().translate([0, 0, 118.0]).rotate([0, 1, 0], 180).scale(40)
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "plenoptic_wave", "radiators_per_lens": 1, "method": "patch", "accuracy": 0.05},
                "camera": {
                    "type": "plenoptic",
                    "detector_width": 16.0,
                    "film": film(2000, 2000) | corner,
                    "sampler": {"type": "independent", "sample_count": 1},
                    **lens,
                },
                "wall": {"type": "rectangle", "to_world": wall, "light": {"type": "area", "radiance": 1.0}},
            }
        )

    more, less = (np.array(mi.render(scene(radius))).mean() for radius in (3.6, 3.4))
    image, change = pushed(scene(3.5), {"camera.aperture_radius": 1.0})
    found = change.mean() / image.mean()
    assert found == pytest.approx(np.log(more / less) / 0.2, rel=0.03)
    assert found < 0.7 * 2 / 3.5  # of a pupil that nothing else cuts


def test_what_is_black_has_a_gradient_too():
    scene = scene_of(child="prb", half_width=0.03)
    params = mi.traverse(scene)
    base = np.array(mi.render(scene))
    params[LAMP] = mi.Float(0)
    dr.enable_grad(params[LAMP])
    dr.set_grad(params[LAMP], 3e4)
    params.update()
    change = scene.integrator().render_forward(scene, params, scene.sensors()[0])
    assert error(np.array(change), base) < 1e-4


@pytest.mark.parametrize(
    ("options", "key", "message"),
    [
        ({}, "wall.to_world", "wall.to_world: it has no gradient: places of shapes and cameras are held"),
        ({}, "camera.to_world", "camera.to_world: it has no gradient"),
        ({"method": "bank", "main_lens": {}}, LAMP, "method = bank: it has no gradients; use patch"),
        ({"method": "full_field"}, LAMP, "method = full_field: it has no gradients"),
        ({"child": "direct"}, LAMP, "nested direct: scene parameters have no gradients through it; use path or prb"),
        ({"mirror": {"type": "sphere", "bsdf": {"type": "conductor"}}}, LAMP, "scene: no gradients .* mirrors"),
    ],
)
def test_what_cannot_be_differentiated_is_refused_by_name(options, key, message):
    scene = scene_of(**options)
    params = mi.traverse(scene)
    dr.enable_grad(params[key])
    with pytest.raises(InputError, match=f"^plenoptic_wave: {message}"):
        scene.integrator().render_backward(scene, params, dr.ones(mi.TensorXf, (64, 64, 1)), scene.sensors()[0])


@pytest.mark.parametrize(("variant", "channels"), [("llvm_ad_mono", 1), ("llvm_ad_rgb", 3)])
@pytest.mark.parametrize("pixel_format", ["luminance", "rgb"])
def test_film_forward_and_back(variant, channels, pixel_format):
    """<D x, y> = <x, D' y>."""
    mi.set_variant(variant)
    plate = mi.load_dict(film(7, 5) | {"pixel_format": pixel_format})
    x = np.random.default_rng(0).normal(size=(5, 7, channels)).astype(np.float32)
    made = np.array(develop(plate, x))
    y = np.random.default_rng(1).normal(size=made.shape).astype(np.float32)
    assert np.vdot(made, y) == pytest.approx(np.vdot(x, develop_back(plate, mi.TensorXf(y), x.shape)), rel=1e-5)
