"""Documentation from the table of a camera's parameters, for the docstrings of the camera and the sensor."""

import inspect
import re
import textwrap
from typing import Any

from .entry import Captures, Form
from .parameters import PARAMETERS

_FLAGS = {Captures.RAYS: "|differentiable|", Captures.EDGES: "|discontinuous|"}
"""Flags of Mitsuba's manual for gradients of ray captures."""


def signature() -> inspect.Signature:
    """Return the signature of the camera's constructor."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    first = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    others = (inspect.Parameter(name, keyword, default=entry.default) for name, entry in PARAMETERS.items())
    return inspect.Signature([first, *others])


def numpy_section() -> str:
    """Return the entries of the section of parameters of the camera's docstring."""
    lines = []
    for entry in PARAMETERS.values():
        lines.append(f"    {entry.name} : {entry.takes or entry.form.value[0]}{', optional' * (entry.default is None)}")
        default = f" Default: {entry.otherwise}." if entry.otherwise else ""
        lines += _filled(entry.words + default, " " * 8, " " * 8)
    return "".join(line + "\n" for line in lines)


def with_sensor_parameters(docstring: str) -> str:
    """Replace the row CAMERA of a docstring by the rows of all parameters that a sensor takes."""
    rows = []
    for entry in PARAMETERS.values():
        if entry.form is Form.FILM:
            continue
        rows += [f" * - {entry.name}", f"   - {entry.form.value[1]}"]
        default = entry.otherwise or _written(entry.default)
        # Only in Python are they names that the site links.
        words = re.sub(rf"(?<![`:])`({'|'.join(PARAMETERS)})`", r"``\1``", f"{entry.words} (Default: {default})")
        rows += _filled(words, "   - ", "     ")
        if entry.gradients:
            flags = ["|exposed|", *(words for flag, words in _FLAGS.items() if flag in entry.gradients)]
            rows.append(f"   - {', '.join(flags)}")
    # The docstring is indented where Python reads it, and not where the site does.
    indent = re.search(r"^( *) \* - CAMERA$", docstring, re.MULTILINE)
    # Python without docstrings (-OO) has none.
    return docstring.replace(indent[0], "\n".join(indent[1] + row for row in rows)) if indent else docstring


def _written(default: Any) -> str:
    """Return a default as written in a scene file."""
    if isinstance(default, tuple):
        return f'"{", ".join(map(_written, default))}"'
    return f"``{default}``" if isinstance(default, str) else f"{default:g}"


def _filled(text: str, first: str, others: str) -> list[str]:
    # 116: Columns to which docstrings are filled.
    return textwrap.wrap(text, 116, initial_indent=first, subsequent_indent=others, break_on_hyphens=False)
