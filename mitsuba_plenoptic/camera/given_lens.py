"""Conversion of the main lens and glasses of a camera from any of the forms in which they can be given."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import naming
from ..prescription import Glass
from ..prescription.glass import LINE_D
from ..prescription.lens_data import LensData
from ..prescription.lens_file import lens_from_plain, read_lens


def known_lens(value: LensData | str | Path | dict[str, Any] | None) -> LensData | None:
    """Return the data of a main lens, given in any of its forms; None means a thin lens."""
    if value is None or isinstance(value, LensData):
        return value
    return read_lens(value) if isinstance(value, (str, Path)) else lens_from_plain(value)


def known_glass(name: str, value: Any) -> Glass | None:
    """Return a lens's glass, given in any of its forms; refuse a glass that does not refract light of the line d."""
    if value is None:
        return None
    glass = value if isinstance(value, Glass) else Glass.from_plain(value, name)
    with naming(name):
        glass.focal_ratio(LINE_D)
    return glass
