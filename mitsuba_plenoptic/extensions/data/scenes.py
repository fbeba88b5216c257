"""The ten scenes of the benchmark, and a white one for calibration, made from a seed.

Each scene is a function of a `Frame` and of random numbers that returns shapes for ``mi.load_dict``; a new scene is one
more function in `SCENES`. All that is scored lies between `NEAR` and `FAR`. Names of shapes that begin with ``glass``
mark regions where no depth is scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from ...camera import PlenopticCamera
from ...runtime.backend import drjit_array
from .generators import Illumination

NEAR, FAR = 222.0, 262.0
"""Distances in millimetres between which every camera of the benchmark resolves depth."""

WHITE = "white"
"""Name of the scene for calibration: evenly white, radiance 1."""

GLASS = "glass"

_PER_LENS = 6
"""Texels of a pattern per lens of the reference camera."""

_MOST_TEXELS = 1024

Shapes = dict[str, Any]


@dataclass(frozen=True)
class Frame:
    """The field of view for which a scene is made."""

    # Tangent of the full field of view, and lenses across it.
    field: float
    lenses: int

    def width(self, distance: float) -> float:
        """Return the width of the field at a distance, in mm."""
        return self.field * distance

    def pattern(
        self,
        random: np.random.Generator,
        size: float,
        distance: float,
        contrast: float = 0.8,
        period: float | None = None,
    ) -> Shapes:
        """Return a diffuse surface `size` wide with noise as fine as a lens, or with stripes of a period."""
        lenses = size / self.width(distance) * self.lenses
        texels = int(np.clip(_PER_LENS * lenses, 16, _MOST_TEXELS))
        detail = random.uniform(0.6, 1.6) * texels / lenses
        field = gaussian_filter(random.normal(size=(texels, texels)), detail, mode="wrap")
        values = 0.5 + contrast * 0.25 * field / max(float(field.std()), 1e-9)
        if period is not None:
            row, column = (np.indices(field.shape) + 0.5) / texels * lenses / period
            values = 0.5 + contrast / 2 * np.sign(np.sin(2 * math.pi * row) * np.sin(2 * math.pi * column))
        image = np.clip(values, 0.02, 0.95).astype(np.float32)[..., None]
        texture = {"type": "bitmap", "raw": True, "data": drjit_array(mi.TensorXf, image)}
        return {"type": "twosided", "surface": {"type": "diffuse", "reflectance": texture}}

    def card(
        self,
        random: np.random.Generator,
        x: float,
        y: float,
        z: float,
        half: float,
        *,
        tall: float = 1.0,
        **pattern: Any,
    ) -> Shapes:
        """Return a rectangle that faces the camera; x, y and half the width are fractions of the field's width at z."""
        field = self.width(z)
        place = mi.ScalarTransform4f().translate([x * field, y * field, z]).rotate([0, 1, 0], 180)
        surface = self.pattern(random, 2 * half * max(tall, 1.0) * field, z, **pattern)
        return {"type": "rectangle", "to_world": place.scale([half * field, tall * half * field, 1]), "bsdf": surface}

    def wall(self, random: np.random.Generator, z: float = FAR, **pattern: Any) -> Shapes:
        """Return a wall behind all objects, wider than the view from any point of a pupil."""
        return self.card(random, 0, 0, z, 1.5, **pattern)

    def ball(self, x: float, y: float, z: float, radius: float, bsdf: Shapes) -> Shapes:
        """Return a sphere, with position and radius as fractions of the field's width at z."""
        field = self.width(z)
        # Its poles, where patterns shrink, are above and below.
        place = mi.ScalarTransform4f().translate([x * field, y * field, z]).rotate([1, 0, 0], 90)
        return {"type": "sphere", "to_world": place.scale(radius * field), "bsdf": bsdf}


def _depths(random: np.random.Generator, count: int, near: float = NEAR, far: float = FAR - 6) -> list[float]:
    """Return random distances from near to far, about evenly spaced in disparity."""
    steps = (np.arange(count) + random.uniform(0.2, 0.8, count)) / count
    return [float(1 / (1 / near + step * (1 / far - 1 / near))) for step in steps]


def _places(random: np.random.Generator, count: int, reach: float) -> list[tuple[float, float]]:
    """Return positions on a grid of two or more columns, each displaced at random, in random order."""
    side = math.ceil(math.sqrt(count))
    cells = random.permutation(side * side)[:count]
    column, row = cells % side, cells // side
    middles = np.stack([column, row], axis=1) + 0.5 + random.uniform(-0.25, 0.25, (count, 2))
    return [(float(x), float(y)) for x, y in (middles / side - 0.5) * 2 * reach]


