"""The main lens and the glasses that a camera is given, in any of their forms, and what these bring with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import InputError
from ..io.lens_file import lens_from_plain, read_lens
from ..lens_data import LensData
from ..prescription import Glass
from ..prescription.glass import LINE_D


def known_lens(value: LensData | str | Path | dict[str, Any] | None) -> LensData | None:
    """Return the main lens that is given in any of its forms, None for a thin one."""
    if value is None or isinstance(value, LensData):
        return value
    return read_lens(value) if isinstance(value, (str, Path)) else lens_from_plain(value)


def known_glass(name: str, value: Any) -> Glass | None:
    """Return a lens's glass that is given in any of its forms, one that bends light of the line d."""
    if value is None:
        return None
    glass = value if isinstance(value, Glass) else Glass.from_plain(value, name)
    try:
        glass.focal_ratio(LINE_D)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return glass
