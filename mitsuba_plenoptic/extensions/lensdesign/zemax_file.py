"""Zemax ``.zmx`` files: sequential lenses of spheres, conics and even aspheres around one axis."""

import math
import re
from pathlib import Path

from ...errors import refuse_if
from ...prescription import Glass, Prescription, catalogue_glass
from .lens_designs import FIELD_KINDS, UNITS, DesignReader, DesignSurface, Line, read_text

_OF_THE_FILE = """
    VERS NOTE PFIL LANG FLOA GFAC RAIM PUSH SDMA ROPD HYPR PICB FWGN FWGT ZVDX ZVDY ZVCX ZVCY ZVAN WWGN WWGT POLS GLRS
    GLCZ GSTD NSCD COFN IWDP OMMA STUD LUID AUTH DBDT EERA RCMF
"""
"""Keywords without effect on the lens itself: the program, notes, weights and light, aiming, and analyses' settings.

What the stop lets through is written as its semi-diameter.
"""

_OF_A_SURFACE = "COMM HIDE MIRR SLAB POPS FIMP COAT MEMA OEMA SSID SCOL MAZH PZUP VDSZ VPAR PPAR XDAT"
"""The same of a surface: drawing, labels, coatings, manufacture, and how its values, which are given, were found."""

_WITHOUT_EFFECT = frozenset(f"{_OF_THE_FILE} {_OF_A_SURFACE}".split())

_OF_USE = {"ENPD": "EPD", "FNUM": "FNO", "XFLN": "X", "XFLD": "X", "YFLN": "Y", "YFLD": "Y", "FTYP": "FTYP"}
"""Keywords on the light for which a lens is designed, by those of CODE V."""

_HEADERS = frozenset(["MODE", "NAME", "UNIT", "GCAT", "ENVD", "WAVM", "WAVL", "WAVN", "PWAV", "MNUM", "SURF", *_OF_USE])
"""Keywords of the whole file, and the one that begins a surface."""

_OF_SURFACES = frozenset(["TYPE", "CURV", "DISZ", "CONI", "PARM", "GLAS", "STOP", "DIAM", "CLAP", "FLAP", "OBDC"])

_SURFACES = ("STANDARD", "EVENASPH")

_FIXED, _MODEL, _PICKED_UP, _SUBSTITUTE = range(4)
"""How a glass is given."""


def read_zemax(path: str | Path) -> Prescription:
    """Return the prescription in a Zemax file.

    Parameters
    ----------
    path : str or Path
        A ``.zmx`` file.

    Raises
    ------
    InputError
        If it holds anything that changes the light's path and that a `Prescription` cannot hold, or a keyword that is
        not known, naming file, line and rule.
    """
    path, text = read_text(path)
    reader = _ZemaxReader(path)
    rows = text.splitlines()
    lines = [
        Line(path, line_number, tuple(row.split())) for line_number, row in enumerate(rows, start=1) if row.split()
    ]
    last = max((line.number for line in lines if line.words[0].upper() == "SURF"), default=0)
    for line in lines:
        # The lines of a surface are indented, those of what follows the last one are not.
        reader.take(line, closing=line.number > last and not rows[line.number - 1][0].isspace())
    return reader.prescription()


