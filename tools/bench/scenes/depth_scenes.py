"""Scenes for depth maps: heaps of tiles, and objects of which the depth is hard to see."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

import mitsuba_plenoptic as mp


def _texture(values: np.ndarray) -> dict[str, Any]:
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(values[..., None].astype(np.float32))}


# -- objects of which the depth is hard to see -------------------------------------------------------

Range = tuple[float, float]
CAMERAS: dict[str, tuple[mp.PlenopticCamera, tuple[Range, ...]]] = {
    "square": (_square := mp.PlenopticCamera(detector_width=3.072, resolution=(768, 768)), ((215, 265),)),
    "hexagonal": (_square.replace(mla_lattice="hexagonal"), ((215, 265),)),
    "focused": (
        _square.replace(mla_focal_length=0.384, mla_distance=121.536, aperture_radius=4.9),
        ((219.5, 225), (240.5, 247)),
    ),
    "multi-focus": (
        _square.replace(
            mla_lattice="hexagonal", mla_focal_length=(0.768, 0.72, 0.82), mla_distance=118.464, aperture_radius=4.3
        ),
        ((231.5, 238.5), (259.5, 266)),
    ),
}  # fmt: skip
"""Small cameras of 48 lenses by 48, and the ranges of distances in mm in which the objects of their scenes are.

