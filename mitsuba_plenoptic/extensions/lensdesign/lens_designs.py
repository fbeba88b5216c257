"""Common parts of the readers of other programs' lens files: their lines, and the resulting `Prescription`.

Both readers know the keywords that they support and those that do not change the path of light. Anything else is
refused by file, line and rule, so that no lens is read as a different one.
"""

from __future__ import annotations

import contextlib
import logging
import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...errors import LONGEST, InputError, naming, short_repr
from ...prescription import Glass, Prescription, paraxial, vergence
from ...runtime import require_size

UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}
"""Millimetres in a unit of length."""

FIELD_KINDS = ("AN", "OB", "IM", "RI")
"""Fields as angles, and heights of objects, of paraxial images and of real images; in CODE V's commands behind X, Y."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Line:
    """One command of a lens file."""

    path: Path
    number: int
    words: tuple[str, ...]

    def refused(self, rule: str) -> InputError:
        """Return the exception that names file, line, command and rule."""
        return InputError(f"{self.path}, line {self.number}: {short_repr(' '.join(self.words))}: {rule}")

    def refuse_if(self, broken: object, rule: str) -> None:
        """Refuse the command if it breaks a rule."""
        if broken:
            raise self.refused(rule)

    def remark(self, text: str) -> None:
        """Log a remark that names file, line and command."""
        _log.info("%s, line %d: %s: %s", self.path, self.number, short_repr(" ".join(self.words)), text)

    def word(self, index: int) -> str:
        """Return a word of the command by its number; the keyword has the number 0."""
        self.refuse_if(index >= len(self.words), f"value {index} is missing")
        return self.words[index]

    def value(self, index: int, default: float | None = None) -> float:
        """Return a word of the command as a finite number, or `default` if the word is missing."""
        if index >= len(self.words) and default is not None:
            return default
        word = self.word(index)
        value = math.nan
        with contextlib.suppress(ValueError):
            value = float(word)
        self.refuse_if(not math.isfinite(value), f"value {index} must be a number")
        return value

    def values(self) -> list[float]:
        """Return all words behind the keyword as finite numbers."""
        return [self.value(index) for index in range(1, len(self.words))]

    def require_zero(self, rule: str) -> None:
        """Refuse the command unless all its values are 0."""
        self.refuse_if(any(self.values()), rule)


@dataclass
class DesignSurface:
    """A surface as a lens file states it, in the file's unit of length."""

    curvature: float = 0.0
    thickness: float = 0.0
    glass: Glass | None = None
    semi_aperture: float = 0.0
    conic: float = 0.0
    asphere: list[float] = field(default_factory=list)
    """Coefficients of the fourth, sixth, ... power of the distance from the axis."""
    stop: bool = False
    line: Line | None = None
    """The line that begins it."""


def read_text(path: str | Path) -> tuple[Path, str]:
    """Return a lens file's path and text, in UTF-16, UTF-8 or, as older programs write, Latin-1."""
    path = require_size(path, 2**22)
    raw = path.read_bytes()
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return path, raw.decode("utf-16", errors="replace")
    if raw[1:2] == b"\0":
        return path, raw.decode("utf-16-le", errors="replace")
    try:
        return path, raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return path, raw.decode("latin-1")


def _open(path: Path, surfaces: list[DesignSurface], keyword: str, *, at_ends: bool) -> list[DesignSurface]:
    """Return the surfaces with apertures, without planes between air and air that have none.

    Surfaces without an aperture, which `keyword` states, have the wider of the nearest ones before and behind; the
    first and the last surface only if the format leaves apertures out `at_ends`.
    """
    optical: list[tuple[int, DesignSurface]] = []
    before = None
    for surface_number, surface in enumerate(surfaces, start=1):
        bends = surface.curvature or any(surface.asphere) or surface.glass is not None or before is not None
        if bends or surface.stop or surface.semi_aperture > 0:
            optical.append((surface_number, surface))
        elif optical:
            optical[-1][1].thickness += surface.thickness
        before = surface.glass
    stated = [surface.semi_aperture for _, surface in optical]
    without = []
    for position, (surface_number, surface) in enumerate(optical):
        if stated[position] > 0:
            continue
        sides = [
            next((radius for radius in side if radius > 0), 0.0)
            for side in (reversed(stated[:position]), stated[position + 1 :])
        ]
        if not (max(sides) if at_ends else min(sides)) > 0:
            rule = f"surface {surface_number} has no semi-aperture: state by {keyword} up to where light passes"
            raise surface.line.refused(rule) if surface.line else InputError(f"{path}: {rule}")
        surface.semi_aperture = max(sides)
        without.append(surface_number)
    if without:
        numbers = ", ".join(map(str, without))
        _log.info("%s: no %s of surface %s: the wider of the nearest apertures is taken", path, keyword, numbers)
    return [surface for _, surface in optical]


