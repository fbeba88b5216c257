"""The one exception for a user's mistake, and the checks that raise it.

Every ``require_...`` returns what it was given, as the type that it should be, or raises an `InputError` that names the
thing, its value and the rule.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import inspect
import math
import reprlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any, TypeVar, cast

import numpy as np

_Call = TypeVar("_Call", bound=Callable[..., Any])

_LONGEST = 1000
"""Characters of a message; names and values that come from files may be of any length."""

_LONGEST_VALUE = 80

# A list that holds itself many times over, as YAML can write it, would be endless in full.
_SHORT = reprlib.Repr()
_SHORT.maxlevel = 3
_SHORT.maxlist = _SHORT.maxtuple = 12
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = _LONGEST_VALUE - 4


class InputError(ValueError):
    """A user's mistake, described in one line that names the thing, its value and the rule.

    Whatever files and arguments put into the message, it stays one line of printable characters.
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message, _LONGEST))


def refuse_if(broken: object, message: str) -> None:
    """Raise an `InputError` where a rule is broken; the message is made in any case, so it must be quick to make."""
    if broken:
        raise InputError(message)


@contextlib.contextmanager
def naming(thing: object) -> Iterator[None]:
    """Begin the message of an `InputError` with the thing that it is about, such as the path of a file."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{thing}: {error}") from None


def printable(text: str, longest: int | None = None) -> str:
    """Make one line that no terminal acts on: white space becomes a space, other control characters escapes."""
    if longest is not None and len(text) > longest:
        text = f"{text[: longest - 3]}..."
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() else " " if c.isspace() else c.encode("unicode_escape", "surrogatepass").decode()
        for c in text
    )


def short_repr(value: Any) -> str:
    """Show a value in a message: its representation, shortened."""
    try:
        text = _SHORT.repr(value)
    except Exception as error:  # such as an int of more digits than Python prints
        text = f"{type(value).__name__} ({error})"
    return printable(" ".join(text.split()), _LONGEST_VALUE)


_options: Mapping[str, str] | None = None
"""Options by the names of the library's arguments that they are for; None in Python."""


@contextlib.contextmanager
def at_shell(options: Mapping[str, str]) -> Iterator[None]:
    """Have advice name options of the command line; `options` has those that are not called as their arguments."""
    global _options
    before, _options = _options, options
    try:
        yield
    finally:
        _options = before


def advice(*, python: str, shell: str) -> str:
    """Return the advice that suits where the user is."""
    return python if _options is None else shell


def argument(name: str) -> str:
    """Name an argument in advice: as it is in Python, as the option that it belongs to at a shell."""
    return advice(python=name, shell=(_options or {}).get(name, f"--{name.replace('_', '-')}"))


def did_you_mean(name: Any, known: Iterable[Any]) -> str:
    """Return the end of a message on an unknown name: the known one that it resembles, or nothing if none does."""
    names = {str(one).lower(): str(one) for one in known}
    found = difflib.get_close_matches(str(name).lower()[:_LONGEST_VALUE], names, n=1)
    return f"; did you mean {names[found[0]]}?" if found else ""


def suggest_keywords(function: _Call, others: Iterable[str] = ()) -> _Call:
    """Have a call with an unknown keyword name the one that it resembles, as Python itself does from 3.13 on.

    A function that hands further keywords on knows the `others`. Of a class it is the constructor.
    """
    if isinstance(function, type):
        constructor = function.__init__  # type: ignore[misc]
        type.__setattr__(function, "__init__", suggest_keywords(constructor, others))
        return cast(_Call, function)
    known = {*inspect.signature(function).parameters, *others}

    @functools.wraps(function)
    def called(*arguments: Any, **options: Any) -> Any:
        for name in options:
            if name not in known:
                raise TypeError(
                    f"{function.__qualname__.removesuffix('.__init__')}() got an unexpected keyword argument '{name}'"
                    f"{did_you_mean(name, known)}"
                )
        return function(*arguments, **options)

    return cast(_Call, called)


def require_number(
    name: str,
    value: Any,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    positive: bool = False,
    finite: bool = True,
) -> float:
    """Return `value` as a float."""
    if isinstance(value, (bool, np.bool_, str, bytes, bytearray)) or value is None:
        raise InputError(f"{name} = {short_repr(value)}: it must be a number")
    try:
        number = float(value)
    except OverflowError:
        raise InputError(f"{name} = {short_repr(value)}: it must be finite") from None
    except (TypeError, ValueError):
        raise InputError(f"{name} = {short_repr(value)}: it must be a number") from None
    if math.isnan(number) or (finite and math.isinf(number)):
        raise InputError(f"{name} = {number:g}: it must be finite")
    if positive and number <= 0:
        raise InputError(f"{name} = {number:g}: it must be greater than 0")
    if minimum is not None and number < minimum:
        raise InputError(f"{name} = {number:g}: it must be at least {minimum:g}")
    if maximum is not None and maximum < number < math.inf:
        raise InputError(f"{name} = {number:g}: it must be at most {maximum:g}")
    return number


def require_choice(name: str, value: Any, choices: Collection[str]) -> str:
    """Return a word that is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        rule = f"it must be one of {', '.join(choices)}"
        raise InputError(f"{name} = {short_repr(value)}: {rule}{did_you_mean(value, choices)}")
    return value


def require_known(what: str, names: Iterable[Any], known: Collection[str]) -> None:
    """Refuse the first name that is not among the known ones; `what` begins the message, such as ``camera: ``."""
    for name in names:
        if name not in known:
            raise InputError(f"{what}{name}: it is not one of {', '.join(known)}{did_you_mean(name, known)}")


def require_pair(name: str, value: Any, meaning: str) -> tuple[Any, Any]:
    """Return the two entries of a pair, to be checked by whom they are for."""
    try:
        first, second = value
    except (TypeError, ValueError):
        raise InputError(f"{name} = {short_repr(value)}: it must be a pair {meaning}") from None
    return first, second


def require_flag(name: str, value: Any) -> bool:
    """Return a truth value as a bool; a word such as "no", which Python takes for true, is refused."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{name} = {short_repr(value)}: it must be True or False")
    return bool(value)


def require_count(name: str, value: Any, *, minimum: int = 1, maximum: int | None = None) -> int:
    """Return an integer within bounds as an int."""
    number = require_number(name, value)
    if number != int(number):
        raise InputError(f"{name} = {short_repr(value)}: it must be a whole number")
    if number < minimum:
        raise InputError(f"{name} = {short_repr(int(number))}: it must be at least {minimum}")
    if maximum is not None and number > maximum:
        raise InputError(f"{name} = {short_repr(int(number))}: it must be at most {maximum}")
    return int(number)
