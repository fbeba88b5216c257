"""Lens designs of other programs: Zemax ``.zmx`` and CODE V ``.seq``, read by Optiland, the extra ``lenses``.

Of the two libraries that read both formats, Optiland and ray-optics, Optiland brings the glass catalogues, too, and
needs no graphical toolkit to be imported. It leaves out Zemax's semi-diameters, which are read here.
"""

from __future__ import annotations

import importlib
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..prescription import Prescription
from ..prescription.glass import tabulated_glass
from .files import require_size

SUFFIXES = {".zmx": "load_zemax_file", ".seq": "load_codev_file"}
"""Endings of the files that are read, and what of Optiland reads them."""

_LARGEST = 2**22


def read_design(path: str | Path) -> Prescription:
    """Read a lens that another program wrote: standard and even aspheric surfaces of lenses around one axis.

    Parameters
    ----------
    path : str or Path
        A ``.zmx`` or ``.seq`` file.

    Raises
    ------
    InputError
        If Optiland is not installed or cannot read the file, it holds what a `Prescription` cannot, or it does not tell
        a surface's semi-aperture.
    """
    path = require_size(path, _LARGEST)
    try:
        reader = getattr(importlib.import_module("optiland.fileio"), SUFFIXES[path.suffix.lower()])
    except ImportError:
        raise InputError(f"{path}: it is read by Optiland; pip install 'mitsuba-plenoptic[lenses]'") from None
    try:
        optic = reader(str(path))
        group = optic.surfaces
        places = np.ravel(group.positions)
        wavelength = float(optic.primary_wavelength) * 1e3
        surfaces = [group[number] for number in range(1, group.num_surfaces - 1)]
    except Exception as error:  # whatever Optiland makes of a file that it does not understand
        raise InputError(f"{path}: Optiland cannot read it: {' '.join(str(error).split())}") from None
    radii = _semi_diameters(path) if path.suffix.lower() == ".zmx" else {}
    plain = []
    for number, surface in enumerate(surfaces, start=1):
        last = number == len(surfaces)
        gap = 0.0 if last else float(places[number + 1] - places[number])
        plain.append(_plain(path, number, surface, gap, radii.get(number), wavelength))
    try:
        return Prescription.from_plain(
            {
                "name": optic.name or path.stem,
                "source": f"read from {path.name}",
                "wavelength": wavelength,
                "surfaces": plain,
            }
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _plain(
    path: Path, number: int, surface: Any, gap: float, semi_aperture: float | None, wavelength: float
) -> dict[str, Any]:
    """Return one of Optiland's surfaces as plain data."""
    geometry, kind = surface.geometry, type(surface.geometry).__name__
    if kind not in ("Plane", "StandardGeometry", "EvenAsphere"):
        raise InputError(f"{path}: surface {number} is of type {kind}: only standard and even aspheric ones are read")
    plain: dict[str, Any] = {"thickness": gap}
    radius = float(geometry.radius)
    if math.isfinite(radius):
        plain |= {"radius": radius, "conic": float(geometry.k)}
    if kind == "EvenAsphere":
        square, *rest = (float(term) for term in geometry.coefficients)
        if square:
            raise InputError(f"{path}: surface {number} has a term of the second power: put it into the radius")
        plain["asphere"] = rest
    if surface.is_stop:
        plain["stop"] = True
    if getattr(surface.aperture, "r_max", None) is not None:
        semi_aperture = float(surface.aperture.r_max)
    if not semi_aperture:
        raise InputError(f"{path}: surface {number} has no semi-aperture: up to where light passes must be told")
    plain["semi_aperture"] = semi_aperture
    if float(np.ravel(surface.material_post.n(wavelength * 1e-3))[0]) != 1:
        name = getattr(surface.material_post, "name", None) or f"glass {number}"
        plain["glass"] = tabulated_glass(surface.material_post, str(name)).to_plain()
    return plain


def _semi_diameters(path: Path) -> dict[int, float]:
    """Return the semi-diameters that a Zemax file tells, by the surfaces' numbers."""
    raw = path.read_bytes()
    text = raw.decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8", errors="replace")
    found: dict[int, float] = {}
    number = -1
    for line in text.splitlines():
        if match := re.match(r"\s*SURF\s+(\d+)", line):
            number = int(match[1])
        elif match := re.match(r"\s*DIAM\s+([-+.\dEe]+)", line):
            found[number] = float(match[1])
    return found