def _planes(frame: Frame, random: np.random.Generator) -> Shapes:
    """Show textured planes at several depths, some in front of others."""
    places = zip(_places(random, 6, 0.45), _depths(random, 6), strict=True)
    cards = {f"card_{k}": frame.card(random, x, y, z, 0.14) for k, ((x, y), z) in enumerate(places)}
    return {"wall": frame.wall(random), **cards}


def _slant(frame: Frame, random: np.random.Generator) -> Shapes:
    """Show one slanted plane that reaches from near to far, in a random direction."""
    middle, rise = (NEAR + FAR) / 2, FAR - NEAR
    field = frame.width(middle)
    # Half again as long as the field: what lies beyond the depths is outside of it.
    length = 1.5 * math.hypot(field, rise)
    place = mi.ScalarTransform4f().translate([0, 0, middle]).rotate([0, 0, 1], float(random.uniform(0, 360)))
    place = place.rotate([1, 0, 0], math.degrees(math.atan2(rise, 1.2 * field))).scale([1.5 * field, length / 2, 1])
    return {"plane": {"type": "rectangle", "to_world": place, "bsdf": frame.pattern(random, 3 * field, middle)}}


def _balls(frame: Frame, random: np.random.Generator) -> Shapes:
    """Return a field of textured spheres."""
    places = zip(_places(random, 12, 0.5), _depths(random, 12), random.uniform(0.06, 0.14, 12), strict=True)
    balls = {
        f"ball_{k}": frame.ball(x, y, z, float(r), frame.pattern(random, 4 * r * frame.width(z), z))
        for k, ((x, y), z, r) in enumerate(places)
    }
    return {"wall": frame.wall(random), **balls}


