"""Relations of the sensor in Mitsuba's hands: parameters that change, differentials, and derivatives of captures."""

import drjit as dr
import mitsuba as mi
import numpy as np
from of_captures import wall
from relation import off, relation

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.camera import PARAMETERS, with_gradient, with_parts
from mitsuba_plenoptic.camera.entry import Captures, Use
from mitsuba_plenoptic.detector import SHARP, DetectorOperator


def exposed(params, names):
    """Return the keys of a camera's parameters in a scene, by their names."""
    return {key.rpartition(".")[2]: key for key in params.keys() if key.rpartition(".")[2] in names}  # noqa: SIM118


@relation(Use.RAYS, method="parameters of sensors")
def traversed(draw):
    """A sensor whose numbers were changed is that of the changed camera."""
    sensor = mi.load_dict(draw.camera.to_sensor())
    params, changes = mi.traverse(sensor), {}
    for name, key in exposed(params, [name for name in PARAMETERS if PARAMETERS[name].gradients]).items():
        value = np.ravel(params[key]) * np.float32(0.97)
        params[key] = type(params[key])(value)
        # Cameras have the shortest decimals of single precision.
        changes[name] = np.array([float(str(number)) for number in value])
    params.update()
    return float(not changes or sensor.camera != with_parts(draw.camera, changes)), 0.0


@relation(Use.RAYS, method="rays of sensors")
def differentials(draw):
    """Differentials are the rays of the next pixels, but where these see through another lens."""
    sensor, g = mi.load_dict(draw.camera.to_sensor()), draw.point()[2] / 2  # in focus all pixels of a lens see a point
    random = draw.rng.random((2, 2, 400)).astype(np.float32)
    place, lens = (mi.Point2f(each) for each in random)

    def met(origin, direction):
        return np.array(origin + (g - origin.z) / direction.z * direction, float)[:2]

    ray, weight = sensor.sample_ray_differential(0.0, 0.5, place, lens)
    misses, here = [], met(ray.o, ray.d)
    for name, step in zip("xy", np.diag(1 / np.array(draw.camera.crop_size)), strict=True):
        beside, _ = sensor.sample_ray(0.0, 0.5, place + mi.Point2f(step), lens)
        there, found = met(beside.o, beside.d), met(getattr(ray, f"o_{name}"), getattr(ray, f"d_{name}"))
        miss, step = (np.abs(each - there).max(0)[np.array(weight)[0] > 0] for each in (found, here))
        misses.append(np.median(miss / step))
    return float(max(misses)), 0.2 if draw.camera.prescription or draw.camera.objective else 0.01


@relation(Use.RAYS, method="derivatives of rays")
def derivative_of_rays(draw):
    """Derivatives of where rays meet a plane are differences, but where a ray crosses another lens.

    Behind real lenses differences of smaller steps are rounding, and behind objectives these in part.
    """
    sensor, g = mi.load_dict(draw.camera.to_sensor()), 0.95 * draw.point()[2]
    params, random = mi.traverse(sensor), draw.rng.random((2, 2, 400)).astype(np.float32)
    keys = exposed(params, with_gradient(Captures.RAYS))
    name = str(draw.rng.choice([name for name in sorted(keys) if name != "mla_fill"]))
    key = keys[name]
    start = np.ravel(params[key]).astype(float)
    size = 20.0 if name == "mla_rotation" else np.abs(start).max() or draw.camera.pixel_size
    change = size * draw.rng.uniform(0.5, 1.5, start.size)

    def met(number):
        params[key] = number
        params.update()
        ray, weight = sensor.sample_ray(0.0, 0.5, *(mi.Point2f(each) for each in random))
        return dr.select(weight[0] > 0, ray.o + (g - ray.o.z) / ray.d.z * ray.d, 0)

    number = type(params[key])(start)
    dr.enable_grad(number)
    place = met(number)
    dr.set_grad(number, change)
    slope = np.array(dr.forward_to(place), float)[:2]
    step = 1e-2 if "main_lens" in draw.options else 1e-3
    higher, lower = (np.array(met(type(number)(start + sign * step * change)), float)[:2] for sign in (1, -1))
    miss, moved = (np.abs(each).max(0) for each in (slope - (higher - lower) / (2 * step), slope))
    lit, allowed = moved > 0, 0.02 if draw.camera.objective is None else 0.1
    return float(np.median(miss[lit]) / np.median(moved[lit])), allowed


MIXING = ("detector_blur", "pixel_crosstalk", "stray_light", "stray_width")


def of_scenes(model, use):
    """Add the relations of captures of a wall by one model of light."""
    child = {"type": "path"} if model == "wave" else {}

    def integrator(draw):
        waves = {"type": "plenoptic_wave", "wavelength": draw.wavelength, "child": child}
        return mi.load_dict(waves if model == "wave" else {"type": "prb"})

    def detector(draw):
        """Captures are recorded by the detector as its operator mixes pixels."""
        g, options = draw.point()[2], {"wavelength": draw.wavelength} if model == "wave" else {}
        recorded, light = (
            mp.render_capture(wall(camera, g), model=model, spp=4, **options).image
            for camera in (draw.camera, draw.camera.replace(**SHARP))
        )
        return off(recorded, DetectorOperator.of(draw.camera).forward(light)), 1e-5

    def radiance(draw):
        """The derivative by the radiance of all that shines is the capture, forward and in reverse."""
        scene, options = wall(draw.camera, draw.point()[2]), {"integrator": integrator(draw), "spp": 4}
        params, key = mi.traverse(scene), "wall.emitter.radiance.data"
        image, texture = np.array(mi.render(scene, seed=2, **options), float), type(params[key])(params[key])
        weights = draw.rng.random(image.shape, np.float32)

        def rendered(of_factor):
            factor = mi.Float(1.0)
            dr.enable_grad(factor)
            params[key] = texture * factor
            params.update()
            return of_factor(factor)

        def forward(factor):
            dr.forward(factor, dr.ADFlag.ClearEdges)
            return np.array(dr.forward_to(mi.render(scene, params, seed=1, seed_grad=2, **options)))

        def reverse(factor):
            made = mi.render(scene, params, seed=1, seed_grad=2, **options)
            dr.backward(dr.sum(made * mi.TensorXf(weights), axis=None))
            return float(dr.grad(factor)[0])

        expected = float(np.vdot(image, weights))
        return max(off(rendered(forward), image), abs(rendered(reverse) / expected - 1)), 1e-4

    for judge, first in ((detector, lambda seed: MIXING), (radiance, None)):
        judge.__name__ = f"{judge.__name__}_by_{model}s"
        derived = use | Use.SCENE_DERIVATIVES if judge is radiance and model == "wave" else use
        relation(derived, "", f"captures by {model}s", first)(judge)


of_scenes("ray", Use.RAYS)
of_scenes("wave", Use.SCENES)
