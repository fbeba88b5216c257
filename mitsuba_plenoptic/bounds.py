"""Bounds of a camera's parameters, and the checks that refuse what is beyond them, with an `InputError`."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from .errors import InputError, require_count, require_number, require_pair, short_repr

SHORTEST, LONGEST = 1e-9, 1e9
"""Bounds of every length in scene units: a picometre and a thousand kilometres in millimetres.

Between them no product or quotient of a camera's parameters leaves what a float holds.
"""

MOST_PIXELS = 2**20
"""Pixels along an axis of a detector, at most; pixel coordinates stay exact in single precision."""

WAVELENGTHS = (200.0, 2500.0)
"""Bounds of a wavelength in nanometres: where lenses of glass let light through, as catalogues give their indices."""

_UNITS = {"metres": 1e9, "millimetres": 1e6, "micrometres": 1e3, "angstroms": 0.1}
"""Nanometres in the units that wavelengths are given in by mistake."""

WAVEFRONT_UNIT = 633.0
"""Wavelength in nanometres in whose waves aberrations are given; other wavelengths see the same path."""

MOST_ABERRATIONS = 66
"""Zernike polynomials at most: those up to the tenth order."""

STRONGEST_ABERRATION = 1000.0
"""Waves, root mean square over the pupil, of one of them at most."""

FULL_TURN = 360.0
"""Bound of a rotation in degrees, in either direction."""

STEEPEST_TILT = 5.0
"""Degrees by which an array may be tilted."""

LEAST_FILL = 1e-3
"""Width of a microlens over its pitch, at least; that of the thinnest line would let no light through."""

MOST_STRETCH = 10.0
"""One pitch over the other, at most."""

MOST_JITTER = 0.1
"""Standard deviation of lenses' positions, over the pitch, and of their focal lengths, over these, at most."""

MOST_SEED = 2**32 - 1
"""Seed of an array's irregularities at most."""

WIDEST_ANGLE = 90.0
"""Degrees of incidence at most."""


def require_wavelength(value: Any, name: str = "wavelength") -> float:
    """Return a wavelength in nanometres, from 200 to 2500, as a float; other units are recognised."""
    number, (low, high) = require_number(name, value, positive=True), WAVELENGTHS
    if low <= number <= high:
        return number
    looks = [
        f"; it looks like {unit}, {number * size:.6g} nm"
        for unit, size in _UNITS.items()
        if low <= number * size <= high
    ]
    raise InputError(f"{name} = {number:g}: it must be from {low:g} to {high:g} nm{''.join(looks)}")


def require_length(name: str, value: Any, *, finite: bool = True) -> float:
    """Return a length in scene units, from 1e-9 to 1e9 or infinite where that is allowed, as a float."""
    return require_number(name, value, positive=True, minimum=SHORTEST, maximum=LONGEST, finite=finite)


def require_lengths(name: str, value: Any) -> tuple[float, ...]:
    """Return one length or several as a tuple."""
    value = _plain(value)
    return tuple(require_length(name, number) for number in (value if isinstance(value, (tuple, list)) else [value]))


def require_pitches(name: str, value: Any) -> tuple[float, float]:
    """Return the pitches along the rows of a lattice and across them, which one number gives both."""
    pitches = require_lengths(name, value)
    if len(pitches) not in (1, 2):
        raise InputError(f"{name} = {short_repr(value)}: it must be one number, or two, along the rows and across them")
    if max(pitches) > MOST_STRETCH * min(pitches):
        raise InputError(f"{name} = {pitches}: neither may be more than {MOST_STRETCH:g} times the other")
    return pitches[0], pitches[-1]


def require_pixels(name: str, value: Any, *, minimum: int) -> tuple[int, int]:
    """Return a pair of counts of pixels, integers from `minimum` to 1048576."""
    columns, rows = (
        require_count(name, count, minimum=minimum, maximum=MOST_PIXELS)
        for count in require_pair(name, value, "(columns, rows)")
    )
    return columns, rows


def require_place(name: str, value: Any) -> tuple[float, float]:
    """Return a position in the plane of the microlenses, a pair of coordinates within 1e9 of the axis."""
    pair = require_pair(name, value, "(x, y)")
    x, y = (require_number(name, number, minimum=-LONGEST, maximum=LONGEST) for number in pair)
    return x, y


def require_wavefront(name: str, value: Any) -> tuple[float, ...]:
    """Return Zernike coefficients in waves, up to 66 of them, as a tuple."""
    value = _plain(value)
    if not isinstance(value, (tuple, list)) or len(value) > MOST_ABERRATIONS:
        raise InputError(f"{name} = {short_repr(value)}: it must be at most {MOST_ABERRATIONS} numbers")
    bound = STRONGEST_ABERRATION
    return require_numbers(name, value, count=len(value), minimum=-bound, maximum=bound)


def require_response(name: str, value: Any) -> tuple[float, ...]:
    """Return pairs of an angle in degrees, rising from 0, and a response from 0 to 1, as one tuple of numbers."""
    value = _plain(value)
    if not isinstance(value, (tuple, list)) or len(value) % 2 or len(value) == 2:
        raise InputError(
            f"{name} = {short_repr(value)}: it must be two or more pairs of an angle in degrees and a response"
        )
    numbers = require_numbers(name, value, count=len(value), minimum=0, maximum=WIDEST_ANGLE)
    angles, responses = numbers[::2], numbers[1::2]
    if numbers and (angles[0] != 0 or any(a >= b for a, b in itertools.pairwise(angles))):
        raise InputError(f"{name} = {short_repr(value)}: its angles must rise from 0")
    if any(response > 1 for response in responses):
        raise InputError(f"{name} = {short_repr(value)}: its responses must be from 0 to 1")
    return numbers


def require_numbers(
    name: str, value: Any, *, count: int, minimum: float | None = None, maximum: float | None = None
) -> tuple[float, ...]:
    """Return a given count of numbers as a tuple, each within bounds."""
    value = _plain(value)
    if not isinstance(value, (tuple, list)) or len(value) != count:
        raise InputError(f"{name} = {short_repr(value)}: it must be {count} numbers")
    return tuple(require_number(name, number, minimum=minimum, maximum=maximum) for number in value)


def _plain(value: Any) -> Any:
    """Return an array of NumPy as lists, and anything else as it is."""
    return value.tolist() if isinstance(value, np.ndarray) else value
