"""Common parts of the readers of other programs' lens files: their lines, and the resulting `Prescription`.

Both readers know the keywords that they support and those that do not change the path of light. Anything else is
refused by file, line and rule, so that no lens is read as a different one.
"""

import contextlib
import itertools
import logging
import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...errors import LONGEST, InputError, naming, short_repr, warn
from ...prescription import Glass, Prescription
from ...runtime import Named, require_size

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

    def leave_out(self) -> None:
        """Warn that what the command says of the light is left out, unless its numbers are 0."""
        if re.search("[1-9]", " ".join(self.words[1:])):
            said = short_repr(" ".join(self.words))
            warn(f"{self.path}, line {self.number}: {said}: it is left out: it limits the light, not the lens")

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
        """Return all words behind the keyword, at least one, as finite numbers."""
        return [self.value(index) for index in range(1, max(2, len(self.words)))]

    def require_zero(self, rule: str) -> None:
        """Refuse the command unless all its values are 0."""
        self.refuse_if(len(self.words) > 1 and any(self.values()), rule)


@dataclass
class DesignSurface:
    """A surface as a lens file states it, in the file's unit of length."""

    line: Line
    """The line that begins it."""
    curvature: float = 0.0
    thickness: float = 0.0
    glass: Glass | None = None
    semi_aperture: float = 0.0
    conic: float = 0.0
    asphere: list[float] = field(default_factory=list)
    """Coefficients of the fourth, sixth, ... power of the distance from the axis."""
    stop: bool = False
    kind: str = "STANDARD"
    parameters: list[Line] = field(default_factory=list)
    """Of Zemax: the type, and lines that mean what the type says."""

    def to_plain(self, unit: float) -> Named:
        """Return the surface as plain data of `Surface.from_plain`, in mm of which `unit` are one of the file."""
        terms = [term * unit ** -(2 * order + 3) for order, term in enumerate(self.asphere)]
        return {
            "radius": unit / self.curvature if self.curvature else math.inf,
            "thickness": self.thickness * unit,
            "glass": self.glass and self.glass.to_plain(),
            "semi_aperture": self.semi_aperture * unit,
            "conic": self.conic,
            # Without the zeros at their end.
            "asphere": [float(term) for term in np.trim_zeros(terms, "b")],
            "stop": self.stop,
        }


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


