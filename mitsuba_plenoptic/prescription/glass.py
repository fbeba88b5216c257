"""Refractive indices of glasses, by makers' catalogue formulas, by two numbers, or by a table."""

from __future__ import annotations

import contextlib
import csv
import functools
import importlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from ..errors import (
    InputError,
    naming,
    refuse_if,
    refusing,
    require_known,
    require_number,
    require_wavelength,
    short_repr,
    warn,
)
from . import lenses

LINE_D = 587.5618
LINE_F = 486.1327
LINE_C = 656.2725
"""Wavelengths in nanometres at which catalogues give index and Abbe number: helium d, hydrogen F and C."""

_COUNTS = {"index": 1, "abbe": 2, "sellmeier": 6, "schott": 6, "table": None}

_LOWEST = 1.0
_HIGHEST = 5.0

_CATALOGUE = np.arange(380.0, 1001.0, 10.0)
"""Wavelengths in nanometres at which a glass of a catalogue is tabulated."""


@dataclass(frozen=True)
class Glass:
    r"""A glass between two surfaces, with its refractive index by wavelength.

    Parameters
    ----------
    form : {"index", "abbe", "sellmeier", "schott", "table"}
        What the numbers are. ``index``: one index for all wavelengths. ``abbe``: :math:`n_d` and
        :math:`V_d = (n_d - 1) / (n_F - n_C)`, with :math:`n = A + B / \lambda^2` between. ``sellmeier``: B1, B2, B3,
        C1, C2, C3 of :math:`n^2 = 1 + \sum B_i \lambda^2 / (\lambda^2 - C_i)`, :math:`\lambda` in micrometres, as in
        today's catalogues. ``schott``: a0 to a5 of :math:`n^2 = a_0 + a_1 \lambda^2 + a_2 \lambda^{-2} + a_3
        \lambda^{-4} + a_4 \lambda^{-6} + a_5 \lambda^{-8}`, as in older ones. ``table``: pairs of wavelength in
        nanometres and index, between which :math:`n(1 / \lambda^2)` is a cubic spline.
    numbers : tuple of float
        The numbers; a table's wavelengths and indices in turn.
    name : str
        Name in a catalogue, for the reader.
    """

    form: str
    numbers: tuple[float, ...]
    name: str = ""

    def __post_init__(self) -> None:
        count = _COUNTS[self.form]
        refuse_if(
            count is not None and len(self.numbers) != count,
            f"glass: {self.form} = {short_repr(self.numbers)}: it must be {count} numbers",
        )
        if self.form == "table":
            wavelengths = self.numbers[::2]
            refuse_if(
                len(self.numbers) % 2 or len(wavelengths) < 2 or np.any(np.diff(wavelengths) <= 0),
                f"glass: table = {short_repr(self.numbers)}: it must be two or more pairs of "
                "wavelength and index, by rising wavelength",
            )
        if self.form == "abbe" and self.numbers[1] <= 0:
            raise InputError(f"glass: abbe = {self.numbers[1]:g}: it must be greater than 0")

    @property
    def reach(self) -> tuple[float, float]:
        """Shortest and longest wavelength in nanometres at which the glass has an index.

        Sellmeier's formula holds from a fifth above its pole in the ultraviolet.
        """
        if self.form == "table":
            return self.numbers[0], self.numbers[-2]
        # 0.25: Square micrometres, beyond which poles are in the infrared.
        poles = [number for number in self.numbers[3:] if 0 < number < 0.25 and self.form == "sellmeier"]
        return 1200.0 * max(poles, default=0.0) ** 0.5, 2500.0

    def at(self, wavelength: float) -> float:
        """Return the refractive index at a wavelength.

        Parameters
        ----------
        wavelength : float
            Wavelength in nanometres.

        Raises
        ------
        InputError
            If the glass gives no index from 1 to 5 there, or does not reach so far.
        """
        low, high = self.reach
        refuse_if(
            not low <= require_wavelength(wavelength) <= high,
            f"glass {self.name or self.form}: wavelength = {wavelength:g} nm: it has an index from {low:.4g} to "
            f"{high:g} nm",
        )
        index = self._at(wavelength)
        if not _LOWEST <= index <= _HIGHEST:
            raise InputError(
                f"glass {self.name or self.form}: its index at {wavelength:g} nm is {index:.4g}; it must be from "
                f"{_LOWEST:g} to {_HIGHEST:g}"
            )
        return index

    def _at(self, wavelength: float) -> float:
        square = (wavelength * 1e-3) ** 2
        numbers = np.asarray(self.numbers)
        if self.form == "index":
            return float(numbers[0])
        if self.form == "abbe":
            d, f, c = (1 / line**2 for line in (LINE_D, LINE_F, LINE_C))
            slope = (numbers[0] - 1) / (numbers[1] * (f - c))
            return float(numbers[0] + slope * (1 / wavelength**2 - d))
        if self.form == "table":
            # SciPy takes a while to import, and few glasses are tables.
            from scipy.interpolate import make_interp_spline

            table = numbers.reshape(-1, 2)
            abscissa = 1 / table[::-1, 0] ** 2
            index = table[::-1, 1]
            return float(make_interp_spline(abscissa, index, k=min(3, len(table) - 1))(1 / wavelength**2))
        if self.form == "sellmeier":
            below = square - numbers[3:]
            value = np.nan if np.any(below == 0) else 1 + np.sum(numbers[:3] * square / below)
        else:
            value = np.sum(numbers * square ** np.array([0, 1, -1, -2, -3, -4.0]))
        return float(np.sqrt(value)) if value > 0 else float("nan")

    def focal_ratio(self, wavelength: float) -> float:
        r"""Return the ratio of a thin lens's focal length in this glass to its focal length at the d line (587.6 nm).

        :math:`f(\lambda) / f_d = (n_d - 1) / (n(\lambda) - 1)`, the lensmaker's equation (Born and Wolf, "Principles of
        Optics", section 4.7).

        Parameters
        ----------
        wavelength : float
            Wavelength in nanometres.
        """
        bends = self.at(LINE_D) - 1, self.at(wavelength) - 1
        if min(bends) <= 0:
            raise InputError(f"glass {self.name or self.form}: its index is 1: a lens of it bends no light")
        return bends[0] / bends[1]

    def to_plain(self) -> Any:
        """Return the glass as a number or a dictionary, for `from_plain`."""
        if self.form == "index" and not self.name:
            return self.numbers[0]
        named = {"name": self.name} if self.name else {}
        if self.form == "abbe":
            return {**named, "index": self.numbers[0], "abbe": self.numbers[1]}
        if self.form == "table":
            return {**named, "table": [list(self.numbers[i : i + 2]) for i in range(0, len(self.numbers), 2)]}
        return {**named, self.form: self.numbers[0] if self.form == "index" else list(self.numbers)}

    @classmethod
    def from_plain(cls, value: Any, where: str = "glass") -> Glass:
        """Return the glass that plain data describe.

        Parameters
        ----------
        value : float, str or dict
            An index; a name, for which the extra ``lenses`` must be installed unless the glass is a usual one; or a
            dictionary with ``index``, with ``index`` and ``abbe``, or with one of ``sellmeier``, ``schott``, ``table``,
            and ``name``.
        where : str
            Name of the glass in messages.
        """
        if isinstance(value, str):
            return catalogue_glass(value, where)
        if not isinstance(value, dict):
            return cls("index", (require_number(where, value, minimum=_LOWEST, maximum=_HIGHEST),))
        name = value.get("name", "")
        forms = {key: entry for key, entry in value.items() if key != "name"}
        require_known(f"{where}: ", forms, (*_COUNTS, "name"))
        refuse_if(
            not isinstance(name, str)
            or set(forms) not in (*({form} for form in _COUNTS if form != "abbe"), {"index", "abbe"}),
            f"{where} = {short_repr(value)}: it must have index, index and abbe, sellmeier, schott or "
            "table, and may have name",
        )
        form = "abbe" if "abbe" in forms else next(iter(forms))
        entries = [forms["index"], forms["abbe"]] if form == "abbe" else forms[form]
        if form == "index":
            entries = [entries]
        refuse_if(
            not isinstance(entries, (list, tuple)),
            f"{where}: {form} = {short_repr(entries)}: it must be a list of numbers",
        )
        if form == "table":
            refuse_if(
                not all(isinstance(pair, (list, tuple)) and len(pair) == 2 for pair in entries),
                f"{where}: table = {short_repr(entries)}: it must be pairs of wavelength and index",
            )
            entries = [figure for pair in entries for figure in pair]
        return cls(form, tuple(require_number(f"{where}: {form}", entry) for entry in entries), name)


