"""Zemax ``.zmx`` files: sequential lenses of spheres, conics and even aspheres around one axis."""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError, refuse_if
from . import Glass, Prescription
from .glass import catalogue_glass
from .lens_designs import UNITS, DesignSurface, Line, read_text, to_prescription

_OF_THE_FILE = """
    VERS NOTE PFIL LANG ENPD FNUM FLOA OBNA GFAC RAIM FTYP PUSH SDMA ROPD HYPR PICB XFLN YFLN XFLD YFLD FWGN FWGT VDXN
    VDYN VCXN VCYN VANN ZVDX ZVDY ZVCX ZVCY ZVAN WWGN WWGT POLS GLRS GLCZ GSTD NSCD COFN IWDP OMMA STUD LUID AUTH DBDT
    EERA RCMF
"""
"""Keywords without effect on the lens itself: the program, notes, fields and light, aiming, and analyses' settings.

What the stop lets through is written as its semi-diameter.
"""

_OF_A_SURFACE = "COMM HIDE MIRR SLAB POPS FIMP COAT MEMA OEMA SSID SCOL MAZH PZUP VDSZ VPAR PPAR XDAT"
"""The same of a surface: drawing, labels, coatings, manufacture, and how its values, which are given, were found."""

_WITHOUT_EFFECT = frozenset(f"{_OF_THE_FILE} {_OF_A_SURFACE}".split())

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
    lines = [Line(path, number, tuple(row.split())) for number, row in enumerate(rows, start=1) if row.split()]
    last = max((line.number for line in lines if line.words[0].upper() == "SURF"), default=0)
    for line in lines:
        # The lines of a surface are indented, those of what follows the last one are not.
        reader.take(line, closing=line.number > last and not rows[line.number - 1][0].isspace())
    return reader.prescription()


