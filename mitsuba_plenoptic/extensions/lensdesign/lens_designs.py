"""Common parts of the readers of other programs' lens files: their lines, and the resulting `Prescription`.

Both readers know the keywords that they support and those that do not change the path of light. Anything else is
refused by file, line and rule, so that no lens is read as a different one.
"""

from __future__ import annotations

import contextlib
import logging
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...errors import InputError, naming, short_repr
from ...prescription import Glass, Prescription
from ...runtime import require_size

UNITS = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}
"""Millimetres in a unit of length."""

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

    def require_zero(self, rule: str) -> None:
        """Refuse the command unless all its values are 0."""
        self.refuse_if(any(self.value(index) for index in range(1, len(self.words))), rule)


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
    *,
    at_ends: bool = False,
) -> Prescription:
    """Return the prescription of a file's surfaces, without object and image; `_open` completes their apertures."""
    plain = []
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
    with naming(path):
        return Prescription.from_plain({**facts, "surfaces": plain})
