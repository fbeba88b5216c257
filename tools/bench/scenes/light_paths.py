"""Scenes in which light takes other paths than straight from a surface, and measures of their captures."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import Capture, reconstruct, render_capture

Scene = dict[str, Any]
"""A description that `mi.load_dict` takes."""

PERIOD = 1.35
"""Of the bars, in millimetres."""

THIN_FOG = {"type": "homogeneous", "sigma_t": 0.01, "albedo": 0.5}
ABSORBING_FOG = {"type": "homogeneous", "sigma_t": math.log(2) / 240, "albedo": 0.0}


def sensor(lenses: int = 32, pixels: int = 16, **parameters: Any) -> Scene:
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


def scene_of(sensor: Scene, integrator: str | Scene = "path", **objects: Any) -> Any:
    """Return a scene; `integrator` is a name or a dictionary."""
    integrator = {"type": integrator} if isinstance(integrator, str) else integrator
    return mi.load_dict({"type": "scene", "integrator": integrator, "camera": sensor, **objects})


def facing(
    distance: float, size: Any, place: tuple[float, float] = (0.0, 0.0), to_world: Any = None, **extra: Any
) -> Scene:
    """Describe a rectangle that faces the camera: half its width, or both halves, and where its centre is."""
    T = mi.ScalarTransform4f()
    size = size if isinstance(size, tuple) else (size, size)
    own = T.translate([*place, distance]) @ T.rotate([0, 1, 0], 180) @ T.scale([*size, 1])
    return {"type": "rectangle", "to_world": own if to_world is None else to_world @ own, **extra}


def radiating(radiance: float = 1.0) -> Scene:
    """Describe an emitter, and a surface that reflects nothing."""
    return {"emitter": {"type": "area", "radiance": radiance}, "bsdf": {"type": "diffuse", "reflectance": 0.0}}


def bars(distance: float, to_world: Any = None) -> Scene:
    """Describe upright radiating bars."""
    return {
        f"bar_{i}": facing(distance, (PERIOD / 4, 6.0), ((i + 0.25) * PERIOD, 0.0), to_world, **radiating())
        for i in range(-5, 6)
    }


MIRROR = {"type": "conductor", "material": "none"}


def turned_plane(bsdf: Scene) -> tuple[Scene, Any]:
    """Describe a plane at 240 mm, turned by 10 degrees, and the transform of what stands in its mirror image."""
    T = mi.ScalarTransform4f()
    plane = T.translate([0, 0, 240]) @ T.rotate([0, 1, 0], 10)
    shape = {"type": "rectangle", "to_world": plane @ T.rotate([0, 1, 0], 180) @ T.scale(20.0), "bsdf": bsdf}
    return shape, plane @ T.scale([1, 1, -1]) @ plane.inverse()


PANES = {
    "transparent mask": {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}},
    "null": {"type": "null"},
    "thindielectric": {"type": "thindielectric"},
    "half-open mask": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse", "reflectance": 0.0}},
}


def bars_through(way: str, lenses: int = 32) -> Any:
    """Return the scene of bars that are 300 mm away, as the camera sees them, through something at 240 mm."""
    camera = sensor(lenses, focus_distance=270.0)
    if way == "directly":
        return scene_of(camera, **bars(300.0))
    if way in PANES:
        return scene_of(camera, pane=facing(240.0, 20.0, bsdf=PANES[way]), **bars(300.0))
    T = mi.ScalarTransform4f()
    if way == "mirror":
        mirror, there = turned_plane(MIRROR)
        return scene_of(camera, mirror=mirror, **bars(300.0, there))
    cube = {"type": "cube", "to_world": T.translate([0, 0, 240]) @ T.scale([20, 20, 10])}
    if way == "slab":
        # A slab of index n lets what is behind it seem nearer by its thickness times 1 - 1 / n.
        slab = {**cube, "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}}
        return scene_of(camera, slab=slab, **bars(300.0 + 20 / 3))
    if way == "fog":
        return scene_of(camera, "volpath", fog={**cube, "bsdf": {"type": "null"}, "interior": THIN_FOG}, **bars(300.0))
    raise ValueError(way)


def slanted(pane: str | None) -> Any:
    """Return the scene of a radiating half plane, out of focus and seen at 5 degrees, maybe through a turned pane."""
    T = mi.ScalarTransform4f()
    turned = T.translate([0, 0, 256]) @ T.rotate([1, 0, 0], 85) @ T.translate([0, -20, 0])
    plane = {"type": "rectangle", "to_world": turned @ T.rotate([0, 1, 0], 180) @ T.scale(20.0), **radiating()}
    panes = {}
    if pane:
        to_world = T.translate([0, 0, 195]) @ T.rotate([1, 0, 0], 30) @ T.translate([0, 0, -195])
        panes["pane"] = facing(195.0, 20.0, to_world=to_world, bsdf=PANES[pane])
    return scene_of(sensor(16), plane=plane, **panes)


WAYS = ("directly", "mirror", *PANES, "slab", "fog")


def contrast(capture: Capture, distance: float) -> float:
    """Return the modulation of the bars, at their period, in the image refocused at a distance."""
    image = reconstruct(capture, distance).image
    columns = image[4:-4].mean(axis=0)
    x = (np.arange(len(columns)) + 0.5 - len(columns) / 2) * capture.camera.bin_size(distance)
    # A whole number of periods
    half = math.floor(x[-2] / PERIOD) * PERIOD
    inside = np.abs(x) <= half
    wave = np.exp(2j * np.pi * x[inside] / PERIOD)
    return float(2 * abs((columns[inside] * wave).mean()) / columns[inside].mean())


def by_signed_rays(scene: Any, spp: int = 64) -> Capture:
    """Return the wave capture of a scene from signed rays."""
    return render_capture(scene, model="wave", method="signed_rays", spp=spp)


def captures(scene: Any, spp: int = 64) -> tuple[Capture, Capture]:
    """Return the ray and the wave capture of a scene."""
    return render_capture(scene, model="ray", spp=2 * spp), by_signed_rays(scene, spp)


def energy(by_rays: Capture, by_waves: Capture) -> float:
    """Return the sum of the wave capture over that of the ray capture."""
    return float(by_waves.image.sum(dtype=float) / by_rays.image.sum(dtype=float))


def square_behind(pane: Scene | None = None) -> Any:
    """Return the scene of a square at 240 mm behind a card at 210 mm."""
    card = {} if pane is None else {"pane": facing(210.0, 20.0, bsdf=pane)}
    return scene_of(sensor(16, 16), square=facing(240.0, 0.4, (0.1, -0.1), **radiating()), **card)


TRANSPARENT = {
    "mask": PANES["transparent mask"],
    "null": PANES["null"],
    "thindielectric": {"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0},
}
"""Cards that change nothing."""


def card_before(lenses: int = 16, aperture_radius: float = 5.0, **background: Scene) -> Any:
    """Return the scene of a black card, in focus at 1000 mm, that hides the left half of what is behind it."""
    card = facing(1000.0, 100.0, (100.0, 0.0), bsdf={"type": "diffuse", "reflectance": 0.0})
    camera = sensor(lenses, 16, focus_distance=1000.0, aperture_radius=aperture_radius)
    return scene_of(camera, card=card, **background)


def in_fog() -> Any:
    """Return the scene of a wall in a fog that absorbs half of its light."""
    wall = facing(240.0, 20.0, exterior=ABSORBING_FOG, **radiating())
    return scene_of(sensor(8, 16, medium=ABSORBING_FOG), "volpath", wall=wall)


def lamp_behind_glass(hide_emitters: bool) -> Any:
    """Return the scene of a lamp behind a pane of glass and beside it."""
    integrator = {"type": "path", "hide_emitters": hide_emitters}
    glass = {"type": "cube", "bsdf": {"type": "dielectric"}}
    glass["to_world"] = mi.ScalarTransform4f().translate([10, 0, 210]).scale([10, 20, 2])
    return scene_of(sensor(8, 16), integrator, glass=glass, lamp=facing(240.0, 20.0, **radiating()))


def lit_mirror(max_depth: int) -> Any:
    """Return the scene of a mirror that shows a lamp and a wall lit by another."""
    mirror, there = turned_plane(MIRROR)
    return scene_of(
        sensor(8, 16),
        {"type": "path", "max_depth": max_depth},
        mirror=mirror,
        lamp=facing(300.0, 10.0, (-10.0, 0.0), there, **radiating()),
        wall=facing(300.0, 10.0, (10.0, 0.0), there, bsdf={"type": "diffuse", "reflectance": 0.8}),
        light={"type": "point", "position": [-10.0, 25.0, 225.0], "intensity": 4e3},
    )


def plastic(lenses: int = 16) -> Any:
    """Return the scene of a smooth plastic, dimly lit, that shows radiating bars."""
    plane, there = turned_plane({"type": "plastic", "diffuse_reflectance": 0.02})
    light = {"type": "point", "position": [0.0, 30.0, 100.0], "intensity": 1e4}
    return scene_of(sensor(lenses, 16), plane=plane, light=light, **bars(300.0, there))


def glass_sphere(angle: float = 20.0, lenses: int = 8) -> Any:
    """Return the scene of a glass sphere that shows a lamp by reflection on the axis, at this angle of incidence."""
    tilt = math.radians(angle)
    centre = [20 * math.sin(tilt), 0.0, 240 + 20 * math.cos(tilt)]
    place = [-200 * math.sin(2 * tilt), 0.0, 240 - 200 * math.cos(2 * tilt)]
    sphere = {"type": "sphere", "center": centre, "radius": 20.0, "bsdf": {"type": "dielectric"}}
    lamp = {"type": "sphere", "center": place, "radius": 3.0, **radiating(100.0)}
    return scene_of(sensor(lenses, 16), sphere=sphere, lamp=lamp)


def half_lit(bsdf: Scene | None, angle: float) -> Any:
    """Return the scene of a reflecting plane in focus that shows half of the pupil a lamp, whose edge has an angle.

    The lamp is behind the camera and begins at the axis. Without a BSDF it stands, in place of the plane, where a
    mirror shows it.
    """
    T = mi.ScalarTransform4f()
    to_world = T.translate([0, 0, -10]) @ T.rotate([0, 0, 1], angle) @ T.translate([100, 0, 0]) @ T.scale(100)
    if bsdf is None:
        there = T.translate([0, 0, 480]) @ T.scale([1, 1, -1])
        return scene_of(sensor(8, 16), lamp={"type": "rectangle", "to_world": there @ to_world, **radiating()})
    lamp = {"type": "rectangle", "to_world": to_world, **radiating()}
    return scene_of(sensor(8, 16), plane=facing(240.0, 20.0, bsdf=bsdf), lamp=lamp)
