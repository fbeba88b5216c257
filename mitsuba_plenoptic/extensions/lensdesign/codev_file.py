"""CODE V ``.seq`` files: sequential lenses of spheres, conics and even aspheres around one axis."""

import math
import re
from pathlib import Path

from ...errors import refuse_if
from ...prescription import Glass, Prescription, catalogue_glass
from .lens_designs import FIELD_KINDS, UNITS, DesignReader, DesignSurface, Line, read_text

_UNITS = {"M": UNITS["MM"], "MM": UNITS["MM"], "C": UNITS["CM"], "I": UNITS["IN"]}

_OF_THE_FILE = """
    LEN INI WTW CWL WTF DOR POL CLS DER UID CA GO
"""
"""Commands without effect on the lens itself: the program, apertures, weights, derivatives, labels.

What the stop lets through is written as its aperture.
"""

_OF_A_SURFACE = "SLB SPH CON ASP CCY THC THM CUM GLC KC AC BC CC DC EC FC GC HC JC"
"""The same of a surface: labels, and which of its values a design program may change."""

_WITHOUT_EFFECT = frozenset(f"{_OF_THE_FILE} {_OF_A_SURFACE}".split())

_TERMS = "ABCDEFGHJ"
"""Coefficients of the fourth, sixth, ... power of the distance from the axis."""


def read_codev(path: str | Path) -> Prescription:
    """Return the prescription in a CODE V file.

    Parameters
    ----------
    path : str or Path
        A ``.seq`` file.

    Raises
    ------
    InputError
        If it holds anything that changes the light's path and that a `Prescription` cannot hold, or a command that is
        not known, naming file, line and rule.
    """
    path, text = read_text(path)
    reader = _CodevReader(path)
    for line in _commands(path, text):
        reader.take(line)
    return reader.prescription()


def _commands(path: Path, text: str) -> list[Line]:
    """Return the commands of a file: ``;`` separates them, ``&`` continues a line, ``!`` begins a remark."""
    commands = []
    words: list[str] = []
    continued = False
    for line_number, line in enumerate(text.splitlines(), start=1):
        if not continued:
            words = []
        continued = False
        for word in re.findall(r"\"[^\"]*\"|'[^']*'|[!;&]|[^\s!;&\"']+", line):
            if word == "!":
                break
            if word == ";":
                commands += [Line(path, line_number, tuple(words))] if words else []
                words = []
            elif word == "&":
                continued = True
            else:
                words.append(word)
        if words and not continued:
            commands.append(Line(path, line_number, tuple(words)))
    return commands


