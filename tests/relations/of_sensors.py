"""Relations of the sensor in Mitsuba's hands: parameters that change, differentials, and derivatives of captures."""

import drjit as dr
import mitsuba as mi
import numpy as np
from relation import relation

from mitsuba_plenoptic.camera import PARAMETERS, with_gradient, with_parts
from mitsuba_plenoptic.camera.entry import Captures, Use


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


@relation(Use.RAYS, "main_lens", "derivatives of rays")
def derivative_of_rays(draw):
    """Derivatives of where rays meet a plane are differences, but where a ray crosses another lens."""
    sensor, g = mi.load_dict(draw.camera.to_sensor()), 0.95 * draw.point()[2]
    params, random = mi.traverse(sensor), draw.rng.random((2, 2, 400)).astype(np.float32)
    keys = exposed(params, with_gradient(Captures.RAYS))
    draw.slope = str(draw.rng.choice([name for name in sorted(keys) if name != "mla_fill"]))
    key = keys[draw.slope]
    start = np.ravel(params[key]).astype(float)
    size = 20.0 if draw.slope == "mla_rotation" else np.abs(start).max() or draw.camera.pixel_size
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
    higher, lower = (np.array(met(type(number)(start + sign * 1e-3 * change)), float)[:2] for sign in (1, -1))
    miss, moved = (np.abs(each).max(0) for each in (slope - (higher - lower) / 2e-3, slope))
    lit = moved > 0
    return float(np.median(miss[lit]) / np.median(moved[lit])), 0.02