class _ZemaxReader:
    """Reader of a Zemax file, which collects the lens line by line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.name = ""
        self.unit: float | None = None
        self.makers: list[str] = []
        self.wavelengths: dict[int, float] = {}
        self.primary = 1
        self.surfaces: list[DesignSurface] = []
        self.kinds: list[str] = []
        self.parameters: list[list[Line]] = []
        # Glasses are looked up when all catalogues are known, and the last surface is known to be the image.
        self.glasses: dict[int, Line] = {}
        # What has been given of the file, or of a surface, once.
        self.taken: set[tuple[str, ...]] = set()

    def take(self, line: Line, *, closing: bool) -> None:
        """Read one line; behind the last surface, `closing`, merit functions and tolerances are allowed as well."""
        keyword = line.words[0].upper()
        if keyword in _WITHOUT_EFFECT:
            return
        header = getattr(self, f"_header_{keyword.lower()}", None)
        of_surface = getattr(self, f"_surface_{keyword.lower()}", None)
        if header is None and (of_surface is None or not self.surfaces):
            line.refuse_if(not closing, f"{keyword} is not understood, and leaving it out could change the lens")
            return
        own = keyword, *(line.words[1:2] if keyword in ("PARM", "WAVM") else ())
        line.refuse_if(own in self.taken, f"{' '.join(own)} is given twice")
        self.taken.add(own)
        if header is not None:
            header(line)
        elif of_surface is not None:
            of_surface(line, self.surfaces[-1])

    def prescription(self) -> Prescription:
        """Return the lens between object and image."""
        refuse_if(
            len(self.surfaces) < 3,
            f"{self.path}: {len(self.surfaces)} surfaces: there must be an object, a lens and an image",
        )
        if self.unit is None:
            raise InputError(f"{self.path}: UNIT is missing: the unit of its lengths is not known")
        refuse_if(
            self.primary not in self.wavelengths,
            f"{self.path}: wavelength {self.primary}, the primary one by PWAV, is missing",
        )
        for number, line in self.glasses.items():
            self.surfaces[number].glass = self._glass(line)
        for surface, kind, lines in zip(self.surfaces, self.kinds, self.parameters, strict=True):
            # Other types leave values behind that the type STANDARD does not use.
            surface.asphere = self._asphere(lines) if kind == "EVENASPH" else []
        first, *lens, image = self.surfaces
        if first.glass is not None:
            raise self.glasses[0].refused("air must precede the first surface")
        refuse_if(image.curvature, f"{self.path}: surface {len(lens) + 1}, the image, is curved: the array is a plane")
        return to_prescription(self.path, self.name, self.wavelengths[self.primary] * 1e3, self.unit, lens)

    def _asphere(self, lines: list[Line]) -> list[float]:
        """Return the coefficients of an even asphere."""
        terms = [0.0] * 7
        for line in lines:
            order, term = int(line.value(1)), line.value(2)
            if not term:
                continue
            line.refuse_if(order == 1, "there must be no term of the second power: put it into the curvature")
            line.refuse_if(not 2 <= order <= 8, "an even asphere has the parameters 1 to 8")
            terms[order - 2] = term
        return terms

    def _glass(self, line: Line) -> Glass:
        name, kind = line.word(1), int(line.value(2, _FIXED))
        line.refuse_if(name == "MIRROR", "mirrors are not read")
        if kind == _MODEL:
            line.refuse_if(
                line.value(6, 0.0),
                "a model glass's deviation of the partial dispersion must be 0; name a glass instead",
            )
            index, abbe = line.value(4), line.value(5)
            return Glass("abbe", (index, abbe), "model") if abbe else Glass("index", (index,), "model")
        line.refuse_if(
            kind not in (_FIXED, _PICKED_UP, _SUBSTITUTE),
            "only fixed, substitute, picked up and model glasses are read",
        )
        return catalogue_glass(name, f"{self.path}, line {line.number}: glass", self.makers or None)

    def _header_mode(self, line: Line) -> None:
        line.refuse_if(line.words[1:] != ("SEQ",), "only sequential lenses are read")

    def _header_name(self, line: Line) -> None:
        self.name = " ".join(line.words[1:])

    def _header_unit(self, line: Line) -> None:
        line.refuse_if(line.word(1) not in UNITS, f"the unit must be one of {', '.join(UNITS)}")
        self.unit = UNITS[line.word(1)]

    def _header_gcat(self, line: Line) -> None:
        self.makers = list(line.words[1:])

    def _header_envd(self, line: Line) -> None:
        line.refuse_if(
            line.value(3, 0.0) and (line.value(1), line.value(2)) != (20.0, 1.0),
            "indices are those at 20 degrees and 1 atmosphere",
        )

    def _header_wavm(self, line: Line) -> None:
        self.wavelengths[int(line.value(1))] = line.value(2)

    def _header_wavl(self, line: Line) -> None:
        self.wavelengths = {index: line.value(index) for index in range(1, len(line.words))}

    _header_wavn = _header_wavl

    def _header_pwav(self, line: Line) -> None:
        self.primary = int(line.value(1))

    def _header_mnum(self, line: Line) -> None:
        line.refuse_if(line.value(1) != 1, "only files of one configuration are read")

    def _header_surf(self, line: Line) -> None:
        line.refuse_if(
            line.value(1) != len(self.surfaces),
            f"surfaces must be numbered from 0; this is number {len(self.surfaces)}",
        )
        self.surfaces.append(DesignSurface())
        self.kinds.append("STANDARD")
        self.parameters.append([])
        self.taken.clear()

    def _surface_type(self, line: Line, surface: DesignSurface) -> None:
        line.refuse_if(line.word(1) not in _SURFACES, f"only surfaces of the types {' and '.join(_SURFACES)} are read")
        self.kinds[-1] = line.word(1)

    def _surface_curv(self, line: Line, surface: DesignSurface) -> None:
        surface.curvature = line.value(1)

    def _surface_disz(self, line: Line, surface: DesignSurface) -> None:
        if line.word(1) == "INFINITY" and len(self.surfaces) == 1:
            return
        surface.thickness = line.value(1)

    def _surface_coni(self, line: Line, surface: DesignSurface) -> None:
        surface.conic = line.value(1)

    def _surface_parm(self, line: Line, surface: DesignSurface) -> None:
        self.parameters[-1].append(line)

    def _surface_glas(self, line: Line, surface: DesignSurface) -> None:
        self.glasses[len(self.surfaces) - 1] = line

    def _surface_stop(self, line: Line, surface: DesignSurface) -> None:
        surface.stop = True

    def _surface_diam(self, line: Line, surface: DesignSurface) -> None:
        # An aperture, which cuts rays off, outranks the semi-diameter, whichever is written first.
        surface.semi_aperture = surface.semi_aperture or line.value(1)

    def _surface_clap(self, line: Line, surface: DesignSurface) -> None:
        line.refuse_if(line.value(1), "obscurations are not read: the inner radius of the aperture must be 0")
        surface.semi_aperture = line.value(2)

    _surface_flap = _surface_clap

    def _surface_obdc(self, line: Line, surface: DesignSurface) -> None:
        line.require_zero("decentred apertures are not read")
