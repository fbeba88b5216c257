"""Reading plugin parameters with the checks that Mitsuba leaves out."""

from __future__ import annotations

from typing import Any

from ..errors import InputError, require_choice, require_count, require_number


def read_plain(props: Any, name: str, default: Any) -> Any:
    """Take a value from a plugin's properties, to be checked by whom it is for."""
    return _plain(props[name]) if name in props else default


def read_number(props: Any, plugin: str, name: str, default: float | None) -> float | None:
    """Take a positive, finite number from a plugin's properties.

    Mitsuba refuses misspelled names by itself, but it takes values of any type.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    if name not in props:
        return default
    return require_number(f"{plugin}: {name}", _plain(props[name]), positive=True, finite=name != "focus_distance")


def read_numbers(props: Any, plugin: str, name: str) -> tuple[float, ...] | None:
    """Take one or more finite numbers from a plugin's properties, or None if they are not given.

    They come as a number, as a point, vector or list, or as a string with commas between them.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    if name not in props:
        return None
    value = _plain(props[name])
    if isinstance(value, str):
        try:
            value = [float(part) for part in value.split(",")]
        except ValueError:
            raise InputError(
                f"{plugin}: {name} = {value!r}: it must be a number, or several with commas between them"
            ) from None
    elif not hasattr(value, "__len__"):
        value = [value]
    return tuple(require_number(f"{plugin}: {name}", _plain(number)) for number in value)


def read_count(props: Any, plugin: str, name: str, default: int, *, maximum: int | None = None) -> int:
    """Take a whole number of at least 1 from a plugin's properties.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    return require_count(f"{plugin}: {name}", props[name], maximum=maximum) if name in props else default


def read_choice(props: Any, plugin: str, name: str, choices: tuple[str, ...]) -> str:
    """Take one of several words from a plugin's properties; the first is the default.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    return require_choice(f"{plugin}: {name}", props[name] if name in props else choices[0], choices)


def _plain(value: Any) -> Any:
    """Turn a Dr.Jit array of one entry, as ``load_dict`` accepts it, into its entry."""
    return value[0] if hasattr(value, "__len__") and not isinstance(value, str) and len(value) == 1 else value
