"""The registry of cases: what each measures, its options, its limits, and the page that shows its table."""

from __future__ import annotations

import ast
import difflib
import importlib
import inspect
import math
import pkgutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from mitsuba_plenoptic import InputError

from .tables import Columns, Pivot

Row = dict[str, Any]
Function = TypeVar("Function", bound=Callable[..., Iterable[Row]])
Value = TypeVar("Value")

CASES: dict[str, Case] = {}


@dataclass(frozen=True)
class Limit:
    """A bound on a figure of each row: a number, or the name of the column that states it.

    Rows without the figure or the bound are not judged. NaN never passes.
    """

    figure: str
    bound: float | str
    least: bool = False
    digits: int | None = None
    """Decimals to which a figure is rounded before it is compared."""

    def judge(self, row: Row) -> bool | None:
        """Return whether a row is within the limit, None where the limit does not apply."""
        value, bound = row.get(self.figure), row.get(self.bound) if isinstance(self.bound, str) else self.bound
        if value is None or bound is None:
            return None
        if not math.isfinite(bound):
            raise ValueError(f"limit of {self.figure}: {bound} can never be exceeded")
        value = value if self.digits is None else round(value, self.digits)
        return bool(value >= bound if self.least else value <= bound)

    def broken(self, row: Row) -> str:
        """Return what is wrong with a row beyond the limit."""
        bound = row[self.bound] if isinstance(self.bound, str) else self.bound
        return f"{self.figure} {row[self.figure]:.4g}, {'at least' if self.least else 'at most'} {bound:.4g}"


def at_most(figure: str, bound: float | str) -> Limit:
    """Return the limit of a figure that must not be larger."""
    return Limit(figure, bound)


def at_least(figure: str, bound: float | str, digits: int | None = None) -> Limit:
    """Return the limit of a figure that must not be smaller."""
    return Limit(figure, bound, least=True, digits=digits)


FIGURES: Columns = {"what": "{what}", "figure": "{figure:.4g} {unit}", "limit": "{limit}"}
FIGURE_LIMITS = (at_most("figure", "at_most"), at_least("figure", "at_least"))


def figure(
    what: str, value: float, *, at_most: float | None = None, at_least: float | None = None, unit: str = ""
) -> Row:
    """Return a row with one figure and its limit, for cases whose table is a list of figures."""
    limit = "" if at_most is at_least is None else f"<= {at_most:g}" if at_most is not None else f">= {at_least:g}"
    return {
        "what": what, "figure": float(value), "unit": unit, "limit": limit, "at_most": at_most, "at_least": at_least
    }  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A registered measurement."""

    name: str
    what: str
    function: Callable[..., Iterable[Row]]
    columns: Columns
    limits: tuple[Limit, ...]
    page: str | None
    pivot: Pivot | None
    quick: Mapping[str, Any]
    variant: str
    needs: tuple[str, ...]
    defaults: Mapping[str, Any] = field(init=False)

    def __post_init__(self) -> None:
        parameters = inspect.signature(self.function).parameters
        defaults = {name: each.default for name, each in parameters.items() if name != "output"}
        object.__setattr__(self, "defaults", defaults)
        if unknown := set(self.quick) - set(defaults):
            raise ValueError(f"{self.name}: quick sets {sorted(unknown)}, which are no options")

    @property
    def writes_files(self) -> bool:
        """Whether the case takes the folder for its pictures and intermediate results."""
        return "output" in inspect.signature(self.function).parameters

    def verdict(self, row: Row) -> str:
        """Return "ok", what is beyond its limit, or nothing where no limit applies."""
        judged = [(limit, passed) for limit in self.limits if (passed := limit.judge(row)) is not None]
        broken = [limit.broken(row) for limit, passed in judged if not passed]
        return "FAILED: " + "; ".join(broken) if broken else "ok" if judged else ""


def case(
    name: str,
    what: str,
    columns: Columns = FIGURES,
    limits: tuple[Limit, ...] | None = None,
    *,
    page: str | None = None,
    pivot: Pivot | None = None,
    quick: Mapping[str, Any] | None = None,
    variant: str = "llvm_ad_mono",
    needs: tuple[str, ...] = (),
) -> Callable[[Function], Function]:
    """Register a function that yields rows as a case.

    Its keyword arguments, which all have defaults, are the options of the command line; an argument ``output`` is the
    folder for its files. ``columns`` are the headings of its table with a format each, ``limits`` bound its figures,
    ``page`` shows its table, laid out by ``pivot`` if given. ``quick`` are the options of a small run, ``needs``
    the packages without which it cannot run.
    """
    chosen = (FIGURE_LIMITS if columns is FIGURES else ()) if limits is None else limits

    def register(function: Function) -> Function:
        if name in CASES:
            raise ValueError(f"{name}: registered twice")
        CASES[name] = Case(name, what, function, columns, chosen, page, pivot, quick or {}, variant, needs)
        return function

    return register


def load() -> dict[str, Case]:
    """Import all modules with cases, and return the cases by name."""
    from . import cases

    for module in pkgutil.iter_modules(cases.__path__):
        importlib.import_module(f"{cases.__name__}.{module.name}")
    return dict(sorted(CASES.items()))


def find(names: Iterable[str]) -> list[Case]:
    """Return the cases of these names; a name also stands for all cases that begin with it and a dot."""
    cases, found = load(), []
    for name in names:
        mine = [each for each in cases.values() if each.name == name or each.name.startswith(name + ".")]
        if not mine:
            raise InputError(f"{name}: no such case{_similar(name, cases)}; `list` names all")
        found += [each for each in mine if each not in found]
    return found


def options(cases: list[Case], words: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return the options that words such as ``spp=16`` set, for each case that has them; one of them must.

    Lists are separated by commas; those without entries by default hold names.
    """
    found: dict[str, dict[str, Any]] = {each.name: {} for each in cases}
    for word in words:
        name, _, text = word.partition("=")
        owners = [each for each in cases if name in each.defaults]
        if not owners:
            known = sorted({known for each in cases for known in each.defaults})
            raise InputError(f"{name}: no option of {', '.join(found)}{_similar(name, known)}; known: {known}")
        for owner in owners:
            found[owner.name][name] = _parsed(name, text, owner.defaults[name])
    return found


def pick(known: Mapping[str, Value], names: Iterable[str]) -> dict[str, Value]:
    """Return the named entries, all where none is named; a part of a name stands for all that contain it."""
    chosen: dict[str, Value] = {} if (names := list(names)) else dict(known)
    for name in names:
        mine = [name] if name in known else [each for each in known if name in each]
        if not mine:
            raise InputError(f"{name}: unknown{_similar(name, known)}; known: {'; '.join(known)}")
        chosen |= {each: known[each] for each in mine}
    return chosen


def _similar(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), 1)
    return f", did you mean {close[0]}?" if close else ""


def _parsed(name: str, text: str, default: Any) -> Any:
    if isinstance(default, tuple):
        return tuple(_parsed(name, part, default[0] if default else "") for part in text.split(",") if part)
    try:
        value = float(text) if text.lstrip("-") == "inf" else ast.literal_eval(text)
    except (ValueError, SyntaxError):
        value = text
    if isinstance(default, float) and type(value) is int:
        value = float(value)
    if default is not None and type(value) is not type(default):
        if isinstance(default, str):
            return text
        raise InputError(f"{name}={text}: must be of the type of {default!r}")
    return value