def to_prescription(
    path: Path,
    name: str,
    wavelength: float,
    unit: float,
    surfaces: list[DesignSurface],
    keyword: str,
    use: dict[str, list[float]],
    *,
    at_ends: bool = False,
) -> Prescription:
    """Return the prescription of a file's surfaces, without object and image, with what CODE V's commands say of light.

    `_open` completes their apertures. If there are none, but `use` has a pupil, they are those of its paraxial rays.
    """
    plain = []
    image_distance = surfaces[-1].thickness
    if at_ends and use.keys() & {"EPD", "FNO"} and not any(surface.semi_aperture for surface in surfaces):
        for surface in surfaces:
            # So small that no surface ends within it.
            surface.semi_aperture = 1e-6 / max(1.0, abs(surface.curvature))
        needed = _needed(to_prescription(path, name, wavelength, unit, surfaces, keyword, use))
        for surface, radius in zip(surfaces, needed, strict=True):
            surface.semi_aperture = radius / unit
        _log.info("%s: no %s: apertures are a tenth wider than paraxial rays of pupil and fields", path, keyword)
    surfaces = _open(path, surfaces, keyword, at_ends=at_ends)
    for surface_number, surface in enumerate(surfaces, start=1):
        terms = [term * unit ** -(2 * order + 3) for order, term in enumerate(surface.asphere)]
        entry = {
            "thickness": 0.0 if surface_number == len(surfaces) else surface.thickness * unit,
            "semi_aperture": surface.semi_aperture * unit,
            "conic": surface.conic,
            # Without the zeros at their end.
            "asphere": [float(term) for term in np.trim_zeros(terms, "b")],
            "stop": surface.stop,
        }
        if surface.curvature:
            entry["radius"] = unit / surface.curvature
        if surface.glass is not None:
            entry["glass"] = surface.glass.to_plain()
        plain.append(entry)
    facts = {"name": name or path.stem, "source": f"read from {path.name}", "wavelength": wavelength}
    facts |= {"object_distance": use["SO"][0] * unit or math.inf, "image_distance": max(0.0, image_distance * unit)}
    facts |= {"wavelengths": use["WL"], "pupil_diameter": use.get("EPD", [0.0])[0] * unit}
    with naming(path):
        lens = Prescription.from_plain({**facts, "surfaces": plain})
        if "FNO" in use and math.isinf(lens.object_distance):
            lens = replace(lens, pupil_diameter=paraxial(lens).focal_length / use["FNO"][0])
        return replace(lens, fields=_angles(lens, use, unit))


def _angles(lens: Prescription, use: dict[str, list[float]], unit: float) -> tuple[float, ...]:
    """Return the angles in degrees, seen from the entrance pupil, of a file's fields; none of real image heights."""
    kind = next((kind for kind in FIELD_KINDS[:3] if use.keys() & {"X" + kind, "Y" + kind}), None)
    if kind is None:
        return ()
    x, y = (np.array(use.get(axis + kind, [0.0])) for axis in "XY")
    if kind == "AN":
        return tuple(np.degrees(np.arctan(np.hypot(*(np.tan(np.radians(angle)) for angle in (x, y))))).tolist())
    numbers = paraxial(lens)
    distance = min(lens.object_distance, LONGEST)
    heights = unit * np.hypot(x, y)
    if kind == "IM":
        distances = distance + numbers.front_principal
        heights = heights * distances * vergence(numbers.focal_length, distances)
    return tuple(np.degrees(np.arctan(heights / (distance + numbers.entrance_pupil))).tolist())


def _needed(lens: Prescription) -> list[float]:
    """Return the semi-aperture in mm that each surface needs for paraxial rays, a tenth more for all but the stop."""
    pupil = paraxial(lens).entrance_pupil
    slope = math.tan(math.radians(max((0.0, *lens.fields))))
    needed = []
    for stop, surface in enumerate(lens.surfaces):
        # The surface's image before the lens, at which rays are as far from the axis as before any refraction.
        image = paraxial(replace(lens, stop=stop))
        away = image.entrance_pupil - pupil
        height = abs(lens.pupil_diameter / 2 * (1 + away / (lens.object_distance + pupil))) + abs(away * slope)
        margin = 1.0 if stop == lens.stop else 1.1
        needed.append(margin * height * surface.semi_aperture / image.entrance_radius)
    return needed