class DesignReader:
    """What a lens file states, collected line by line, in the file's unit of length."""

    unit_keyword: str
    aperture_keyword: str
    # Whether the format leaves out apertures of the first and the last surface, too.
    at_ends: bool

    def __init__(self, path: Path):
        self.path = path
        self.name = ""
        self.unit: float | None = None
        self.wavelengths: list[float] = []
        self.surfaces: list[DesignSurface] = []
        # Pupil and fields, by CODE V's commands.
        self.use: dict[str, list[float]] = {}
        self._stated: set[tuple[object, ...]] = set()

    def once(self, line: Line, *words: str, of_surface: bool = False) -> None:
        """Refuse a second command of the same words, in the whole file or of the last surface."""
        entry = *words, of_surface and len(self.surfaces)
        line.refuse_if(entry in self._stated, f"{' '.join(words)} is given twice")
        self._stated.add(entry)

    def finished(self, wavelength: float) -> Prescription:
        """Return the prescription of the surfaces between object and image."""
        if self.unit is None:
            raise InputError(f"{self.path}: {self.unit_keyword} is missing: the unit of its lengths is not known")
        unit = self.unit
        optical = _optical(self.surfaces[:-1])
        last = optical[max(optical)]
        before = optical.pop(0).thickness
        behind = last.thickness
        last.thickness = 0.0
        # CODE V finds apertures by rays of the pupil.
        traced = (
            self.at_ends and self.use.keys() & {"EPD", "FNO"} and not any(s.semi_aperture for s in optical.values())
        )
        if traced:
            for surface in optical.values():
                # So small that no surface ends within it.
                surface.semi_aperture = 1e-6 / max(1.0, abs(surface.curvature))
        else:
            self._open(optical)
        facts = {
            "name": self.name or self.path.stem,
            "source": f"read from {self.path.name}",
            "wavelength": wavelength,
            "wavelengths": self.wavelengths,
            "object_distance": before * unit,
            "image_distance": max(0.0, behind * unit),
            "pupil_diameter": self.use.get("EPD", [0.0])[0] * unit,
            "surfaces": [surface.to_plain(unit) for surface in optical.values()],
        }
        with naming(self.path):
            lens = self._lit(Prescription.from_plain(facts))
            if traced:
                for index, radius in enumerate(_needed(lens)):
                    lens = lens.with_surface(index, semi_aperture=radius)
                lens = Prescription.from_plain(lens.to_plain())
                _log.info("%s: apertures are a tenth wider than paraxial rays of pupil and fields", self.path)
            return lens

    def _open(self, optical: dict[int, DesignSurface]) -> None:
        """Complete apertures: surfaces without have the wider of the nearest ones before and behind."""
        stated = [surface.semi_aperture for surface in optical.values()]
        without = []
        for position, (surface_number, surface) in enumerate(optical.items()):
            if stated[position] > 0:
                continue
            sides = [
                next((radius for radius in side if radius > 0), 0.0)
                for side in (reversed(stated[:position]), stated[position + 1 :])
            ]
            if not (max(sides) if self.at_ends else min(sides)) > 0:
                missing = f"surface {surface_number} has no semi-aperture"
                raise surface.line.refused(f"{missing}: state by {self.aperture_keyword} up to where light passes")
            surface.semi_aperture = max(sides)
            without.append(surface_number)
        if without:
            numbers = ", ".join(map(str, without))
            text = "the wider of the nearest apertures is taken"
            _log.info("%s: no %s of surface %s: %s", self.path, self.aperture_keyword, numbers, text)

    def _lit(self, lens: Prescription) -> Prescription:
        """Return the lens with its pupil by the f-number, and with angles of the fields; none of real image heights."""
        kind = next((kind for kind in FIELD_KINDS[:3] if self.use.keys() & {"X" + kind, "Y" + kind}), None)
        if any(any(self.use.get(axis + "RI", [])) for axis in "XY"):
            warn(f"{self.path}: its fields are left out: they are real image heights")
        if kind is None and "FNO" not in self.use:
            return lens
        numbers = lens.paraxial
        f = numbers.focal_length
        distance = min(lens.object_distance, LONGEST)
        from_pupil = distance + numbers.entrance_pupil
        distance += numbers.front_principal
        f_number, is_working, *_ = [*self.use.get("FNO", []), 0.0, 0.0]
        if f_number > 0:
            scale = from_pupil / (distance - f) if is_working and math.isfinite(lens.object_distance) else 1.0
            lens = replace(lens, pupil_diameter=scale * f / f_number)
        if kind is None:
            return lens
        pairs = itertools.zip_longest(*(self.use.get(axis + kind, []) for axis in "XY"), fillvalue=0.0)
        x, y = np.array([*pairs]).T
        # Tangents, or heights.
        if kind == "AN":
            fields = np.hypot(np.tan(np.radians(x)), np.tan(np.radians(y)))
        else:
            fields = np.hypot(x, y) * self.unit / from_pupil
        if kind == "IM":
            fields *= distance / f - 1
        return replace(lens, fields=tuple(np.degrees(np.arctan(fields)).tolist()))


def _optical(surfaces: list[DesignSurface]) -> dict[int, DesignSurface]:
    """Return the object and surfaces by their numbers, without planes between air and air that have no aperture."""
    optical = {}
    before = None
    for number, surface in enumerate(surfaces):
        bends = surface.curvature or any(surface.asphere) or surface.glass is not None or before is not None
        if not number or bends or surface.stop or surface.semi_aperture > 0:
            optical[number] = surface
        else:
            optical[max(optical)].thickness += surface.thickness
        before = surface.glass
    return optical


def _needed(lens: Prescription) -> list[float]:
    """Return the semi-aperture in mm that each surface needs for paraxial rays, a tenth more for all but the stop."""
    pupil = lens.paraxial.entrance_pupil
    slope = math.tan(math.radians(max((0.0, *lens.fields))))
    needed = []
    for stop, surface in enumerate(lens.surfaces):
        # The surface's image before the lens, at which rays are as far from the axis as before any refraction.
        image = replace(lens, stop=stop).paraxial
        away = image.entrance_pupil - pupil
        height = abs(lens.pupil_diameter / 2 * (1 + away / (lens.object_distance + pupil))) + abs(away * slope)
        margin = 1.0 if stop == lens.stop else 1.1
        needed.append(margin * height * surface.semi_aperture / image.entrance_radius)
    return needed