class _CodevReader(DesignReader):
    """Reader of a CODE V file."""

    unit_keyword = "DIM"
    aperture_keyword = "CIR"
    at_ends = True

    def __init__(self, path: Path):
        super().__init__(path)
        self.radii: bool | None = None
        self.primary = 0
        self.stop: Line | None = None
        self.ended = False
        # Where a thickness is found by a solve, and not as it is written, unless that is of the last surface.
        self.solved: dict[int, Line] = {}
        # Names of glasses that the file itself defines, and whether its lines still do.
        self.private: set[str] = set()
        self.defines = False

    def take(self, line: Line) -> None:
        """Read one command."""
        keyword = line.words[0].upper()
        if self.defines:
            # Each but the wavelengths begins with its name.
            self.private.add(keyword.strip("'"))
            self.defines = keyword != "END"
            return
        if keyword in _WITHOUT_EFFECT:
            return
        of_use = keyword in ("EPD", "FNO") or (keyword[:1] in "XY" and keyword[1:] in FIELD_KINDS)
        if of_use or keyword in ("DIM", "RDM", "WL", "REF"):
            self.once(line, keyword)
        if of_use:
            # An f-number is that for the object's distance.
            self.use[keyword] = [*line.values(), *([1.0] if keyword == "FNO" else [])]
            return
        match keyword:
            case "TIT" | "TITLE":
                self.name = " ".join(line.words[1:]).strip("'\"")
            case "NA" | "NAO" | "VUX" | "VLX" | "VUY" | "VLY":
                line.leave_out()
            case "PRV":
                self.defines = True
            case "DIM":
                unit = line.word(1).upper()
                line.refuse_if(unit not in _UNITS, "the unit must be M (millimetres), C (centimetres) or I (inches)")
                self.unit = _UNITS[unit]
            case "RDM":
                self.radii = len(line.words) == 1 or line.words[1].upper()[0] == "Y"
            case "WL":
                self.wavelengths = line.values()
            case "REF":
                self.primary = int(line.value(1))
            case "TEM":
                line.refuse_if(not 20 <= line.value(1) <= 25, "indices are those at 20 to 25 degrees")
            case "PRE":
                line.refuse_if(line.value(1) != 760, "indices are those at 760 mm of mercury")
            case "SO":
                line.refuse_if(self.surfaces, "SO must be the first surface")
                self._add(line)
            case "S" | "SI":
                line.refuse_if(not self.surfaces or self.ended, "surfaces must stand between SO and SI")
                self._add(line)
                self.ended = keyword == "SI"
                if self.ended:
                    line.refuse_if(self.surfaces[-1].curvature, "the image is curved: the array is a plane")
                    # Defocus is the thickness of the image.
                    self.surfaces[-2].thickness += self.surfaces[-1].thickness
            case "STO" | "STOP":
                if len(line.words) == 1:
                    self._surface(line).stop = True
                elif re.fullmatch(r"[Ss]\d+", line.words[1]):
                    self.stop = line
                else:
                    raise line.refused("it must be STO, or STO S3 for the third surface")
            case "K":
                self._surface(line).conic = self._only_value(line)
            case "CIR":
                kind = line.word(1).upper()
                if kind != "EDG":  # where the glass ends, beyond what light passes
                    rule = "apertures must be CIR and their radius: obscurations and holes are not read"
                    line.refuse_if(kind != "CLR" and len(line.words) != 2, rule)
                    self._surface(line).semi_aperture = self._only_value(line, 1 + (kind == "CLR"))
            case "IC":
                rule = "rays must meet the surface's first intersection"
                line.refuse_if(not line.word(1).upper().startswith("Y"), rule)
            case "PIM" | "THI":
                rule = "a thickness must be written in its surface's line"
                line.refuse_if(keyword == "THI" and line.word(1).upper() not in ("HMY", "HCY"), rule)
                self._surface(line)
                self.solved[len(self.surfaces) - 1] = line
            case "CUF" | "DAR":
                line.require_zero("only surfaces around one axis are read")
            case _ if keyword in ("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE", "ADX", "ADY", "ARO"):
                line.require_zero("decentred and tilted surfaces are not read")
            case _ if keyword in _TERMS and len(keyword) == 1:
                self._surface(line).asphere[_TERMS.index(keyword)] = self._only_value(line)
            case _:
                raise line.refused(f"{keyword} is not understood, and leaving it out could change the lens")

    def prescription(self) -> Prescription:
        """Return the lens between object and image."""
        refuse_if(
            not self.ended or len(self.surfaces) < 3, f"{self.path}: there must be SO, the lens's surfaces and SI"
        )
        primary = self.primary or len(self.wavelengths) == 1
        refuse_if(
            not 1 <= primary <= len(self.wavelengths),
            f"{self.path}: the primary wavelength is missing: there must be WL, and REF of several",
        )
        for index, line in self.solved.items():
            line.refuse_if(
                index != len(self.surfaces) - 2, "only the last thickness, up to the image, may be found by a solve"
            )
        if self.stop is not None:
            index = int(self.stop.word(1)[1:])
            self.stop.refuse_if(
                not 0 < index < len(self.surfaces) - 1, "there is no such surface between object and image"
            )
            self.surfaces[index].stop = True
        return self.finished(self.wavelengths[primary - 1])

    def _only_value(self, line: Line, index: int = 1) -> float:
        """Return the number at the end of a surface's command, which may be given only once."""
        self.once(line, line.words[0].upper(), of_surface=True)
        line.refuse_if(len(line.words) != index + 1, "it must be one number; semicolons separate commands")
        return line.value(index)

    def _surface(self, line: Line) -> DesignSurface:
        line.refuse_if(not self.surfaces, "it belongs to a surface: SO, S or SI must precede it")
        return self.surfaces[-1]

    def _add(self, line: Line) -> None:
        """Add a surface of radius or curvature, thickness and glass."""
        if self.radii is None:
            raise line.refused("RDM must precede it: whether radii or curvatures are written is not known")
        shape = line.value(1)
        # CODE V writes an infinite distance of the object as 1e10 or more, and other programs as a word.
        far = not self.surfaces and (line.word(2).lower().startswith("inf") or line.value(2) >= 1e9)
        thickness = math.inf if far else line.value(2)
        surface = DesignSurface(
            line, 1 / shape if self.radii and shape else shape, thickness, asphere=[0.0] * len(_TERMS)
        )
        line.refuse_if(len(line.words) > 4, "a surface has radius or curvature, thickness and glass")
        if len(line.words) == 4:
            line.refuse_if(not self.surfaces, "air must precede the first surface")
            name = line.words[3].strip("'\"")
            line.refuse_if(name.upper() in self.private, "a glass of PRV is not read: name one of a catalogue")
            surface.glass = _glass(line, name)
        self.surfaces.append(surface)


def _glass(line: Line, written: str) -> Glass | None:
    """Return the glass of a surface's line: a name, optionally with its maker, or a code of index and Abbe number."""
    if written.upper() == "AIR":
        return None
    line.refuse_if(written.upper() in ("REFL", "REF"), "mirrors are not read")
    where = f"{line.path}, line {line.number}: glass"
    if match := re.fullmatch(r"(\d+\.\d+):(\d+\.?\d*)", written):
        return Glass.from_plain({"index": float(match[1]), "abbe": float(match[2])}, where)
    # Decimals of the index before the point, and those of the Abbe number, of which two stand before its own, behind:
    # 516800.641700 for 1.5168 and 64.17, or 517642 of three each.
    if match := re.fullmatch(r"(\d{3,6})\.(\d{3,6})", written) or re.fullmatch(r"(\d{3})(\d{3})", written):
        code = {"index": float(f"1.{match[1]}"), "abbe": float(f"{match[2][:2]}.{match[2][2:]}")}
        return Glass.from_plain({**code, "name": written}, where)
    name, _, maker = written.partition("_")
    return catalogue_glass(name, where, [maker] if maker else None, with_hyphens=False)
