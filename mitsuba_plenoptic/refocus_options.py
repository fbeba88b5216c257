"""Options of single reconstruction methods; each is declared once, as a field of the options of its method.

The signature and docstring of `mitsuba_plenoptic.reconstruct`, its checks, and the options of ``mitsuba-plenoptic
reconstruct`` with their help follow from these fields, and from those that extensions name under ``options``. Help
reads this module, which imports no library.
"""

import functools
import inspect
import operator
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, TypedDict, TypeVar, get_args, get_type_hints

from .errors import InputError, require_count, short_repr
from .extension import entries, place

Footprint = Literal["lens", "point"]

FOOTPRINTS: tuple[Footprint, ...] = get_args(Footprint)

_Call = TypeVar("_Call", bound=Callable)


@dataclass(frozen=True)
class Option:
    """Properties of an option of a method, such as its default and its text."""

    # What it is, for the help and the docstring alike.
    text: str
    # What the docstring adds.
    details: str = ""
    # What methods get where it is not given, and that in words where the value does not say it.
    default: Any = None
    shown: str = ""
    # From name, value and the lenses along an axis to what methods get. Default: a choice, a flag, or a count.
    check: Callable[[str, object, int], object] | None = None
    # What the help shows for the value, where it is neither a choice nor a number.
    metavar: str = ""
    # Whether the help lists it among the options of waves, instead of those for experts.
    waves: bool = False
    # The types of its values, which its annotation states.
    types: tuple = ()

    @property
    def choices(self) -> tuple[str, ...]:
        """The words that it may be, if its type is a `Literal`."""
        return get_args(self.types[0])

    @property
    def shown_default(self) -> str:
        """The default in words."""
        return self.shown or str(self.default)


def _require_interleave(name: str, value: object, lenses: int) -> int | str:
    """Return the period of the lens subsets, or ``"auto"``; refuse other values."""
    if isinstance(value, str) and value == "auto":
        return value
    try:
        return require_count(name, value, maximum=lenses)
    except InputError:
        rule = f"it must be 'auto' or a whole number from 1 to {lenses}, the lenses along an axis"
        raise InputError(f"{name} = {short_repr(value)}: {rule}") from None


class RayOptions(TypedDict, total=False):
    """Options of the method ``ray``; None is the default, here and below."""

    footprint: Annotated[
        Footprint | None, Option("spread a pixel over what its lens sees, or put it into one bin.", default="lens")
    ]


class CoherentOptions(TypedDict, total=False):
    """Options of the method ``coherent``."""

    relay: Annotated[
        bool | None,
        Option(
            "whether the microlenses act again on the way back, as they should.",
            "Without, which is the literal reading of the paper, planes out of focus stay blurred: see "
            "`mitsuba_plenoptic.refocus.wave_methods`.",
            default=True,
            waves=True,
        ),
    ]


class PartialOptions(CoherentOptions, total=False):
    """Options of the method ``partial``."""

    interleave: Annotated[
        int | str | None,
        Option(
            "every K-th lens along both axes shares a wave; auto lets no two lenses interfere.",
            "2 makes four waves, 1 is ``coherent``. The last bits of ``auto`` depend on the thread count of the BLAS.",
            default=2,
            check=_require_interleave,
            metavar="K|auto",
            waves=True,
        ),
    ]


_CORE: dict[str, type] = {"ray": RayOptions, "coherent": CoherentOptions, "partial": PartialOptions}


def method_names() -> tuple[str, ...]:
    """Return the names of the methods of the core and of the installed extensions, without importing the methods."""
    return tuple(dict.fromkeys((*_CORE, *(name for _, name, _ in entries("methods")))))


@functools.cache
def options_of_methods() -> dict[str, dict[str, Option]]:
    """Return the options of each method that has some, by name."""
    options = {}
    for method, fields in (_CORE | {name: place(package, text) for package, name, text in entries("options")}).items():
        hints = {name: get_args(hint) for name, hint in get_type_hints(fields, include_extras=True).items()}
        options[method] = {name: replace(option, types=get_args(kind)[:-1]) for name, (kind, option) in hints.items()}
    return options


@functools.cache
def all_options() -> dict[str, Option]:
    """Return the options of all methods by name; their texts begin with the methods that have them."""
    methods: dict[str, dict[Option, list[str]]] = {}
    for method, options in options_of_methods().items():
        for name, option in options.items():
            methods.setdefault(name, {}).setdefault(option, []).append(method)
    return {
        name: replace(
            next(iter(records)),
            text=" ".join(f"For {' and '.join(takers)}: {option.text}" for option, takers in records.items()),
        )
        for name, records in methods.items()
    }


def with_parameters(function: _Call, parameters: dict[str, Any]) -> _Call:
    """Return a function of ``**options`` with a signature that names them; `parameters` has their annotations.

    A parameter that is a `bool` is False where it is not given, others are None.
    """
    signature = inspect.signature(function, eval_str=True)
    parameters_of_function = [
        item for item in signature.parameters.values() if item.kind is not inspect.Parameter.VAR_KEYWORD
    ]
    added = [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            # `Annotated` has its type as its origin; a flag that may be None has a default of the method.
            default=False if getattr(kind, "__origin__", kind) is bool else None,
            annotation=kind,
        )
        for name, kind in parameters.items()
    ]
    named: Any = function
    named.__signature__ = signature.replace(parameters=[*parameters_of_function, *added])
    named.__annotations__ = {item.name: item.annotation for item in (*parameters_of_function, *added)}
    return function


def with_options(function: _Call) -> _Call:
    """Return `reconstruct` with the options of single methods in its signature and docstring."""
    text = ""
    for name, option in all_options().items():
        words = " or ".join([repr(word) for word in option.choices] or [item.__name__ for item in option.types])
        described = " ".join(filter(None, (option.text, option.details, f"Default: {option.shown_default}.")))
        text += f"{name} : {words}, optional\n{textwrap.indent(textwrap.fill(described, 110), '    ')}\n"
    head, _, tail = (function.__doc__ or "").partition("    **options\n")
    function.__doc__ = head + textwrap.indent(text, "    ") + tail.partition("\n")[2]
    kinds = {name: functools.reduce(operator.or_, (*option.types, None)) for name, option in all_options().items()}
    return with_parameters(function, kinds)
