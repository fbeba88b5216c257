"""Scenes in which light takes another way than straight from a surface, and what is measured of their captures."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import reconstruct, render_capture

PERIOD = 1.35
"""Of the bars, in millimetres."""

THIN_FOG = {"type": "homogeneous", "sigma_t": 0.01, "albedo": 0.5}
ABSORBING_FOG = {"type": "homogeneous", "sigma_t": math.log(2) / 240, "albedo": 0.0}


def sensor(lenses=32, pixels=16, **parameters):
    """Describe the paper's camera with fewer lenses and coarser pixels."""
    film = {
        "type": "hdrfilm",
        "width": lenses * pixels,
        "height": lenses * pixels,
        "rfilter": {"type": "box"},
        "pixel_format": "luminance",
        "component_format": "float32",
    }
    return {"type": "plenoptic", "detector_width": 0.064 * lenses, "film": film, **parameters}


def scene_of(sensor, integrator="path", **objects):
    """Return a scene; `integrator` is a name or a dictionary."""
    integrator = {"type": integrator} if isinstance(integrator, str) else integrator
    return mi.load_dict({"type": "scene", "integrator": integrator, "camera": sensor, **objects})


def facing(distance, size, place=(0.0, 0.0), to_world=None, **extra):
    """Describe a rectangle that faces the camera: half its width, or both halves, and where its centre is."""
    T = mi.ScalarTransform4f()
    size = size if isinstance(size, tuple) else (size, size)
    own = T.translate([*place, distance]) @ T.rotate([0, 1, 0], 180) @ T.scale([*size, 1])
    return {"type": "rectangle", "to_world": own if to_world is None else to_world @ own, **extra}


def radiating(radiance=1.0):
    """Describe an emitter, and a surface that reflects nothing."""
    return {"emitter": {"type": "area", "radiance": radiance}, "bsdf": {"type": "diffuse", "reflectance": 0.0}}


def bars(distance, to_world=None):
    """Describe upright radiating bars."""
    return {
        f"bar_{i}": facing(distance, (PERIOD / 4, 6.0), ((i + 0.25) * PERIOD, 0.0), to_world, **radiating())
        for i in range(-5, 6)
    }


MIRROR = {"type": "conductor", "material": "none"}

PANES = {
    "transparent mask": {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}},
    "null": {"type": "null"},
    "thindielectric": {"type": "thindielectric"},
    "half-open mask": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse", "reflectance": 0.0}},
}


def bars_through(way):
    """Return the scene of bars that are 300 mm away, as the camera sees them, through something at 240 mm."""
    camera = sensor(focus_distance=270.0)
    if way == "directly":
        return scene_of(camera, **bars(300.0))
    if way in PANES:
        return scene_of(camera, pane=facing(240.0, 20.0, bsdf=PANES[way]), **bars(300.0))
    T = mi.ScalarTransform4f()
    if way == "mirror":
        mirror = T.translate([0, 0, 240]) @ T.rotate([0, 1, 0], 10)
        # The mirror's image of the bars stands at 300 mm; mirrored itself it is where they are.
        there = mirror @ T.scale([1, 1, -1]) @ mirror.inverse()
        return scene_of(
            camera, mirror={"type": "rectangle", "to_world": mirror @ T.rotate([0, 1, 0], 180) @ T.scale(20.0), "bsdf": MIRROR},
            **bars(300.0, there),
        )  # fmt: skip
    cube = {"type": "cube", "to_world": T.translate([0, 0, 240]) @ T.scale([20, 20, 10])}
    if way == "slab":
        # A slab of index n lets what is behind it seem nearer by its thickness times 1 - 1 / n.
        slab = {**cube, "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}
        return scene_of(camera, slab=slab, **bars(300.0 + 20 / 3))
    if way == "fog":
        return scene_of(camera, "volpath", fog={**cube, "bsdf": {"type": "null"}, "interior": THIN_FOG}, **bars(300.0))
    raise ValueError(way)


WAYS = ("directly", "mirror", *PANES, "slab", "fog")


def contrast(capture, distance):
    """Return the modulation of the bars in a refocused image at their period, and its mean."""
    image = reconstruct(capture, distance).image
    columns = image[4:-4].mean(axis=0)
    x = (np.arange(len(columns)) + 0.5 - len(columns) / 2) * capture.camera.bin_size(distance)
    # A whole number of periods
    half = math.floor(x[-4] / PERIOD) * PERIOD
    inside = np.abs(x) <= half
    wave = np.exp(2j * np.pi * x[inside] / PERIOD)
    return 2 * abs((columns[inside] * wave).mean()) / columns[inside].mean(), float(columns[inside].mean())


def contrasts(way, spp=4, per_lens=3):
    """Return contrast and mean of the bars refocused at 300 mm, by rays and by waves."""
    scene = bars_through(way)
    by_rays = render_capture(scene, model="ray", spp=16 * spp)
    by_waves = render_capture(scene, model="wave", spp=spp, radiators_per_lens=per_lens)
    return [(*contrast(capture, 300.0), float(capture.image.sum(dtype=float))) for capture in (by_rays, by_waves)]
