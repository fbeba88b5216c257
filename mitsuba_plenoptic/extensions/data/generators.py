"""Generators of random scenes; a new one is a class with `scene`, and an entry in `GENERATORS`.

Other extensions add theirs by `generators` of their records; what they show need not be a scene of Mitsuba's.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from ...camera import PlenopticCamera
from ...design import depth_ranges
from ...errors import naming, put_checked, refuse_if, require_choice, require_count, require_number, short_repr
from ...extension import entries, missing, place
from ...io import Capture
from ...runtime import Array, Facts, Named, Pair, drjit_array

_DETAIL = (0.2, 2.0)
"""Size of a pattern's details, in lenses, evenly in its logarithm: from below the lenses' resolution to coarse."""

_DARKEST = 0.02
_BRIGHTEST = 0.95
"""Bounds of a reflectance."""


def random_diffuse(random: np.random.Generator, plain: float, width: float) -> Named:
    """Return a diffuse surface with a random texture, as a dictionary for ``mi.load_dict``.

    The texture is band-limited noise or a checkerboard; in variants of three channels it mixes two random colours.
    """
    # All are drawn, whichever is used, so that what follows does not depend on it.
    is_plain = random.random() < plain
    is_noise = random.random() < 0.75
    level = random.uniform(0.1, 0.8)
    detail = math.exp(random.uniform(math.log(_DETAIL[0]), math.log(_DETAIL[1])))
    colours = random.uniform(_DARKEST, _BRIGHTEST, (2, 3)).astype(np.float32)
    # Four texels to a lens, where that many are allowed.
    texels = int(np.clip(4 * width, 64, 512))
    field = random.normal(size=(texels, texels))
    if is_noise:
        field = gaussian_filter(field, min(detail * texels / width, texels / 4), mode="wrap")
        pattern = 0.45 + 0.22 * field / field.std()
    else:
        cells = int(np.clip(width / (2 * detail), 2, texels / 2))
        row, column = np.indices(field.shape) * cells // texels
        pattern = np.where((row + column) % 2, 0.5 + level / 2, 0.5 - level / 2)
    if is_plain:
        pattern = np.full(field.shape, level)
    pattern = np.clip(pattern, _DARKEST, _BRIGHTEST).astype(np.float32)[..., None]
    coloured = colours[0] + pattern * (colours[1] - colours[0]) if mi.is_rgb else pattern
    texture = {"type": "bitmap", "raw": True, "data": drjit_array(mi.TensorXf, coloured)}
    return {"type": "twosided", "surface": {"type": "diffuse", "reflectance": texture}}


KINDS = ("rectangle", "disk", "sphere", "cube", "cylinder")


@dataclass(frozen=True)
class Illumination:
    """Lights of generated scenes: a sky, and a lamp near the camera."""

    # Radiance from everywhere, from 0 to 1e6.
    sky: float = 0.5
    # Irradiance, over pi, that a small lamp makes on what faces it, on the axis at 2 / (1 / near + 1 / far); 0 to 1e6.
    lamp: float = 0.5

    def __post_init__(self) -> None:
        light = partial(require_number, minimum=0, maximum=1e6)
        with naming("light"):
            put_checked(self, sky=light, lamp=light)
        refuse_if(self.sky == self.lamp == 0, "light: sky = 0 and lamp = 0: scenes would be dark")

    def emitters(self, random: np.random.Generator, distance: float) -> Named:
        """Return the lights for ``mi.load_dict``; the lamp stands at random beside or above the camera."""
        angle = random.uniform(0, 2 * math.pi)
        position = 0.5 * distance * np.array([math.cos(angle), math.sin(angle), 0.0])
        squared = float(np.sum(np.square(position - [0, 0, distance])))
        return {
            "sky": {"type": "constant", "radiance": self.sky},
            "lamp": {"type": "point", "position": position.tolist(), "intensity": math.pi * self.lamp * squared},
        }


class SceneGenerator(Protocol):
    """Generator of random scenes before a camera."""

    def scene(self, camera: PlenopticCamera, light: Illumination, random: np.random.Generator) -> Named:
        """Return a scene without a sensor, for ``mi.load_dict``; the camera is at the origin and looks along +z."""


@runtime_checkable
class CaptureGenerator(Protocol):
    """Generator of random captures of what is no scene of Mitsuba's, such as single points."""

    @property
    def meanings(self) -> dict[str, str]:
        """What the arrays besides the captures are, by name."""

    def captures(
        self, camera: PlenopticCamera, options: Mapping[str, Facts], random: np.random.Generator
    ) -> tuple[dict[str, Capture], dict[str, Array]]:
        """Return captures by name, which begins with the model, and the arrays of `meanings`.

        `options` are those of each model in the recipe.
        """


