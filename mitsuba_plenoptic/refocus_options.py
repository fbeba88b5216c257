"""Options of single reconstruction methods, each declared once as a field of `MethodOptions`.

The signature and docstring of `mitsuba_plenoptic.reconstruct`, its checks, and the options of ``mitsuba-plenoptic
reconstruct`` with their help follow from these fields. Help reads this module, which imports no library.
"""

from __future__ import annotations

import functools
import inspect
import operator
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypedDict, TypeVar, get_args, get_type_hints

from .errors import InputError, require_count, require_number, short_repr

METHODS = ("ray", "coherent", "partial", "incoherent", "deconvolved")
FOOTPRINTS = ("lens", "point")
RESPONSES = ("wave", "ray")

MOST_VARIATION = 0.25
"""Largest weight of the total variation: steps stay positive, as its gradient is at most 3.42."""

_Call = TypeVar("_Call", bound=Callable[..., Any])


@dataclass(frozen=True)
class Option:
    """Properties of an option of a method, such as its default and its text."""

    # Names of the methods that use it.
    methods: tuple[str, ...]
    # What it is, for the help and the docstring alike.
    text: str
    # What the docstring adds.
    details: str = ""
    # What methods get where it is not given, and that in words where the value does not say it.
    default: Any = None
    shown: str = ""
    # From name, value and the lenses along an axis to what methods get. Default: a choice, a flag, or a count.
    check: Callable[[str, object, int], object] | None = None
    choices: tuple[str, ...] = ()
    # What the help shows for the value, where it is neither a choice nor a number.
    metavar: str = ""
    # Whether the help lists it among the options of waves, instead of those for experts.
    waves: bool = False
    # The types of its values, which its annotation states.
    types: tuple[type, ...] = ()

    @property
    def label(self) -> str:
        """Text of the option, preceded by the methods that use it."""
        return f"For {' and '.join(self.methods)}: {self.text}"

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


_PARTIAL, _DECONVOLVED = ("partial",), ("deconvolved",)


class MethodOptions(TypedDict, total=False):
    """Options of `mitsuba_plenoptic.reconstruct` that only some methods use; None is the default."""

    interleave: Annotated[
        int | str | None,
        Option(
            _PARTIAL,
            "every K-th lens along both axes shares a wave; auto lets no two lenses interfere.",
            "2 makes four waves, 1 is ``coherent``. The last bits of ``auto`` depend on the thread count of the BLAS.",
            default=2,
            check=_require_interleave,
            metavar="K|auto",
            waves=True,
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
            "Without, which is the literal reading of the paper, planes out of focus stay blurred: see "
            "`mitsuba_plenoptic.refocus.wave_methods`.",
            default=True,
            waves=True,
        ),
    ]
    response: Annotated[
        str | None,
        Option(
            _DECONVOLVED,
            "how light goes through the camera.",
            "With a `wavelength` it is ``wave``.",
            shown="as the capture was made",
            choices=RESPONSES,
        ),
    ]
    iterations: Annotated[
        int | None,
        Option(
            _DECONVOLVED,
            "steps.",
            "Where the noise is known, from `photons` or from metadata of `expose`, there are at most 100.",
            shown="until only noise is left, where a capture states its exposure; else 30",
        ),
    ]
    accelerate: Annotated[
        bool | None,
        Option(
            _DECONVOLVED,
            "whether each step starts from an extrapolated point.",
            "One step then does the work of several.",
            default=True,
        ),
    ]
    photons: Annotated[
        float | None,
        Option(
            _DECONVOLVED,
            "photons that a pixel of value 1 has counted.",
            "Photon noise is then the only noise.",
            shown="those that 'expose' recorded",
            check=lambda name, value, _: require_number(name, value, positive=True),
        ),
    ]
    volume: Annotated[
        bool | None,
        Option(_DECONVOLVED, "all distances together explain the capture, not each alone.", default=False),
    ]
    variation: Annotated[
        float | None,
        Option(
            _DECONVOLVED,
            "weight of the total variation, which makes planes even between sharp borders.",
            "At most 0.25; 0.002 to 0.02 suit, the more the noisier the capture. What is fainter than the noise "
            "becomes flat, and slopes become steps.",
            default=0.0,
            shown="0",
            check=lambda name, value, _: require_number(name, value, minimum=0, maximum=MOST_VARIATION),
        ),
    ]


_FIELDS = {name: get_args(hint) for name, hint in get_type_hints(MethodOptions, include_extras=True).items()}

OPTIONS = {name: replace(option, types=get_args(kind)[:-1]) for name, (kind, option) in _FIELDS.items()}
"""The options of single methods, by name, in the order in which messages name them."""


def with_parameters(function: _Call, parameters: dict[str, Any]) -> _Call:
    """Return a function of ``**options`` with a signature that names them; `parameters` has their annotations."""
    signature = inspect.signature(function, eval_str=True)
    own = [one for one in signature.parameters.values() if one.kind is not inspect.Parameter.VAR_KEYWORD]
    keyword = inspect.Parameter.KEYWORD_ONLY
    every = [
        *own,
        *(inspect.Parameter(name, keyword, default=None, annotation=kind) for name, kind in parameters.items()),
    ]
    named: Any = function
    named.__signature__ = signature.replace(parameters=every)
    named.__annotations__ = {one.name: one.annotation for one in every}
    return function


def with_options(function: _Call) -> _Call:
    """Return `reconstruct` with the options of single methods in its signature and docstring."""
    text = ""
    for name, option in OPTIONS.items():
        words = " or ".join([repr(word) for word in option.choices] or [one.__name__ for one in option.types])
        described = " ".join(filter(None, (option.label, option.details, f"Default: {option.shown_default}.")))
        text += f"{name} : {words}, optional\n{textwrap.indent(textwrap.fill(described, 110), '    ')}\n"
    head, _, tail = (function.__doc__ or "").partition("    **options\n")
    function.__doc__ = head + textwrap.indent(text, "    ") + tail.partition("\n")[2]
    kinds = {name: functools.reduce(operator.or_, (*option.types, None)) for name, option in OPTIONS.items()}
    return with_parameters(function, kinds)