def _fence(frame: Frame, random: np.random.Generator) -> Shapes:
    """Show two layers of thin bars in front of a wall."""
    shapes = {"wall": frame.wall(random)}
    for layer, (z, turn) in enumerate(zip((NEAR + 3, NEAR + 17), (0, 90), strict=True)):
        field, count = frame.width(z), max(3, frame.lenses // 6)
        for k in range(count):
            at = ((k + 0.5 + random.uniform(-0.2, 0.2)) / count - 0.5) * field
            half = random.uniform(0.3, 0.8) / frame.lenses * field
            place = mi.ScalarTransform4f().rotate([0, 0, 1], turn).translate([at, 0, z]).rotate([0, 1, 0], 180)
            shapes[f"bar_{layer}_{k}"] = {
                "type": "rectangle",
                "to_world": place.scale([half, 0.8 * field, 1]),
                "bsdf": frame.pattern(random, 1.6 * field, z),
            }
    return shapes


def _gloss(frame: Frame, random: np.random.Generator) -> Shapes:
    """Show spheres of metal and of lacquer, whose highlights move with the view."""
    shapes = {"wall": frame.wall(random)}
    for k, ((x, y), z) in enumerate(zip(_places(random, 4, 0.4), _depths(random, 4), strict=True)):
        under = frame.pattern(random, 0.5 * frame.width(z), z)["surface"]["reflectance"]
        alpha = float(random.uniform(0.05, 0.25))
        metal = {"type": "roughconductor", "alpha": alpha, "material": "Al"}
        lacquer = {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": under}
        shapes[f"ball_{k}"] = frame.ball(x, y, z, 0.16, metal if k % 2 else lacquer)
    return shapes


def _glass(frame: Frame, random: np.random.Generator) -> Shapes:
    """Show a ball and a slab of glass in front of textured planes."""
    (x, y), (u, v) = _places(random, 2, 0.3)
    slab = mi.ScalarTransform4f().translate([u * frame.width(236), v * frame.width(236), 236])
    slab = slab.rotate([0, 1, 0], float(random.uniform(-30, 30))).scale(0.2 * frame.width(236)).scale([1, 1, 0.15])
    return {
        "wall": frame.wall(random),
        "card": frame.card(random, -x, -y, 250, 0.2),
        "glass_ball": frame.ball(x, y, 228, 0.15, {"type": "dielectric"}),
        "glass_slab": {"type": "cube", "to_world": slab, "bsdf": {"type": "dielectric"}},
    }


MIRROR, MIRRORED = 224.0, 26.0
"""Distance of the middle of the mirror, and from there to the panel that it shows, sideways."""


def _mirror(frame: Frame, random: np.random.Generator) -> Shapes:
    """Return a plane mirror at 45 degrees in part of the field, with a panel and two cards seen in it.

    The mirror shows the panel, parallel to the axis, as a plane across it, as far behind the mirror's middle.
    """
    field = frame.width(MIRROR)
    half = float(random.uniform(0.25, 0.32)) * field
    mirror = mi.ScalarTransform4f().translate([0.12 * field, 0, MIRROR]).rotate([0, 1, 0], 135)
    aside = mi.ScalarTransform4f().translate([0.12 * field + MIRRORED, 0, MIRROR]).rotate([0, 1, 0], -90)
    seen = frame.width(MIRROR + MIRRORED)
    shapes = {
        "wall": frame.wall(random),
        "card": frame.card(random, -0.3, float(random.uniform(-0.2, 0.2)), 240, 0.15),
        "mirror": {
            "type": "rectangle",
            "to_world": mirror.scale([half, 0.9 * field, 1]),
            "bsdf": {"type": "conductor"},
        },
        "panel": {
            "type": "rectangle",
            "to_world": aside.scale(1.5 * seen),
            "bsdf": frame.pattern(random, 3 * seen, FAR),
        },
    }
    for k, (x, gap) in enumerate(((-0.12, 5.0), (0.14, 10.0))):
        y = float(random.uniform(-0.3, 0.3))
        place = aside.translate([x * seen, y * seen, gap]).scale(0.07 * seen)
        shapes[f"mirrored_{k}"] = {
            "type": "rectangle",
            "to_world": place,
            "bsdf": frame.pattern(random, 0.2 * seen, 240),
        }
    return shapes


def _plain(frame: Frame, random: np.random.Generator) -> Shapes:
    """Show planes and balls of faint texture."""
    faint = {"contrast": float(random.uniform(0.06, 0.12))}
    shapes = {"wall": frame.wall(random, **faint)}
    for k, ((x, y), z) in enumerate(zip(_places(random, 5, 0.4), _depths(random, 5), strict=True)):
        shapes[f"thing_{k}"] = (
            frame.ball(x, y, z, 0.15, frame.pattern(random, 0.6 * frame.width(z), z, **faint))
            if k % 2
            else frame.card(random, x, y, z, 0.15, **faint)
        )
    return shapes


def _repeated(frame: Frame, random: np.random.Generator) -> Shapes:
    """Return checks with a period of a few lenses, which look alike at several depths."""
    shapes = {"wall": frame.wall(random, period=float(random.uniform(2.5, 4)))}
    for k, ((x, y), z) in enumerate(zip(_places(random, 4, 0.4), _depths(random, 4), strict=True)):
        shapes[f"card_{k}"] = frame.card(random, x, y, z, 0.18, period=float(random.uniform(2, 5)))
    return shapes


def _lamps(frame: Frame, random: np.random.Generator) -> Shapes:
    """Show small lamps, brighter than white, in front of dim planes."""
    shapes = {"wall": frame.wall(random), "card": frame.card(random, 0.15, -0.2, 244, 0.25)}
    places = zip(_places(random, 20, 0.48), random.permutation(_depths(random, 20)), strict=True)
    for k, ((x, y), z) in enumerate(places):
        radiance = float(np.exp(random.uniform(np.log(2), np.log(20))))
        lamp = frame.ball(x, y, float(z), float(random.uniform(0.3, 0.8)) / frame.lenses, {"type": "diffuse"})
        shapes[f"lamp_{k}"] = lamp | {"emitter": {"type": "area", "radiance": radiance}}
    return shapes


def _luminous(frame: Frame, random: np.random.Generator) -> Shapes:
    """Return a uniformly luminous wall."""
    black = {"type": "diffuse", "reflectance": 0.0}
    return {"wall": frame.wall(random) | {"bsdf": black, "emitter": {"type": "area", "radiance": 1.0}}}


SCENES: dict[str, Callable[[Frame, np.random.Generator], Shapes]] = {
    "planes": _planes,
    "slant": _slant,
    "balls": _balls,
    "fence": _fence,
    "gloss": _gloss,
    "glass": _glass,
    "mirror": _mirror,
    "plain": _plain,
    "repeated": _repeated,
    "lamps": _lamps,
}
"""Scenes by name."""

_LIGHT = {"lamps": Illumination(0.15, 0.1), WHITE: Illumination(1.0, 0.0)}


@dataclass(frozen=True)
class SceneMaker:
    """Maker of one benchmark scene, which is the same for all cameras."""

    name: str
    seed: int
    frame: Frame

    def scene(self, camera: PlenopticCamera, light: Illumination, random: np.random.Generator) -> Shapes:
        """Return the scene as ``mi.load_dict`` takes it; camera and light of the sample do not change the objects."""
        own = np.random.default_rng(self.seed)
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 8},
            **_LIGHT.get(self.name, Illumination(0.5, 0.4)).emitters(own, (NEAR + FAR) / 2),
            **(_luminous if self.name == WHITE else SCENES[self.name])(self.frame, own),
        }