Of Keplerian and of Galilean lenses; their light is spread over few enough lenses to be rendered with little noise.
Objects before focused cameras are on both sides of the distances at which neighbouring lenses see nothing in common
(227 to 238 mm, and 241 to 257 mm), by more than 1 %: there such a camera shows no depth, and a depth on their other
side would be near enough to count as right.
"""

BEYOND = {"square": (300, 200), "hexagonal": (300, 200), "focused": (290, 200), "multi-focus": (300, 205)}
"""Distances of cards that are farther off and nearer: where views differ by more than a lens, and beyond the default
search of the focused cameras."""


class Stage:
    """A camera and what stands before it, placed by fractions of the field and of the range of distances."""

    def __init__(self, camera: str, seed: int) -> None:
        self.camera, self.ranges = CAMERAS[camera]
        self.beyond = BEYOND[camera]
        self.random = np.random.default_rng(seed)
        self.lenses = self.camera.detector_width / self.camera.row_pitch
        self.objects: dict[str, Any] = {}
        self.depth_of: dict[str, float] = {}
        """Depth of what is seen in mirrors, by the name of the object; NaN where it has none."""

    def distance(self, fraction: float) -> float:
        """Return a distance by its fraction of the ranges put together, moved a little at random."""
        ends = np.cumsum([0.0, *(far - near for near, far in self.ranges)])
        place = float(np.clip(fraction + 0.1 * self.random.uniform(-1, 1), 0, 1)) * ends[-1]
        index = min(int(np.searchsorted(ends, place, side="right")) - 1, len(self.ranges) - 1)
        return float(self.ranges[index][0] + place - ends[index])

    def half_field(self, distance: float) -> float:
        """Return half the width of the field at a distance, in mm."""
        return self.camera.detector_width / 2 * distance / self.camera.mla_distance

    def noise(self, blur: float, contrast: float = 0.45, stretch: float = 1.0) -> np.ndarray:
        """Return a random pattern for a card of 1.2 fields, smoothed over some lenses, of mean 0.5."""
        size, per_lens = int(1.2 * 8 * self.lenses), 8
        pattern = gaussian_filter(
            self.random.normal(size=(size, size)), (blur * per_lens, blur * per_lens / stretch), mode="wrap"
        )
        return 0.5 * np.clip(1 + contrast * pattern / pattern.std(), 0.02, 1.98)

    def stripes(self, period: float, level: bool = False) -> np.ndarray:
        """Return stripes with a period in lenses for a card of 1.2 fields, upright or level."""
        size = int(1.2 * 16 * self.lenses)
        across = (np.arange(size) + 0.5) / 16 / period
        line = 0.5 + 0.45 * np.sin(2 * np.pi * (across + self.random.uniform()))
        return np.tile(line[:, None] if level else line, (1, 4) if level else (4, 1))

    def card(self, distance: float, pattern: np.ndarray, left: float = -1.2, right: float = 1.2, tilt: float = 0.0
             ) -> None:  # fmt: skip
        """Put up a luminous card; left and right in halves of the field, tilt in degrees."""
        half = self.half_field(distance)
        start, stop = (round((0.5 + edge / 2.4) * pattern.shape[1]) for edge in (left, right))
        place = mi.ScalarTransform4f().translate([-half * (left + right) / 2, 0, distance])
        place = place.rotate([0, 1, 0], 180 + tilt).scale(
            [half * (right - left) / 2 / np.cos(np.radians(tilt)), 1.2 * half, 1]
        )
        self.objects[f"object_{len(self.objects)}"] = {
            "type": "rectangle",
            "to_world": place,
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": _texture(pattern[:, start:stop])},
        }

    def scene(self) -> Any:
        """Return the scene."""
        sensor = self.camera.to_sensor() | {"sampler": {"type": "multijitter"}}
        return mp.load_scene({"type": "scene", "integrator": {"type": "direct"}, "sensor": sensor, **self.objects})


def _two_planes(stage: Stage) -> None:
    stage.card(stage.distance(0.2), stage.noise(0.8), right=0.05)
    stage.card(stage.distance(0.8), stage.noise(0.8))


def _slanted(stage: Stage) -> None:
    near, far = stage.ranges[-1]
    stage.ranges = ((near, far),)
    tilt = np.degrees(np.arctan2(0.25 * (far - near), 1.2 * stage.half_field(near)))
    stage.card(stage.distance(0.5), stage.noise(1.0, stretch=1 / np.cos(np.radians(tilt))), tilt=tilt)


def _striped(period: float) -> Callable[[Stage], None]:
    def build(stage: Stage) -> None:
        level = bool(stage.random.integers(2))
        stage.card(stage.distance(0.2), stage.stripes(period, level), right=0.05)
        stage.card(stage.distance(0.8), stage.stripes(period, level))

    return build


def _textured(blur: float, contrast: float) -> Callable[[Stage], None]:
    def build(stage: Stage) -> None:
        stage.card(stage.distance(0.2), stage.noise(blur, contrast), right=0.05)
        stage.card(stage.distance(0.8), stage.noise(blur, contrast))

    return build


def _even(stage: Stage) -> None:
    stage.card(stage.distance(0.5), np.full((4, 4), 0.5))


def _beyond(side: int) -> Callable[[Stage], None]:
    def build(stage: Stage) -> None:
        stage.card(stage.beyond[side] * stage.random.uniform(0.995, 1.005), stage.noise(1.2))

    return build


def _mirror(stage: Stage) -> None:
    """Put up a plane mirror at 45 degrees, which shows a card that stands aside, before another card."""
    seen = stage.distance(0.35)
    half = 1.2 * stage.half_field(seen)
    middle = seen - 2.2 * half
    pattern = _texture(stage.noise(0.8))
    turn = mi.ScalarTransform4f()
    # The mirror is the plane z = middle + x: it shows (x, z) at (z - middle, x + middle).
    stage.objects["aside"] = {
        "type": "rectangle",
        "to_world": turn.translate([seen - middle, 0, middle]).rotate([0, 1, 0], -90).scale([half, half, 1]),
        "emitter": {"type": "area", "radiance": pattern},
    }
    stage.objects["mirror"] = {
        "type": "rectangle",
        "to_world": turn.translate([0.3 * half, 0, middle + 0.3 * half])
        .rotate([0, 1, 0], 135)
        .scale([0.7 * half * np.sqrt(2), half, 1]),
        "bsdf": {"type": "twosided", "bsdf": {"type": "conductor", "material": "none"}},
    }
    stage.depth_of["mirror"] = seen
    stage.card(stage.distance(0.8), stage.noise(0.8))


def _balls(stage: Stage) -> None:
    """Put mirror balls and glossy ones before a card, in surroundings that they show."""
    span = sum(far - near for near, far in stage.ranges)
    for number in range(6):
        distance = stage.distance(stage.random.uniform(0.1, 0.7))
        half = stage.half_field(distance)
        radius = min(0.28 * half, 0.2 * span)
        x, y = (0.62 * half * (number % 3 - 1), 0.45 * half * (2 * (number // 3) - 1))
        mirror = number % 2 == 0
        bsdf = {"type": "conductor", "material": "none"} if mirror else {
            "type": "roughplastic", "alpha": 0.1, "diffuse_reflectance": _texture(stage.noise(0.8, 0.4)[::3, ::3])
        }  # fmt: skip
        name = f"ball_{number}"
        stage.objects[name] = {"type": "sphere", "center": [x, y, distance], "radius": radius, "bsdf": bsdf}
        if mirror:
            stage.depth_of[name] = np.nan
    stage.card(stage.distance(0.9), stage.noise(0.8))
    sky = gaussian_filter(stage.random.normal(size=(128, 256)), 2.0, mode="wrap")
    sky = np.repeat((0.6 * np.clip(1 + 0.6 * sky / sky.std(), 0.05, 3))[..., None], 3, 2).astype(np.float32)
    stage.objects["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(sky)}


def _edges(stage: Stage) -> None:
    """Hang nine cards one before the other, the nearest in the middle of the field's rows."""
    order = stage.random.permutation(9)
    for rank, fraction in zip(order, np.linspace(0.05, 0.85, 9), strict=True):
        left = -1.1 + 0.22 * rank + 0.03 * stage.random.uniform(-1, 1)
        stage.card(stage.distance(fraction), stage.noise(stage.random.uniform(0.5, 1.5)), left, left + 0.45)
    stage.card(stage.ranges[-1][1], stage.noise(1.0))


