"""The one exception for a user's mistake, and the checks of plain numbers that raise it."""

from __future__ import annotations

import math
from typing import Any


class InputError(ValueError):
    """A user's mistake, told in one line that names the thing, its value and the rule."""


def require_number(
    name: str, value: Any, *, minimum: float | None = None, positive: bool = False, finite: bool = True
) -> float:
    """Return `value` as a float, or say in one line what is wrong with it.

    Parameters
    ----------
    name : str
        What the message calls the number.
    value : Any
        What the user gave. Booleans and strings are refused, not converted.
    minimum : float, optional
        Smallest allowed value.
    positive : bool
        Whether the number must be greater than zero.
    finite : bool
        Whether infinity is refused. NaN always is.

    Raises
    ------
    InputError
        If the value is not a number or breaks a rule.
    """
    if isinstance(value, (bool, str, bytes)) or value is None:
        raise InputError(f"{name} = {value!r}: it must be a number")
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} = {value!r}: it must be a number") from None
    if math.isnan(number) or (finite and math.isinf(number)):
        raise InputError(f"{name} = {number:g}: it must be finite")
    if positive and number <= 0:
        raise InputError(f"{name} = {number:g}: it must be greater than 0")
    if minimum is not None and number < minimum:
        raise InputError(f"{name} = {number:g}: it must be at least {minimum:g}")
    return number


def require_count(name: str, value: Any, *, minimum: int = 1, maximum: int | None = None) -> int:
    """Return `value` as an int within bounds, or say in one line what is wrong with it.

    Raises
    ------
    InputError
        If the value is not a whole number or out of bounds.
    """
    number = require_number(name, value)
    if number != int(number):
        raise InputError(f"{name} = {value!r}: it must be a whole number")
    if number < minimum:
        raise InputError(f"{name} = {int(number)}: it must be at least {minimum}")
    if maximum is not None and number > maximum:
        raise InputError(f"{name} = {int(number)}: it must be at most {maximum}")
    return int(number)
