"""Strategies for the parts of cases: texts of Python expressions that break rules, and calls made of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

Code = SearchStrategy[str]

SHORTEST, LONGEST = 1e-9, 1e9
"""Lengths that the documentation allows."""

# Lengths of a camera, as the paper has them.
PAPER = {
    "focal_length": 80.0,
    "aperture_radius": 5.0,
    "mla_distance": 120.0,
    "mla_focal_length": 0.512,
    "mla_pitch": 0.064,
    "detector_distance": 0.512,
    "detector_width": 0.128,
}
LENGTHS = st.sampled_from(sorted(PAPER))


def is_number(text: str) -> bool:
    """Whether Python takes a text for a number; command line and scene files then may."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def among(*codes: str) -> Code:
    """One of several expressions."""
    return st.sampled_from(codes)


def code(values: SearchStrategy[Any]) -> Code:
    """Expressions that give the values of a strategy."""
    return values.map(ascii)


def forbidden(calls: Code) -> Code:
    """Cases that must be refused."""
    return calls.map("forbidden({})".format)


def call(function: str | Code, *values: Code, **named: Code) -> Code:
    """Calls of a function."""
    functions = st.just(function) if isinstance(function, str) else function
    return st.tuples(functions, st.tuples(*values), st.fixed_dictionaries(named)).map(
        lambda drawn: f"{drawn[0]}({', '.join([*drawn[1], *(f'{name}={value}' for name, value in drawn[2].items())])})"
    )


def one_wrong(function: str, right: Mapping[str, str], wrong: Mapping[str, Code]) -> Code:
    """Calls of a function, one of whose arguments is forbidden."""

    def with_wrong(name: str) -> Code:
        return call(function, **{key: st.just(value) for key, value in right.items() if key != name}, **{name: wrong[name]})

    return forbidden(st.sampled_from(sorted(wrong)).flatmap(with_wrong))


# Python values.
NOT_NUMBERS = (
    among("'80'", "'nan'", "[]", "{}", "[1.0, 2.0]", "()", "{'a': 1}", "object()", "1j", "True", "np.True_", "np.ones(2)",
          "'x' * 10_000")
    | code(st.text(max_size=5))
    | code(st.binary(max_size=3))
)  # fmt: skip
NOT_FINITE = among("nan", "inf", "-inf", "np.float32('nan')", "np.float64('inf')", "10**400", "-(10**400)")
NOT_POSITIVE = among("0", "0.0", "np.int64(-3)", "-(10**30)") | code(st.floats(max_value=-0.0, allow_infinity=False))
NOT_WHOLE = among("0.5", "np.pi") | code(st.floats(1e-9, 1e9).filter(lambda number: not number.is_integer()))
TOO_SMALL = code(st.floats(0, SHORTEST, exclude_min=True, exclude_max=True))
TOO_LARGE = among("10**20") | code(st.floats(LONGEST, exclude_min=True, allow_infinity=False))
NOT_LENGTHS = NOT_NUMBERS | NOT_FINITE | NOT_POSITIVE | TOO_LARGE
NOT_COUNTS = NOT_NUMBERS | NOT_FINITE | NOT_POSITIVE | NOT_WHOLE | st.just("None")
NOT_NAMES = among("None", "1", "[]", "nan", "'RAY'", "b'ray'") | code(st.text(max_size=5).map("x{}".format))
WAVELENGTHS = code(st.floats(1, 1e6))

# Texts of the command line and of scene files.
NOT_NUMBER_TEXTS = st.sampled_from(("wide", "1,5", "0x10", "1e", "--", "nan nan", "x" * 5000)) | st.text(
    max_size=5
).filter(lambda text: not is_number(text))
NOT_FINITE_TEXTS = st.sampled_from(("nan", "inf", "-inf", "1e999", "-1e999", "NaN", "infinity"))
NOT_POSITIVE_TEXTS = st.sampled_from(("0", "-0.0")) | st.floats(max_value=-1e-30, allow_infinity=False).map(repr)
OUT_OF_RANGE_TEXTS = st.sampled_from(("1e300", "1e-300")) | st.floats(1e10, 1e30).map(repr)
NUMBER_TEXTS = NOT_NUMBER_TEXTS | NOT_FINITE_TEXTS | NOT_POSITIVE_TEXTS
LENGTH_TEXTS = NUMBER_TEXTS | OUT_OF_RANGE_TEXTS
COUNT_TEXTS = NUMBER_TEXTS | st.sampled_from(("1.5", "9" * 30, "9" * 5000, "1e3", "99999999999"))
NAME_TEXTS = st.sampled_from(("", "RAY", "\x1b[0m")) | st.text(max_size=5).map("x{}".format)

# Damage: at a place (most of what matters is at the beginning of a file), so many bytes are replaced with others.
_WORDS = [(0).to_bytes(4, "little"), *(word.to_bytes(4, order) for word in (1, 65536, 2**30, 2**31 - 1, 2**31, 2**32 - 1)
                                       for order in ("little", "big"))]  # fmt: skip
_PLACES = st.integers(0, 2047) | st.integers(0, 2**20)
EDITS = code(
    st.lists(
        st.tuples(_PLACES, st.just(1), st.binary(min_size=1, max_size=1))
        | st.tuples(_PLACES, st.just(4), st.sampled_from(_WORDS))
        | st.tuples(_PLACES, st.integers(0, 64), st.binary(max_size=64))
        | st.tuples(_PLACES, st.just(2**30), st.just(b"")),
        min_size=1,
        max_size=4,
    )
)
