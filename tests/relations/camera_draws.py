"""Small cameras at random: how each parameter of the table is drawn, and how it grows with the unit of length.

A draw is a seed and the names of its options. Values of an option depend on both alone, so that a failure without some
of its options is about the same camera.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

import mitsuba_plenoptic as mp
from mitsuba_plenoptic.array import Conic
from mitsuba_plenoptic.camera import PARAMETERS
from mitsuba_plenoptic.camera.entry import Use
from mitsuba_plenoptic.camera.support import entries_at

LENSES = 8

BASE = {
    "focal_length": 1, "aperture_radius": 1, "mla_distance": 1, "mla_focal_length": 1, "mla_pitch": 1,
    "detector_width": 1, "resolution": 0,
}  # fmt: skip
"""Exponents of the unit of length in parameters that all draws state."""

Values = dict[str, Any]
Dimension = int | Sequence[int] | Callable[[Any, float], Any]


def base(rng: np.random.Generator) -> Values:
    """Return a camera of 8 lenses across whose micro-images touch."""
    pixels, pixel = int(rng.choice([8, 9, 10, 12])), float(rng.choice([0.002, 0.003, 0.004]))
    f_number, distance = float(rng.choice([6, 8, 12])), float(rng.choice([56, 60, 66]))
    pitch = pixels * pixel
    return {
        "focal_length": 40.0, "aperture_radius": distance / f_number / 2, "mla_distance": distance,
        "mla_focal_length": pitch * f_number, "mla_pitch": pitch * distance / (distance + pitch * f_number),
        "detector_width": LENSES * pitch, "resolution": (LENSES * pixels,) * 2,
    }  # fmt: skip


@dataclass(frozen=True)
class Option:
    """How a parameter is drawn, and the exponent of the unit of length: one, one a component, or a function."""

    draw: Callable[[np.random.Generator, Values], Any]  # of the values before; a dictionary has more parameters
    dimension: Dimension = 0


def _uniform(low: float, high: float) -> Callable[[np.random.Generator, Values], float]:
    return lambda rng, values: float(rng.uniform(low, high))


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(np.asarray(values, float).tolist())


def _pitch(values: Values) -> float:
    return float(np.min(values["mla_pitch"]))


def _pixel(values: Values) -> float:
    return float(values["detector_width"] / values["resolution"][0])


def _lens(rng: np.random.Generator, values: Values) -> Values:
    """Return a real main lens in place of the thin one: a prescription of the same numbers, or an objective."""
    if rng.random() < 0.4:
        return {"main_lens": str(rng.choice(["double_gauss", "tessar", "cooke_triplet"])), "aperture_radius": 3.5}
    pixels = values["resolution"][0] // LENSES
    lens = mp.Objective(20.0, float(rng.choice([0.4, 0.5])), immersion=float(rng.choice([1.0, 1.33])))
    pitch = 0.15
    return {
        "main_lens": lens,
        **dict.fromkeys(("focal_length", "aperture_radius", "mla_distance")),
        "mla_pitch": pitch,
        "mla_focal_length": pitch * lens.magnification / (2 * lens.numerical_aperture),
        "detector_width": pitch * LENSES,
        "resolution": (LENSES * pixels,) * 2,
    }


def _vignetting(rng: np.random.Generator, values: Values) -> mp.Vignetting:
    return mp.Vignetting(
        radius=[float(rng.uniform(0.8, 1)), *rng.uniform(-0.1, 0.1, 5).tolist()],
        scale=values["detector_width"] / 2,
        slope_x=rng.uniform(-0.2, 0.2, 3).tolist(),
        apodisation_2=[float(rng.uniform(-0.3, 0.1))],
    )


def _screen(rng: np.random.Generator, values: Values) -> mp.PhaseScreen:
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, 33)])
    waves = 0.3 * np.sin(3 * x + rng.uniform(0, 6)) * np.cos(2 * y + rng.uniform(0, 6))
    return mp.PhaseScreen(waves, 2.2 * (values["aperture_radius"] or 10.0))


def _aperture(rng: np.random.Generator, values: Values) -> mp.Aperture:
    x, y = np.meshgrid(*2 * [np.arange(-3, 4)])
    return mp.Aperture(rng.choice([0.0, 0.5, 1.0, 1.0], (7, 7)) * (np.hypot(x, y) < 3))


def _warp(rng: np.random.Generator, values: Values) -> tuple[float, ...]:
    half = values["detector_width"] / 2
    return _floats(np.ravel(0.02 * _pitch(values) * rng.normal(size=(2, 7)) / half ** np.array([2] * 3 + [3] * 4)))


OPTIONS = {
    "main_lens": Option(_lens, lambda lens, s: replace(
        lens, tube_focal_length=s * lens.tube_focal_length) if isinstance(lens, mp.Objective) else lens),
    "mla_lattice": Option(lambda rng, v: str(rng.choice(["hexagonal", "hexagonal", "none"]))),
    "focus_distance": Option(
        lambda rng, v: {"focus_distance": float(rng.uniform(110, 140)), "mla_distance": None}, 1
    ),
    "mla_focal_length": Option(
        lambda rng, v: {
            "mla_focal_length": _floats(v["mla_focal_length"] * np.array([0.92, 1, 1.1])), "mla_lattice": "hexagonal"
        }, 1
    ),
    "mla_pitch": Option(lambda rng, v: (v["mla_pitch"], 0.9 * v["mla_pitch"]), 1),
    "mla_rotation": Option(_uniform(-30, 30)),
    "mla_offset": Option(lambda rng, v: _floats(rng.uniform(-0.5, 0.5, 2) * _pitch(v)), 1),
    "mla_tilt": Option(lambda rng, v: _floats(rng.uniform(-1, 1, 2))),
    "mla_aperture": Option(lambda rng, v: "circle"),
    "mla_fill": Option(_uniform(0.7, 1.0)),
    "mla_transmissions": Option(lambda rng, v: mp.LensTransmissions(rng.uniform(0.5, 1.0, (LENSES + 4, LENSES + 4)))),
    "mla_medium": Option(lambda rng, v: float(rng.choice([1.33, 1.5]))),
    "mla_absorption": Option(_uniform(0.0, 0.5), -1),
    "detector_distance": Option(lambda rng, v: float(rng.uniform(0.85, 1.2) * np.max(v["mla_focal_length"])), 1),
    "mla_shape": Option(
        lambda rng, v: {"mla_shape": Conic(0.5 * np.max(v["mla_focal_length"])), "mla_focal_length": None},
        lambda shape, s: replace(shape, curvature_radius=s * shape.curvature_radius),
    ),
    "crop_offset": Option(lambda rng, v: tuple(int(n) for n in rng.integers(0, v["resolution"][0] // 4, 2))),
    "crop_size": Option(lambda rng, v: tuple(int(n) for n in rng.integers(1, 4, 2) + v["resolution"][0] // 2)),
    "lens_model": Option(lambda rng, v: "parabolic"),
    "distortion": Option(
        lambda rng, v: _floats(rng.uniform(-0.9, 0.9, 5) * (0.5, 0.2, 0.1, 0.05, 0.05)),
        (-2, -4, -6, -1, -1),
    ),
    "wavefront": Option(lambda rng, v: _floats([0.0] * 3 + (rng.normal(size=6) * 0.1).tolist()), 1),
    "phase_screen": Option(_screen, lambda screen, s: mp.PhaseScreen(s * np.asarray(screen.waves), s * screen.width)),
    "aperture_blades": Option(lambda rng, v: (int(rng.integers(4, 8)), float(rng.uniform(0, 90)))),
    "aperture_image": Option(_aperture),
    "pupil_apodisation": Option(lambda rng, v: _floats([rng.uniform(-0.6, 0.3), rng.uniform(-0.2, 0.2)])),
    "vignetting": Option(_vignetting, lambda record, s: replace(record, scale=s * record.scale)),
    "mla_jitter": Option(lambda rng, v: _floats([0.02 * _pitch(v), 0.01]), (1, 0)),
    "mla_seed": Option(
        lambda rng, v: {"mla_seed": int(rng.integers(1, 99)), "mla_jitter": (0.01 * _pitch(v), 0.0)}
    ),
    "mla_warp": Option(_warp, ([-1] * 3 + [-2] * 4) * 2),
    "mla_figure_error": Option(lambda rng, v: (2e-5, 0.5 * _pitch(v)), (1, 1)),
    "mla_cra": Option(
        lambda rng, v: _floats([0, 0, v["detector_width"] / 4, 0.4, v["detector_width"] / 2, 1.0]), (1, 0) * 3
    ),
    "detector_blur": Option(lambda rng, v: float(rng.uniform(0.2, 1.5)) * _pixel(v), 1),
    "pixel_crosstalk": Option(_uniform(0.0, 0.1)),
    "stray_light": Option(lambda rng, v: float(rng.uniform(0, 0.3)) if rng.random() < 0.7 else mp.StrayLight(
        rng.uniform(0, 0.3, (3, 3)))),
    "stray_width": Option(lambda rng, v: {"stray_width": float(rng.uniform(3, 10)) * _pixel(v), "stray_light": 0.2}, 1),
    "pixel_response": Option(lambda rng, v: _floats([0, 1, 5, rng.uniform(0.7, 1), 15, rng.uniform(0.2, 0.7)])),
    "glass": Option(lambda rng, v: {"glass": {"index": 1.5168, "abbe": float(rng.uniform(30, 65))}}),
    "mla_glass": Option(lambda rng, v: {"mla_glass": {"index": 1.49, "abbe": float(rng.uniform(30, 60))}}),
}  # fmt: skip
"""Draws of each parameter, in the order in which they build on one another."""

NOT_DRAWN = {"photodiode_response": "cameras of 2 x 2 pixels a lens have relations of their own in tests/extensions"}


class Draw:
    """A camera with some options, and a generator for what else a relation draws."""

    def __init__(self, seed: int, options: Iterable[str]) -> None:
        self.seed, self.rng = seed, np.random.default_rng([seed, 1])
        self.options = tuple(name for name in OPTIONS if name in set(options))
        self.parameters = base(np.random.default_rng([seed, 0]))
        for name in self.options:
            value = OPTIONS[name].draw(np.random.default_rng([seed, zlib.crc32(name.encode())]), self.parameters)
            self.parameters |= value if isinstance(value, dict) else {name: value}
        without_array = self.parameters.get("mla_lattice") == "none"
        self.parameters = {
            name: value
            for name, value in self.parameters.items()
            if value is not None and not (without_array and name in BASE and PARAMETERS[name].of_array)
        }
        self.wavelength = float(self.rng.choice([450.0, 550.0, 650.0]))
        self.format = ""  # of a file that a relation writes
        self.slopes: list[str] = []  # parameters by which a relation computes derivatives

    @cached_property
    def camera(self) -> mp.PlenopticCamera:
        """The camera of all options."""
        return mp.PlenopticCamera(**self.parameters)

    def point(self, beside: float = 1.0) -> Any:
        """Return a scene point that the camera sees, in focus or beside it."""
        if self.camera.objective is not None:
            return tuple((self.rng.uniform(-1, 1, 3) * (0.01, 0.01, 0.006)).tolist())
        focus = min(self.camera.focus_distance, 1000.0)
        g = focus * (1 + beside * float(self.rng.choice([-0.06, -0.02, 0.0, 0.03, 0.07])))
        reach = 0.25 * self.camera.detector_width * g / self.camera.mla_distance
        return (*self.rng.uniform(-reach, reach, 2).tolist(), g)


def possible(seed: int, options: Iterable[str], use: Use) -> Draw:
    """Return the draw without the options that exclude others, or that the table of support refuses for a use."""
    names: list[str] = []
    for name in options:
        try:
            camera = Draw(seed, [*names, name]).camera
        except mp.InputError:
            continue
        if not any(entry.is_refusal for _, _, entry in entries_at(camera, use)):
            names.append(name)
    return Draw(seed, names)


def stage_of(name: str) -> str:
    """Return the stage of a camera on which a parameter acts: the pupil, the array or the detector."""
    if PARAMETERS[name].of_array:
        return "array"
    return "detector" if name.startswith(("detector", "pixel", "stray", "crop", "resolution")) else "pupil"


def on_stage(names: Iterable[str], stage: str) -> list[str]:
    """Return the parameters that act on a stage."""
    return [name for name in names if stage_of(name) == stage]


def dimension_of(name: str) -> Dimension:
    """Return how a parameter grows with the unit of length."""
    return BASE[name] if name in BASE else OPTIONS[name].dimension


def scaled(parameters: Values, s: float) -> Values:
    """Return the parameters of a camera all of whose lengths are s times as long."""

    def longer(name: str, value: Any) -> Any:
        dimension = dimension_of(name)
        if callable(dimension):
            return dimension(value, s)
        if dimension == 0 or value is None:
            return value
        factors = s ** np.array(dimension, float)
        return _floats(factors * np.array(value)) if isinstance(value, tuple) else float(factors * value)

    return {name: longer(name, value) for name, value in parameters.items()}
