"""Scenes whose light differs over the pupil, or within a lens, and quarters of their micro-images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from .light_paths import facing, radiating, scene_of, sensor

LENSES, PIXELS = 16, 16

BLACK = {"type": "diffuse", "reflectance": 0.0}


def camera(lenses: int = LENSES, colours: bool = False, **parameters: Any) -> dict[str, Any]:
    """Describe the paper's camera with fewer lenses and coarser pixels, of parabolic lenses."""
    made = sensor(lenses, PIXELS, lens_model="parabolic", **parameters)
    if colours:
        made["film"]["pixel_format"] = "rgb"
    return made


def wall(distance: float = 240.0, **extra: Any) -> dict[str, Any]:
    """Describe a wall that fills the view."""
    return facing(distance, 60.0, **(extra or radiating()))


def filtered(part: Any, **extra: Any) -> dict[str, Any]:
    """Describe a pane close to the lens that lets a part of the light through."""
    return facing(1.0, (10.0, 20.0), (10.0, 0.0), bsdf={"type": "mask", "opacity": 1 - part, "nested": BLACK}, **extra)


def pattern(period: float, size: float, low: float = 0.0) -> dict[str, Any]:
    """Describe a texture of upright stripes over a rectangle of half the width `size`, from `low` to 1."""
    count = 2 * round(2 * size / period)
    values = np.where(np.arange(count) % 2, 1.0, low).astype(np.float32)[None, :, None]
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.repeat(values, 2, 0)),
        "raw": True,
        "filter_type": "nearest",
    }


def coloured_panes() -> Any:
    """Return a scene with a red and a blue filter before the halves of the pupil."""
    panes = {}
    for side, colour in ((1, [1.0, 0.1, 0.0]), (-1, [0.0, 0.1, 1.0])):
        glass = {"type": "thindielectric", "int_ior": 1.0 + 1e-6}
        glass["specular_transmittance"] = {"type": "rgb", "value": colour}
        panes[f"pane_{side}"] = facing(1.0, (10.0, 20.0), (10.0 * side, 0.0), bsdf=glass)
    return scene_of(camera(colours=True), **panes, wall=wall())


def lamps_in_metal() -> Any:
    """Return a scene of a slightly rough metal that mirrors a red and a blue lamp."""
    metal = {"type": "roughconductor", "material": "none", "alpha": 0.005, "distribution": "ggx"}
    objects = {"metal": facing(240.0, 30.0, bsdf=metal)}
    for side, colour in ((1, [4.0, 0.0, 0.0]), (-1, [0.0, 0.0, 4.0])):
        emitter = {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": colour}}, "bsdf": BLACK}
        T = mi.ScalarTransform4f()
        to_world = T.translate([1.6 * side, 0, -40]) @ T.scale([1.4, 3, 1])
        objects[f"lamp_{side}"] = {"type": "rectangle", "to_world": to_world, **emitter}
    return scene_of(camera(colours=True), **objects)


def nine_lamps() -> Any:
    """Return a scene of nine lamps in focus, each a sixth of a lens wide."""
    return scene_of(
        camera(),
        **{
            f"lamp_{i}_{j}": facing(240.0, 0.01, (0.47 * i, 0.41 * j), **radiating(100.0))
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
        },
    )


def floor() -> Any:
    """Return a scene of a radiating floor 1 mm below the axis."""
    T = mi.ScalarTransform4f()
    to_world = T.translate([0, -1, 250]) @ T.rotate([1, 0, 0], -90) @ T.scale([60, 150, 1])
    return scene_of(camera(), floor={"type": "rectangle", "to_world": to_world, **radiating()})


def dirt() -> Any:
    """Return a scene behind a dirty pane, of spots as large as a fifth of the pupil."""
    values = np.random.default_rng(1).choice([0.0, 0.6], (16, 16, 1), p=[0.6, 0.4]).astype(np.float32)
    opacity = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": "nearest"}
    pane = facing(12.0, 16.0, bsdf={"type": "mask", "opacity": opacity, "nested": BLACK})
    return scene_of(camera(), pane=pane, wall=wall(280.0))


def fog_around() -> Any:
    """Return a scene in which the camera stands in fog."""
    fog = {"type": "homogeneous", "sigma_t": 0.003, "albedo": 0.8}
    made = camera()
    made["medium"] = fog
    half = facing(240.0, (20.0, 60.0), (20.0, 0.0), **radiating())
    return scene_of(made, {"type": "volpath", "max_depth": 8}, wall=half, sky={"type": "constant", "radiance": 0.1})


SCENES: dict[str, tuple[Callable[[], Any], float]] = {
    "pane over half of the pupil": (lambda: scene_of(camera(), pane=filtered(0.3), wall=wall()), 0.01),
    "glass over half of the pupil": (
        lambda: scene_of(
            camera(),
            pane=facing(1.0, (10.0, 20.0), (10.0, 0.0), bsdf={"type": "thindielectric", "int_ior": 3.0}),
            wall=wall(),
        ),
        0.01,
    ),
    "stripes of four lenses in focus before a wall": (
        lambda: scene_of(
            camera(),
            pane=facing(240.0, 4.096, bsdf={"type": "mask", "opacity": pattern(0.512, 4.096), "nested": BLACK}),
            wall=wall(262.0),
        ),
        0.05,
    ),
    "red and blue panes": (coloured_panes, 0.015),
    "red and blue lamps in rough metal": (lamps_in_metal, 0.03),
    "nine lamps of a sixth of a lens": (nine_lamps, 0.25),
    "floor": (floor, 0.05),
    "dirty pane": (dirt, 0.03),
    "camera in fog": (fog_around, 0.03),
    "texture finer than a lens": (
        lambda: scene_of(
            camera(),
            card=facing(240.0, 4.0, **{"bsdf": BLACK, "emitter": {"type": "area", "radiance": pattern(0.09, 4.0)}}),
        ),
        0.08,
    ),
    "hair": (
        lambda: scene_of(camera(), hair=facing(30.0, (0.4, 20.0), (1.1, 0.0), bsdf=BLACK), wall=wall(250.0)),
        0.03,
    ),
    "lamp through a glass ball": (
        lambda: scene_of(
            camera(),
            ball={"type": "sphere", "center": [0.2, 0.1, 236.0], "radius": 1.5, "bsdf": {"type": "dielectric"}},
            wall=facing(300.0, (2.0, 30.0), (3.0, 0.0), **radiating()),
        ),
        0.05,
    ),
}
"""Each with its limit on the relative difference of quarters of micro-images, beyond the noise."""

FILLS = {
    "cells filled by 0.5": {"mla_fill": 0.5},
    "cells filled by 0.3": {"mla_fill": 0.3},
    "discs filled by 0.5": {"mla_fill": 0.5, "mla_aperture": "circle"},
    "hexagons": {"mla_lattice": "hexagonal"},
}

for _name, _parameters in FILLS.items():
    SCENES[f"white wall, {_name}"] = (
        lambda parameters=_parameters: scene_of(camera(**parameters), wall=wall()),  # type: ignore[misc]
        0.01,
    )


def quarters(image: np.ndarray) -> np.ndarray:
    """Average quarters of the micro-images of the inner lenses, for each channel."""
    half = PIXELS // 2
    rows = image.shape[0] // half
    image = image.reshape(rows, half, rows, half, -1).mean((1, 3))
    return np.asarray(image[4:-4, 4:-4], dtype=float)