def catalogue_glass(
    name: str, where: str = "glass", makers: Sequence[str] | None = None, with_hyphens: bool = True, stated: Any = None
) -> Glass:
    """Return a glass by its name in a maker's catalogue, as a table independent of the catalogue.

    The usual glasses of SCHOTT, by the Sellmeier coefficients of its data sheets, and fused silica (Malitson, J. Opt.
    Soc. Am. 55, 1205 (1965)) are in a table of the package. Further catalogues are those of refractiveindex.info
    included in Optiland, the extra ``lenses``. The name must match exactly, except for capitals. For an older
    name of SCHOTT, such as SK16, the glass `stated` is returned or, with a warning, the successor N-SK16.
    """
    maker, _, glass = name.rpartition(":")
    if maker:
        makers = [maker]
    hyphen = "-" if with_hyphens else ""
    plain = glass.lower().replace("-", hyphen)
    text = (resources.files(lenses) / "glasses.csv").read_text(encoding="utf-8")
    rows = {row[0].lower().replace("-", hyphen): row for row in csv.reader(text.splitlines())}
    successor = None
    if row := rows.get(plain, rows.get(f"n{hyphen}{re.sub(r'n(?=[0-9])', '', plain)}")):
        known, by, *numbers = row
        # Other makers have glasses of SCHOTT's older names, without N, too.
        unique = not by or known.startswith("N-")
        searched = [by] * unique if makers is None else makers[: None if unique else 1]
        if any(by in maker.upper() for maker in searched):
            successor = Glass("sellmeier", tuple(map(float, numbers)), name if plain in rows else known)
            if plain in rows:
                return successor
    catalogues: dict[str, _Entry] = {}
    missing = f"{where} = {short_repr(name)}: others than those included need pip install 'mitsuba-plenoptic[lenses]'"
    with contextlib.suppress(ImportError) if successor else refusing(missing, ImportError):
        importlib.import_module("optiland.materials")
        catalogues = {entry.maker: entry for entry in _catalogued() if plain == entry.name.lower().replace("-", hyphen)}
    # Files of other programs write makers with what belongs to them, such as NIKON-HIKARI.
    chosen = list(catalogues)
    if makers is not None:
        chosen = [maker for written in makers for maker in catalogues if maker.lower() in written.lower()][:1]
    if len(chosen) > 1:
        raise InputError(f"{where} = {short_repr(name)}: {', '.join(chosen)} have one: write {chosen[0]}:{glass}")
    if successor and not chosen:
        if stated is None:
            warn(f"{where} = {name}: its successor {successor.name}, of a slightly different index, stands in for it")
        return stated or successor
    if not chosen:
        searched = "no catalogue has" if makers is None else f"{', '.join(makers)}: no such catalogue has"
        # The same name from other makers, who measured a crystal of that name, then longer names.
        measured = [entry for entry in _catalogued() if plain == entry.maker.lower()]
        longer = [entry for entry in _catalogued() if entry.file.startswith("glass/") and plain in entry.name.lower()]
        like = [f"{entry.maker}:{entry.name}" for entry in [*catalogues.values(), *measured, *longer] if plain]
        hint = f", as there is {', '.join(dict.fromkeys(like[:3]))}" if like else ""
        raise InputError(
            f"{where} = {short_repr(name)}: {searched} a glass of just that name; give another{hint}, or index and abbe"
        )
    return catalogues[chosen[0]].tabulated(name)


