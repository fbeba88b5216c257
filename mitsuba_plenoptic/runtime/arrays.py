"""The reader of all arrays that users give: what a plain array of numbers would lose is followed or refused."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..errors import NO_ARRAY, InputError, refuse_if, refusing, short_repr

Names = tuple[str, ...]

IMAGE = ("y t row rows", "x s column columns", "c channel channels band")
POINTS = ("point particle", "axis channel wavelength")
"""Names of the dimensions of images, and of points and their weights, those of one meaning together."""

MILLIMETRES = "mm", "millimeter", "millimetre", "millimeters", "millimetres"
"""Names of the unit of lengths."""

BRIGHTEST = 1e30
"""Magnitude of a pixel at most: what is summed and squared of it stays within single precision's 3e38."""


def as_array(
    name: str, values: Any, dtype: Any = None, dims: Names = IMAGE, *, rule: str = "", units: Names | None = None
) -> np.ndarray:
    """Return a new array of numbers, real ones but for a complex type; refuse masked ones, and other units than named.

    Labelled arrays, of which `dims` lists the names in order, are transposed; they may state any unit without `units`.
    """
    unit = "" if units is None and hasattr(values, "attrs") else unit_of(values)
    plain = f"give plain numbers{f' in {units[0]}' if units else ''}"
    refuse_if(unit not in ("", "1", "dimensionless", *(units or ())), f"{name} in {short_repr(unit)}: {plain}")
    masked = np.count_nonzero(values.mask) if isinstance(values, np.ma.MaskedArray) else 0
    refuse_if(masked, f"{name}: {masked} of its values are masked: give an array without a mask")
    if isinstance(values, (list, tuple)):
        # NumPy would drop masks, units and names of arrays in a list.
        arrays = (hasattr(each, "__array__") and not isinstance(each, np.generic) for each in values)
        values = [
            as_array(name, each, None, dims[1:], rule=rule, units=units) if one else each
            for each, one in zip(values, arrays, strict=True)
        ]
    named = getattr(values, "dims", None)
    if isinstance(named, tuple) and len(named) > 1 and named != tuple(f"dim_{index}" for index in range(len(named))):
        order = [each for known in dims for each in named if each in known.split()]
        known = ", ".join(each.split()[0] for each in dims)
        refuse_if(len(order) != len(named), f"{name} with dimensions {named}: they must be {known}")
        values = values.transpose(*order)
    rule = f"{name}: {rule or 'it must be an array'}"
    with refusing(rule, RuntimeError, *NO_ARRAY):
        array = np.array(values)
    refuse_if(array.dtype.kind not in "biufc", rule)
    real = array.dtype.kind != "c" or np.dtype(dtype or float).kind == "c"
    refuse_if(not real, f"{name} of type {array.dtype}: it must hold real numbers")
    return array.astype(dtype or array.dtype, copy=False)


def unit_of(values: Any) -> str:
    """Return the unit that a labelled array, or a quantity of another library, states; empty if it states none."""
    if hasattr(values, "attrs"):
        return str(values.attrs.get("units", ""))
    stated = getattr(values, "unit", getattr(values, "units", None))
    return "" if stated is None else str(stated)


def require_units(name: str, data: Any, known: Mapping[str, Names]) -> None:
    """Refuse labelled data that states another unit of a variable than one of those named."""
    for part, units in known.items():
        unit = unit_of(data[part])
        refuse_if(unit not in ("", *units), f"{name}: {part} is in {unit}: it must be in {units[0]}")


def as_pixels(name: str, values: Any, dtype: Any = None) -> np.ndarray:
    """Return a new array of the pixels of an image, which are finite and not too large."""
    image = as_array(name, values)
    require_pixels(name, image)
    return image.astype(dtype or image.dtype, copy=False)


def require_pixels(name: str, image: np.ndarray) -> None:
    """Refuse an image with pixels that are not finite or above `BRIGHTEST`, and name their number and the first one."""
    # The largest and the smallest value show every NaN too, and cost far less than a test of each.
    if image.size == 0 or max(float(image.max()), -float(image.min())) <= BRIGHTEST:
        return
    bad, what, rule = ~np.isfinite(image), "NaN or infinite", "finite"
    if not bad.any():
        bad, what, rule = np.abs(np.float64(image)) > BRIGHTEST, "too large", f"{BRIGHTEST:g} at most in magnitude"
    first = ", ".join(str(index) for index in np.argwhere(bad)[0])
    raise InputError(f"{name}: {bad.sum()} of its pixels are {what}, the first at ({first}): all must be {rule}")
