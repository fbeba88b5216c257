"""The main lens and the glasses that a camera is given, in any of their forms, and what these bring with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..bounds import require_length
from ..errors import InputError
from ..io.lens_file import lens_from_plain, read_lens
from ..objective import Objective
from ..prescription import Glass, Prescription, paraxial
from ..prescription.glass import LINE_D

GivenLens = Prescription | Objective


def known_lens(value: GivenLens | str | Path | dict[str, Any] | None) -> GivenLens | None:
    """Return the main lens that is given in any of its forms, None for a thin one."""
    if value is None or isinstance(value, (Prescription, Objective)):
        return value
    return read_lens(value) if isinstance(value, (str, Path)) else lens_from_plain(value)


def known_glass(name: str, value: Any) -> Glass | None:
    """Return a lens's glass that is given in any of its forms, one that bends light of the line d."""
    if value is None:
        return None
    glass = value if isinstance(value, Glass) else Glass.from_plain(value, name)
    try:
        glass.focal_ratio(LINE_D)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None
    return glass


def own_numbers(lens: GivenLens, focal_length: float | None) -> tuple[float, float]:
    """Return a lens's focal length and the radius of its open entrance pupil, scaled to what focal length is given."""
    if isinstance(lens, Objective):
        return lens.focal_length, lens.stop_radius
    numbers = paraxial(lens)
    given = numbers.focal_length if focal_length is None else require_length("focal_length", focal_length)
    return given, numbers.entrance_radius * given / numbers.focal_length


def exit_pupil(lens: GivenLens | None, focal_length: float) -> tuple[float, float]:
    """Return how far the exit pupil lies before the rear principal plane, and its radius over the entrance pupil's.

    A thin lens is its own pupil. That of an objective is infinitely far, and the numbers are those of a thin lens.
    """
    if not isinstance(lens, Prescription):
        return 0.0, 1.0
    numbers = paraxial(lens)
    scale = focal_length / numbers.focal_length
    return scale * (numbers.rear_principal - numbers.exit_pupil), numbers.exit_radius / numbers.entrance_radius


def nearest_array(lens: Prescription, focal_length: float) -> float:
    """Return the distance behind the rear principal plane up to which an array is within the lens or its exit pupil."""
    numbers = paraxial(lens)
    scale = focal_length / numbers.focal_length
    return -scale * min(numbers.rear_principal, numbers.rear_principal - numbers.exit_pupil)