class _Entry(NamedTuple):
    """Material of a catalogue: its maker, name and file, and the wavelengths in nm between which it has data."""

    maker: str
    name: str
    file: str
    low: float
    high: float

    def tabulated(self, name: str) -> Glass:
        """Return the material as a table of indices, from 380 to 1000 nm as far as its data reach."""
        path = resources.files("optiland.database") / "data-nk" / self.file
        material = importlib.import_module("optiland.materials").MaterialFile(str(path))
        # A wavelength at the end of the data stays within them, whatever its digits.
        wavelengths = _CATALOGUE[(self.low - 1e-6 <= _CATALOGUE) & (self.high + 1e-6 >= _CATALOGUE)].tolist()
        refuse_if(len(wavelengths) < 2, f"glass {name}: its data reach from {self.low:g} to {self.high:g} nm only")
        indices = [float(np.ravel(material.n(wavelength * 1e-3))[0]) for wavelength in wavelengths]
        pairs = [value for pair in zip(wavelengths, indices, strict=True) for value in pair]
        return Glass("table", tuple(pairs), name)


# A list of files that are installed; reading it takes long, and every glass by name needs it.
@functools.cache
def _catalogued() -> tuple[_Entry, ...]:
    """Return all materials of Optiland's catalogues.

    They are searched here, since Optiland itself finds N-SF5 by the name SF5, and similar names.
    """
    text = (resources.files("optiland.database") / "catalog_nk.csv").read_text(encoding="utf-8")
    entries = {}
    for row in csv.DictReader(text.splitlines()):
        file = row["filename"]
        maker = file.split("/")[1]
        name = row["filename_no_ext"]
        low, high = (1e3 * float(row[f"{end}_wavelength"] or "nan") for end in ("min", "max"))
        entries[file] = _Entry(maker, name, file, low, high)
    return tuple(entries.values())


def known_glass(name: str, value: Any) -> Glass | None:
    """Return the glass of a lens from any of its forms; it must have a refractive index at the d line (587.6 nm)."""
    if value is None:
        return None
    glass = value if isinstance(value, Glass) else Glass.from_plain(value, name)
    with naming(name):
        glass.focal_ratio(LINE_D)
    return glass
