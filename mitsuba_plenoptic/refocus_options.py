"""Options of single methods of reconstruction: a field of `MethodOptions` is all that there is to write of one.

The signature and docstring of `mitsuba_plenoptic.reconstruct`, its checks, the options of ``mitsuba-plenoptic
reconstruct`` with their help, and the keys of run files follow. Help reads this module, which imports no library.
"""

from __future__ import annotations

import functools
import inspect
import operator
import textwrap
import types
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypedDict, TypeVar, get_args, get_type_hints

from .errors import InputError, require_choice, require_count, require_flag, require_number, short_repr

METHODS = ("ray", "coherent", "partial", "incoherent", "deconvolved")
FOOTPRINTS = ("lens", "point")
RESPONSES = ("wave", "ray")

MOST_VARIATION = 0.25
"""Largest weight of the total variation: steps stay positive, as its gradient is at most 3.42."""

_Call = TypeVar("_Call", bound=Callable[..., Any])


@dataclass(frozen=True)
class Option:
    """What is known of an option beside its name.

    Attributes
    ----------
    methods : tuple of str
        The methods that use it.
    text : str
        What it is, for the help and the docstring alike.
    default : Any
        What methods get where it is not given.
    shown : str
        The default in words, where its value does not say it.
    check : callable, optional
        From name, value and capture to the value that methods get. Default: one of the choices, a flag, or a count.
    choices : tuple of str
        The words that it may be.
    metavar : str
        What the help shows for its value, where neither choices nor a number do.
    waves : bool
        Whether the help lists it among the options of waves, instead of those for experts.
    details : str
        What the docstring adds.
    types : tuple of types
        The types of its values; of the field's annotation.
    """

    methods: tuple[str, ...]
    text: str
    default: Any = None
    shown: str = ""
    check: Callable[[str, Any, Any], Any] | None = None
    choices: tuple[str, ...] = ()
    metavar: str = ""
    waves: bool = False
    details: str = ""
    types: tuple[type, ...] = ()

    def checked(self, name: str, value: Any, capture: Any) -> Any:
        """Return the value that methods get: the default where none is given."""
        if value is None:
            return self.default
        if self.check:
            return self.check(name, value, capture)
        if self.choices:
            return require_choice(name, value, self.choices)
        return require_flag(name, value) if bool in self.types else require_count(name, value)

    @property
    def label(self) -> str:
        """The methods that use it, as the texts begin."""
        return f"For {' and '.join(self.methods)}: {self.text}"

    @property
    def shown_default(self) -> str:
        """The default as help and docstring show it."""
        return self.shown or str(self.default)


def _require_interleave(name: str, value: Any, capture: Any) -> int | str:
    """Return the period of the subsets of lenses, or ``"auto"``."""
    if isinstance(value, str) and value == "auto":
        return value
    lenses = max(capture.camera.lens_count)
    try:
        return require_count(name, value, maximum=lenses)
    except InputError:
        raise InputError(
            f"{name} = {short_repr(value)}: it must be 'auto' or a whole number from 1 to {lenses}, the lenses along "
            "an axis"
        ) from None


class MethodOptions(TypedDict, total=False):
    """Options of `mitsuba_plenoptic.reconstruct` that single methods use; None is the default."""

    interleave: Annotated[
        int | str | None,
        Option(
            ("partial",),
            "every K-th lens along both axes shares a wave; auto lets no two lenses interfere.",
            default=2,
            check=_require_interleave,
            metavar="K|auto",
            waves=True,
            details="2 makes four waves, 1 is ``coherent``. The last bits of ``auto`` depend on the thread count of "
            "the BLAS.",
        ),
    ]
    footprint: Annotated[
        str | None,
        Option(
            ("ray",),
            "spread a pixel over what its lens sees, or put it into one bin.",
            default="lens",
            choices=FOOTPRINTS,
        ),
    ]
    relay: Annotated[
        bool | None,
        Option(
            ("coherent", "partial"),
            "whether the microlenses act again on the way back, as they should.",
            default=True,
            waves=True,
            details="Without, which is the literal reading of the paper, planes out of focus stay blurred: see "
            "`mitsuba_plenoptic.refocus.wave_methods`.",
        ),
    ]
    response: Annotated[
        str | None,
        Option(
            ("deconvolved",),
            "how light goes through the camera.",
            shown="as the capture was made",
            choices=RESPONSES,
            details="With a `wavelength` it is ``wave``.",
        ),
    ]
    iterations: Annotated[
        int | None,
        Option(
            ("deconvolved",),
            "steps.",
            shown="until only noise is left, where a capture states its exposure; else 30",
            details="With a known noise, from `photons` or from metadata of `expose`, there are at most 100.",
        ),
    ]
    accelerate: Annotated[
        bool | None,
        Option(
            ("deconvolved",),
            "whether each step starts from an extrapolated point.",
            default=True,
            details="One step then does the work of several.",
        ),
    ]
    photons: Annotated[
        float | None,
        Option(
            ("deconvolved",),
            "photons that a pixel of value 1 has counted.",
            shown="those that 'expose' recorded",
            check=lambda name, value, _: require_number(name, value, positive=True),
            details="Photon noise is then the only noise.",
        ),
    ]
    volume: Annotated[
        bool | None,
        Option(
            ("deconvolved",),
            "all distances together explain the capture, not each alone.",
            default=False,
        ),
    ]
    variation: Annotated[
        float | None,
        Option(
            ("deconvolved",),
            "weight of the total variation, which makes planes even between sharp borders.",
            default=0.0,
            shown="0",
            check=lambda name, value, _: require_number(name, value, minimum=0, maximum=MOST_VARIATION),
            details="At most 0.25; 0.002 to 0.02 suit, the more the noisier the capture. What is fainter than the "
            "noise becomes flat, and slopes become steps.",
        ),
    ]


def _records() -> dict[str, Option]:
    """Return the records of `MethodOptions` by name, with the types of their annotations."""
    hints = get_type_hints(MethodOptions, include_extras=True)
    fields = {name: get_args(hint) for name, hint in hints.items()}
    return {
        name: replace(option, types=tuple(one for one in get_args(kind) if one is not types.NoneType))
        for name, (kind, option) in fields.items()
    }


OPTIONS = _records()
"""The options of single methods, by name, in the order in which messages name them."""


def with_parameters(function: _Call, parameters: list[inspect.Parameter]) -> _Call:
    """Give a function that takes ``**options`` a signature that names them."""
    signature = inspect.signature(function, eval_str=True)
    own = [one for one in signature.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
    named: Any = function
    named.__signature__ = signature.replace(parameters=[*own, *parameters])
    named.__annotations__ = {one.name: one.annotation for one in (*own, *parameters)}
    return function


def with_options(function: _Call) -> _Call:
    """Give `reconstruct` the options of single methods, in its signature and in its docstring."""
    parameters, text = [], ""
    for name, option in OPTIONS.items():
        kind: Any = functools.reduce(operator.or_, (*option.types, None))
        parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind))
        words = " or ".join([repr(word) for word in option.choices] or [one.__name__ for one in option.types])
        text += f"{name} : {words}, optional\n"
        described = " ".join(filter(None, (option.label, option.details, f"Default: {option.shown_default}.")))
        text += textwrap.indent(textwrap.fill(described, 110), "    ") + "\n"
    head, _, tail = (function.__doc__ or "").partition("    **options\n")
    function.__doc__ = head + textwrap.indent(text, "    ") + tail.partition("\n")[2]
    return with_parameters(function, parameters)