@dataclass(frozen=True)
class Shapes:
    """Textured shapes at random positions and orientations, in front of a textured wall.

    Depths are drawn evenly in disparity, so that a light field shows near and far objects equally often.
    """

    objects: int = 12
    # Distances between which they stand. Default: the range that the camera's microlenses resolve
    # (`design.depth_ranges`).
    near: float | None = None
    far: float | None = None
    # Half their width, over that of the field of view at their distance, 0.01 to 1.
    size: float = 0.15
    # Probability that one has no texture, 0 to 1.
    plain: float = 0.2
    # Which shapes there are: rectangle, disk, sphere, cube, cylinder.
    kinds: tuple[str, ...] = KINDS
    # Degrees by which flat shapes are turned away from the camera, at most, up to 80.
    tilt: float = 50.0

    def __post_init__(self) -> None:
        distance = partial(require_number, positive=True, maximum=1e9)
        put_checked(
            self,
            objects=partial(require_count, minimum=0, maximum=1000),
            near=distance,
            far=distance,
            size=partial(require_number, minimum=0.01, maximum=1),
            plain=partial(require_number, minimum=0, maximum=1),
            tilt=partial(require_number, minimum=0, maximum=80),
        )
        refuse_if(
            not isinstance(self.kinds, (list, tuple)) or not self.kinds or not set(self.kinds) <= set(KINDS),
            f"kinds = {short_repr(self.kinds)}: it must be a list of some of {', '.join(KINDS)}",
        )

    def between(self, camera: PlenopticCamera) -> Pair:
        """Return the nearest and the farthest distance of objects before a camera."""
        ranges = [limits for limits in depth_ranges(camera) if limits]
        refuse_if(
            not ranges and None in (self.near, self.far),
            "near, far: give both, as the camera resolves no distance by itself",
        )
        near = min(limits[0] for limits in ranges) if self.near is None else self.near
        far = max(limits[1] for limits in ranges) if self.far is None else self.far
        # Ten times the distance in focus counts as the end of a range without end.
        far = min(far, 10.0 * max(near, camera.focal_length))
        refuse_if(
            not camera.focal_length < near < far,
            f"near = {near:g}, far = {far:g}: they must follow one another beyond the focal length "
            f"{camera.focal_length:g}",
        )
        return float(near), float(far)

    def scene(self, camera: PlenopticCamera, light: Illumination, random: np.random.Generator) -> Named:
        """Return a scene without a sensor, for ``mi.load_dict``; the camera is at the origin and looks along +z."""
        near, far = self.between(camera)
        extent = np.array([camera.detector_width, camera.detector_height])
        wall = 1.02 * far
        # Wide enough for all points of the pupil, tilts included.
        half = 2 * max(extent) * wall / camera.mla_distance + 4 * camera.aperture_radius
        lens = max(camera.mla_pitches) / camera.mla_distance
        objects = {"wall": self._object("rectangle", np.array([0, 0, wall]), half, 2.0, 0.0, lens, random)}
        for index in range(self.objects):
            g = 1 / random.uniform(1 / far, 1 / near)
            field = extent * g / camera.mla_distance
            position = np.array([*(random.uniform(-0.5, 0.5, 2) * field), g])
            kind = self.kinds[int(random.integers(len(self.kinds)))]
            size = self.size * max(field) * random.uniform(0.5, 1.5)
            objects[f"object_{index}"] = self._object(kind, position, size, self.tilt, self.plain, lens, random)
        middle = 2 / (1 / near + 1 / far)
        return {"type": "scene", "integrator": {"type": "direct"}, **light.emitters(random, middle), **objects}

    def _object(
        self,
        kind: str,
        position: Array,
        size: float,
        tilt: float,
        plain: float,
        lens: float,
        random: np.random.Generator,
    ) -> Named:
        """Return one shape for ``mi.load_dict``; `lens` is the tangent of the angle between neighbouring lenses."""
        size = float(size)
        towards = mi.ScalarTransform4f().translate(position.tolist())
        # Mitsuba takes the axis of a rotation as it is: one that is not of length 1 shears.
        axis = random.normal(size=3)
        angle = random.uniform(0, tilt)
        roll = random.uniform(0, 360)
        if kind in ("rectangle", "disk"):
            # They face the camera, rolled and then tilted about an axis across its view.
            turned = (
                towards.rotate([*(axis[:2] / np.linalg.norm(axis[:2])), 0.0], angle)
                .rotate([0, 0, 1], roll)
                .rotate([0, 1, 0], 180)
            )
        else:
            turned = towards.rotate((axis / np.linalg.norm(axis)).tolist(), roll)
        if kind == "cylinder":
            turned = turned.translate([0, 0, -size]).scale([0.5 * size, 0.5 * size, 2 * size])
        else:
            turned = turned.scale(size)
        return {
            "type": kind,
            "to_world": turned,
            "bsdf": random_diffuse(random, plain, 2 * size / (lens * float(position[2]))),
        }


GENERATORS = {"shapes": Shapes}
"""Generators of this extension by the names that recipes call them."""


def generator_called(name: str, kind: object) -> Any:
    """Return the class of generators that a recipe calls `kind`, of this extension or of another one."""
    added = {key: (package, text) for package, key, text in entries("generators")}
    refuse_if(isinstance(kind, str) and missing("generators", kind), f"{name}: {missing('generators', str(kind))}")
    chosen = require_choice(name, kind, (*GENERATORS, *added))
    return place(*added[chosen]) if chosen in added else GENERATORS[chosen]