SCENES: dict[str, Callable[[Stage], None]] = {
    "two planes": _two_planes,
    "slanted plane": _slanted,
    "occluding edges": _edges,
    "stripes of 1.3 lenses": _striped(1.3),
    "stripes of 2 lenses": _striped(2.0),
    "texture as fine as a lens": _textured(0.25, 0.45),
    "weak texture": _textured(0.8, 0.03),
    "no texture": _even,
    "card beyond, far": _beyond(0),
    "card beyond, near": _beyond(1),
    "plane mirror": _mirror,
    "balls": _balls,
}
"""Those that `depth.confidence` judges."""

FITTED_SCENES: dict[str, Callable[[Stage], None]] = {
    "occluding edges": _edges,
    "stripes of 1.15 lenses": _striped(1.15),
    "stripes of 2.4 lenses": _striped(2.4),
    "stripes of 4 lenses": _striped(4.0),
    "fine texture": _textured(0.3, 0.4),
    "texture of 6 %": _textured(1.0, 0.06),
    "texture of 2 %": _textured(0.7, 0.02),
    "no texture": _even,
    "card beyond, far": _beyond(0),
    "card beyond, near": _beyond(1),
    "stripes of 1.3 lenses": _striped(1.3),
    "stripes of 2 lenses": _striped(2.0),
}
"""Those to which `depth.weights` fits, with other seeds."""


STRIPES: dict[str, Callable[[Stage], None]] = {
    f"stripes of {period:g} lenses": _striped(period) for period in (1.15, 1.3, 1.45, 1.7, 2.0, 2.5)
}
"""Those that `depth.stripes` judges, of other phases, directions and distances than all others."""

SETS = {"judged": (SCENES, 0), "fitted": (FITTED_SCENES, 1000), "held out": (STRIPES, 9000)}
"""Scenes by what they are for, and the first seed of their random numbers."""


def stage(name: str, camera: str, purpose: str = "judged") -> Stage:
    """Build a scene of which the depth is hard to see.

    Parameters
    ----------
    name : str
        One of the scenes for this purpose.
    camera : str
        One of `CAMERAS`.
    purpose : str
        One of `SETS`.
    """
    kinds, seed = SETS[purpose]
    made_up = Stage(camera, seed + 10 * list(kinds).index(name) + list(CAMERAS).index(camera))
    kinds[name](made_up)
    return made_up
