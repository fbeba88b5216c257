"""Documentation from the table of a camera's parameters, for the docstrings of the camera and the sensor."""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator
from typing import Any

from .entry import Captures, Form, Parameter
from .parameters import PARAMETERS

_WIDTH = 116
"""Columns to which docstrings are filled."""

_FLAGS = {Captures.RAYS: "|differentiable|", Captures.EDGES: "|discontinuous|"}
"""Flags of Mitsuba's manual for gradients of ray captures."""


def signature() -> inspect.Signature:
    """Return the signature of the camera's constructor."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    others = (inspect.Parameter(name, keyword, default=entry.default) for name, entry in PARAMETERS.items())
    return inspect.Signature([own, *others])


def numpy_section() -> str:
    """Return the entries of the section of parameters of the camera's docstring."""
    return "".join(line + "\n" for entry in PARAMETERS.values() for line in _numpy_entry(entry))


def _numpy_entry(entry: Parameter) -> Iterator[str]:
    optional = ", optional" if entry.default is None else ""
    yield f"    {entry.name} : {entry.takes or entry.form.value[0]}{optional}"
    default = f" Default: {entry.otherwise}." if entry.otherwise else ""
    yield from _filled(entry.words + default, " " * 8, " " * 8)


def with_sensor_parameters(docstring: str) -> str:
    """Replace the row CAMERA of a docstring by the rows of all parameters that a sensor takes."""
    rows = [line for entry in PARAMETERS.values() if entry.form is not Form.FILM for line in _sensor_row(entry)]
    # The docstring is indented where Python reads it, and not where the site does.
    indent = re.search(r"^( *) \* - CAMERA$", docstring, re.MULTILINE)
    assert indent is not None
    return docstring.replace(indent[0], "\n".join(indent[1] + row for row in rows))


def _sensor_row(entry: Parameter) -> Iterator[str]:
    yield f" * - {entry.name}"
    yield f"   - {entry.form.value[1]}"
    default = entry.otherwise or _written(entry.default)
    # Only in Python are they names that the site links.
    words = re.sub(rf"(?<![`:])`({'|'.join(PARAMETERS)})`", r"``\1``", f"{entry.words} (Default: {default})")
    yield from _filled(words, "   - ", "     ")
    if entry.is_exposed:
        yield "   - " + ", ".join(["|exposed|", *(words for flag, words in _FLAGS.items() if flag in entry.gradients)])


def _written(default: Any) -> str:
    """Return a default as written in a scene file."""
    if isinstance(default, tuple):
        return f'"{", ".join(map(_written, default))}"'
    return f"``{default}``" if isinstance(default, str) else f"{default:g}"


def _filled(text: str, first: str, others: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent=first, subsequent_indent=others, break_on_hyphens=False)
