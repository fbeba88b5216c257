"""The reader of all arrays that users give: what a plain array of numbers would lose is followed or refused."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import NO_ARRAY, refuse_if, refusing, short_repr

IMAGE = ("y t row rows", "x s column columns", "c channel channels band")
"""Names of the dimensions of an image, those of one meaning together."""

MILLIMETRES = "mm", "millimeter", "millimetre", "millimeters", "millimetres"
"""Names of the unit of lengths."""

POINTS = ("point particle", "axis channel wavelength")
"""Names of the dimensions of points and of their weights."""


def as_array(
    name: str,
    values: Any,
    dtype: Any = None,
    dims: tuple[str, ...] = IMAGE,
    *,
    kinds: str = "fiu",
    rule: str = "it must be an array",
    units: tuple[str, ...] | None = None,
) -> np.ndarray:
    """Return a new array of real numbers; refuse other kinds of numbers, masked ones, and units other than those named.

    Labelled arrays, of which `dims` lists the names in order, are transposed. Labels may state any unit where `units`
    is None.
    """
    stated = "" if units is None and hasattr(values, "attrs") else unit_of(values)
    refuse_if(
        stated not in ("", "1", "dimensionless", *(units or ())),
        f"{name} in {short_repr(stated)}: give plain numbers{f' in {units[0]}' if units else ''}",
    )
    masked = np.ma.count_masked(values) if isinstance(values, np.ma.MaskedArray) else 0
    refuse_if(masked, f"{name}: {masked} of its values are masked: give an array without a mask")
    if isinstance(values, (list, tuple)):
        # NumPy would drop masks, units and names of arrays in a list.
        values = [
            as_array(name, each, None, dims[1:], kinds=kinds, rule=rule, units=units)
            if hasattr(each, "__array__") and not isinstance(each, np.generic)
            else each
            for each in values
        ]
    named = getattr(values, "dims", None)
    if isinstance(named, tuple) and len(named) > 1 and named != tuple(f"dim_{index}" for index in range(len(named))):
        order = [each for known in dims for each in named if each in known.split()]
        rest = ", ".join(known.split()[0] for known in dims)
        refuse_if(sorted(order) != sorted(map(str, named)), f"{name} with dimensions {named}: they must be {rest}")
        values = values.transpose(*order)
    with refusing(f"{name}: {rule}", RuntimeError, *NO_ARRAY):
        array = np.array(values)
    of_type = f"{name} of type {array.dtype}: it must hold real numbers"
    refuse_if(array.dtype.kind not in kinds, of_type if array.dtype.kind in "biufc" else f"{name}: {rule}")
    return array.astype(dtype or array.dtype, copy=False)


def unit_of(values: Any) -> str:
    """Return the unit that a labelled array, or a quantity of another library, states; empty if it states none."""
    if hasattr(values, "attrs"):
        return str(values.attrs.get("units", ""))
    stated = getattr(values, "unit", getattr(values, "units", None))
    return "" if stated is None else str(stated)


def require_units(name: str, data: Any, known: Mapping[str, tuple[str, ...]]) -> None:
    """Refuse labelled data that states another unit of a variable than one of those named."""
    for part, units in known.items():
        unit = unit_of(data[part])
        refuse_if(unit not in ("", *units), f"{name}: {part} is in {unit}: it must be in {units[0]}")