class _ZemaxReader(DesignReader):
    """Reader of a Zemax file."""

    unit_keyword = "UNIT"
    aperture_keyword = "DIAM"
    at_ends = False

    def __init__(self, path: Path):
        super().__init__(path)
        self.makers: list[str] = []
        # In micrometres, by their numbers.
        self.lines: dict[int, float] = {}
        self.primary = 1
        # Glasses are looked up when all catalogues are known, and the last surface is known to be the image.
        self.glasses: dict[int, Line] = {}

    def take(self, line: Line, *, closing: bool) -> None:
        """Read one line; behind the last surface, `closing`, merit functions and tolerances are allowed as well."""
        keyword = line.words[0].upper()
        if keyword in _WITHOUT_EFFECT:
            return
        if keyword in ("OBNA", "VDXN", "VDYN", "VCXN", "VCYN", "VANN"):
            line.leave_out()
            return
        # Keywords of newer versions on how a value of a surface, which is given, was found: variable, picked up or
        # solved.
        if re.fullmatch("[VPZ](CUR|CON|DSZ|PAR|XDA|GLA)", keyword):
            line.remark("it bends no ray, and is skipped")
            return
        if keyword not in _HEADERS and (keyword not in _OF_SURFACES or not self.surfaces):
            line.refuse_if(not closing, f"{keyword} is not understood, and leaving it out could change the lens")
            return
        self.once(line, keyword, *(line.words[1:2] if keyword in ("PARM", "WAVM") else ()), of_surface=True)
        if keyword in _OF_USE:
            self.use[_OF_USE[keyword]] = line.values()
        match keyword:
            case "MODE":
                line.refuse_if(line.words[1:] != ("SEQ",), "only sequential lenses are read")
            case "NAME":
                self.name = " ".join(line.words[1:])
            case "UNIT":
                line.refuse_if(line.word(1) not in UNITS, f"the unit must be one of {', '.join(UNITS)}")
                self.unit = UNITS[line.word(1)]
            case "GCAT":
                self.makers = list(line.words[1:])
            case "ENVD":
                line.refuse_if(
                    line.value(3, 0.0) and (line.value(1), line.value(2)) != (20.0, 1.0),
                    "indices are those at 20 degrees and 1 atmosphere",
                )
            case "WAVM":
                self.lines[int(line.value(1))] = line.value(2)
            case "WAVL" | "WAVN":
                self.lines = dict(enumerate(line.values(), start=1))
            case "PWAV":
                self.primary = int(line.value(1))
            case "MNUM":
                line.refuse_if(line.value(1) != 1, "only files of one configuration are read")
            case "SURF":
                line.refuse_if(
                    line.value(1) != len(self.surfaces),
                    f"surfaces must be numbered from 0; this is number {len(self.surfaces)}",
                )
                self.surfaces.append(DesignSurface(line))
            case "TYPE":
                rule = f"only surfaces of the types {' and '.join(_SURFACES)} are read"
                line.refuse_if(line.word(1) not in _SURFACES, rule)
                self.surfaces[-1].kind = line.word(1)
            case "CURV":
                self.surfaces[-1].curvature = line.value(1)
            case "DISZ":
                far = line.word(1) == "INFINITY" and len(self.surfaces) == 1
                self.surfaces[-1].thickness = math.inf if far else line.value(1)
            case "CONI":
                self.surfaces[-1].conic = line.value(1)
            case "PARM":
                self.surfaces[-1].parameters.append(line)
            case "GLAS":
                self.glasses[len(self.surfaces) - 1] = line
            case "STOP":
                self.surfaces[-1].stop = True
            case "DIAM":
                # An aperture, which cuts rays off, outranks the semi-diameter, whichever is written first.
                self.surfaces[-1].semi_aperture = self.surfaces[-1].semi_aperture or line.value(1)
            case "CLAP" | "FLAP":
                line.refuse_if(line.value(1), "obscurations are not read: the inner radius of the aperture must be 0")
                self.surfaces[-1].semi_aperture = line.value(2)
            case "OBDC":
                line.require_zero("decentred apertures are not read")

    def prescription(self) -> Prescription:
        """Return the lens between object and image."""
        refuse_if(
            len(self.surfaces) < 3,
            f"{self.path}: {len(self.surfaces)} surfaces: there must be an object, a lens and an image",
        )
        refuse_if(
            self.primary not in self.lines,
            f"{self.path}: wavelength {self.primary}, the primary one by PWAV, is missing",
        )
        for number in self.glasses:
            self.surfaces[number].glass = self._glass(number)
        for surface in self.surfaces:
            # Other types leave values behind that the type STANDARD does not use.
            surface.asphere = [0.0] * 7 if surface.kind == "EVENASPH" else []
            for line in surface.parameters if surface.asphere else ():
                order = int(line.value(1))
                term = line.value(2)
                if term:
                    rule = "there must be no term of the second power: put it into the curvature"
                    line.refuse_if(order == 1, rule)
                    line.refuse_if(not 2 <= order <= 8, "an even asphere has the parameters 1 to 8")
                    surface.asphere[order - 2] = term
        first, *lens, image = self.surfaces
        if first.glass is not None:
            raise self.glasses[0].refused("air must precede the first surface")
        refuse_if(image.curvature, f"{self.path}: surface {len(lens) + 1}, the image, is curved: the array is a plane")
        # Files list more fields and wavelengths than are in use.
        field_kind, _, fields, colours = [*map(int, self.use.pop("FTYP", ())), 0, 0, 0, 0][:4]
        for axis in self.use.keys() & {"X", "Y"}:
            self.use[axis + FIELD_KINDS[min(field_kind, 3)]] = self.use.pop(axis)[: fields or None]
        self.wavelengths = [1e3 * self.lines[number] for number in sorted(self.lines)[: colours or None]]
        return self.finished(1e3 * self.lines[self.primary])

    def _glass(self, surface: int) -> Glass:
        line = self.glasses[surface]
        name = line.word(1)
        kind = int(line.value(2, _FIXED))
        if kind == _PICKED_UP and name == "___BLANK":
            source = int(line.value(3))
            line.refuse_if(
                not 0 < source < surface or source not in self.glasses,
                f"its glass is picked up from surface {source}, which must be an earlier one with a glass",
            )
            return self._glass(source)
        line.refuse_if(name == "MIRROR", "mirrors are not read")
        if kind == _MODEL:
            line.refuse_if(
                line.value(6, 0.0),
                "a model glass's deviation of the partial dispersion must be 0; name a glass instead",
            )
            index = line.value(4)
            abbe = line.value(5)
            return Glass("abbe", (index, abbe), "model") if abbe else Glass("index", (index,), "model")
        line.refuse_if(
            kind not in (_FIXED, _PICKED_UP, _SUBSTITUTE),
            "only fixed, substitute, picked up and model glasses are read",
        )
        numbers = line.value(4, 1.5), line.value(5, 40.0)
        # Where no index is stated, these stand for it.
        stated = None if numbers == (1.5, 40.0) or min(numbers) < 1 else Glass("abbe", numbers, name)
        return catalogue_glass(name, f"{self.path}, line {line.number}: glass", self.makers or None, stated=stated)
