"""Cameras that break a rule, and extreme ones that break none."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import PlenopticCamera
from mitsuba_plenoptic.bounds import LONGEST, SHORTEST
from mitsuba_plenoptic.design import design_warnings
from mitsuba_plenoptic.report.design_sheet import design_sheet

from .cases import Case
from .values import NOT_FINITE, NOT_NUMBERS, NOT_POSITIVE, NOT_WHOLE, TOO_LARGE, TOO_SMALL, pick

LENGTHS = (
    "focal_length",
    "aperture_radius",
    "mla_distance",
    "mla_focal_length",
    "mla_pitch",
    "detector_distance",
    "detector_width",
)
PAIRS = ("resolution", "crop_offset", "crop_size")
BAD_LENGTHS = (*NOT_NUMBERS, *NOT_FINITE, *NOT_POSITIVE, *TOO_SMALL, *TOO_LARGE)
BAD_PAIRS: tuple[Any, ...] = (
    None, 4096, (), (1,), (1, 2, 3), "ab", (64, "64"), (64, None), (64, 2**21), (10**400, 64), (64, 64.5), {"a": 1},
    (64, float("nan")), (True, 64),
)  # fmt: skip

BAD_LATTICES: tuple[dict[str, Any], ...] = (
    {"mla_lattice": "round"}, {"mla_lattice": None}, {"mla_lattice": []}, {"mla_aperture": "square"},
    {"mla_aperture": 1}, {"mla_fill": 0.0}, {"mla_fill": -1}, {"mla_fill": 1.0001}, {"mla_fill": 1e-5},
    {"mla_offset": 3}, {"mla_offset": "1, 2"}, {"mla_offset": (1, float("nan"))}, {"mla_offset": (1, 2, 3)},
    {"mla_offset": (0, 1e10)}, {"mla_focal_length": (0.5, 0.6, 0.7)}, {"mla_focal_length": ()},
    {"mla_focal_length": (0.5, 0.6), "mla_lattice": "hexagonal"},
    {"mla_focal_length": (0.5, -0.6, 0.7), "mla_lattice": "hexagonal"},
    {"mla_focal_length": (0.5, None, 0.7), "mla_lattice": "hexagonal"},
)  # fmt: skip


def bad_parameter(random: np.random.Generator) -> dict[str, Any]:
    """Make one parameter of a camera that the documentation forbids."""
    kind = random.random()
    if kind < 0.6:
        name = pick(random, LENGTHS)
        return {name: pick(random, BAD_LENGTHS)}
    if kind < 0.65:
        name = pick(random, ("mla_rotation", "mla_fill"))
        return {name: pick(random, (*NOT_NUMBERS, *NOT_FINITE, 400.0, -361, 1e300))}
    if kind < 0.7:
        bad = [value for value in BAD_LENGTHS if not (isinstance(value, float) and value == np.inf)]
        bad += [80.0, 79.0, np.nextafter(80.0, 81.0)]
        return {"focus_distance": pick(random, bad)}
    if kind < 0.8:
        return {"lens_model": pick(random, ("thick", "", None, 3, [], "IDEAL", "ideal ", b"ideal", {}, float("nan")))}
    if kind < 0.95:
        name = pick(random, PAIRS)
        bad_pairs = BAD_PAIRS if name != "crop_size" else BAD_PAIRS[1:]
        smallest = -1 if name == "crop_offset" else 0
        pairs = [*bad_pairs, (smallest, 5), (5, smallest), (pick(random, NOT_WHOLE), 5), (5, pick(random, NOT_FINITE))]
        if name != "resolution":
            pairs += [(4097, 1), (1, 4097), (2**20, 2**20)]
        return {name: pick(random, pairs)}
    if kind < 0.98:
        return pick(random, BAD_LATTICES)
    return {pick(random, ("zoom", "Focal_length", "mla pitch", "", "\x1b[0m")): 1.0}


def extreme_camera(random: np.random.Generator) -> PlenopticCamera:
    """Make a camera of allowed numbers, near the paper's or anywhere within the bounds."""
    spread = pick(random, (0.02, 0.1, 0.3, 1.0, 5.0, 20.0))
    paper = PlenopticCamera(resolution=(64, 64), detector_width=0.128)
    values: dict[str, Any] = {}
    for name in LENGTHS:
        length = getattr(paper, name) * float(np.exp(random.normal(0, spread)))
        values[name] = float(np.clip(length, SHORTEST, LONGEST))
    size = (int(random.integers(1, 97)), int(random.integers(1, 97)))
    if random.random() < 0.3:
        offset = (int(random.integers(size[0])), int(random.integers(size[1])))
        values["crop_offset"] = offset
        values["crop_size"] = (
            int(random.integers(1, size[0] - offset[0] + 1)),
            int(random.integers(1, size[1] - offset[1] + 1)),
        )
    if random.random() < 0.5:
        values |= {
            "mla_lattice": pick(random, ("square", "hexagonal")),
            "mla_rotation": float(random.uniform(-360, 360)),
            "mla_offset": tuple(np.clip(values["mla_pitch"] * random.normal(0, 3, 2), -LONGEST, LONGEST).tolist()),
            "mla_aperture": pick(random, ("cell", "circle")),
            "mla_fill": float(random.uniform(1e-3, 1)),
        }
        if values["mla_lattice"] == "hexagonal" and random.random() < 0.5:
            values["mla_focal_length"] = [values["mla_focal_length"] * factor for factor in (1.0, 0.9, 1.2)]
            values["mla_focal_length"] = np.clip(values["mla_focal_length"], SHORTEST, LONGEST)
    return PlenopticCamera(**values, resolution=size, lens_model=pick(random, ("ideal", "parabolic")))


def camera_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a camera in Python."""
    if random.random() < 0.6:
        parameters = bad_parameter(random)
        way = pick(random, ("keywords", "replace", "from_dict"))
        if way == "keywords" and not set(parameters) - set(PlenopticCamera().to_dict()) - {"focus_distance"}:
            return Case(f"keywords {_told(parameters)}", lambda: PlenopticCamera(**parameters), forbidden=True)
        if way == "from_dict":
            values = {**PlenopticCamera().to_dict(), **parameters}
            return Case(f"from_dict {_told(parameters)}", lambda: PlenopticCamera.from_dict(values), forbidden=True)
        return Case(f"replace {_told(parameters)}", lambda: PlenopticCamera().replace(**parameters), forbidden=True)

    def run() -> Any:
        camera = extreme_camera(random)
        wavelength = float(np.exp(random.uniform(0, np.log(1e6))))
        sheet = [row.value for row in design_sheet(camera, wavelength)]
        assert not any("nan" in value for value in sheet), sheet
        design_warnings(camera, wavelength)
        assert PlenopticCamera.from_dict(json.loads(json.dumps(camera.to_dict()))) == camera
        return camera

    return Case("within the bounds", run)


def _told(parameters: dict[str, Any]) -> str:
    return ", ".join(f"{name!a}={ascii(value)[:60]}" for name, value in parameters.items())
