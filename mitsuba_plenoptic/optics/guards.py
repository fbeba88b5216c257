"""Guards of the physics: what a computation loses or folds, measured on its own data, warned of or refused.

Grids and windows are chosen beforehand, by geometry or by the caller. The guards look at the fields that come out,
and tell by one fraction of the power each whether the choice was good. All bounds are here, with their reasons.
"""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError

_DIGITS = 3
"""Of the measured fractions: what is beyond differs with the number of threads."""


class PhysicsWarning(UserWarning):
    """A result is less true than its sampling promises; the message holds the fraction of the power that tells."""


class PhysicsError(InputError):
    """A result would be false, because its sampling loses or folds too much of the light."""


@dataclass(frozen=True)
class Guard:
    """A fraction of the power, and how much of it is too much.

    Attributes
    ----------
    name : str
        What metadata call it.
    fault : str
        Words after the fraction.
    remedy : str
        What the user can do.
    warn, refuse : float
        Fractions above which a result is warned of, and refused.
    """

    name: str
    fault: str
    remedy: str
    warn: float
    refuse: float


# A field that the grid resolves fades before the grid's band limit; the hard edge of a pupil leaves 0.1 % in the outer
# eighth. Samples that know nothing of each other have 23 %: of such a field nothing is known between the samples.
UNDERSAMPLED = Guard(
    "undersampled",
    "of a field's power is in the outer eighth of its spectrum, next to what its pitch can hold: it is under-sampled",
    "use a finer pitch",
    warn=0.01,
    refuse=0.2,
)

# Waves shorter than the wavelength do not propagate, and the angular spectrum cuts them.
EVANESCENT = Guard(
    "evanescent",
    "of a field's power is in detail finer than the wavelength, which does not propagate",
    "check pitch and wavelength",
    warn=0.01,
    refuse=0.5,
)

# Light that crosses the edge of a window comes in on the other side. The rim must stay dark for that not to happen. A
# periodic field rightly lights it, but the same before and after.
WINDOW = Guard(
    "window_rim",
    "of a field's power is in the outer eighth of its window, from where light comes in on the other side",
    "use a wider window, unless the field is periodic",
    warn=0.01,
    refuse=1.0,
)

# Light that has come round from all sides lights the window evenly: 23 %.
WRAPPED = Guard(
    "wrapped",
    "of a field's power has come into the outer eighth of its window on the way: it has gone round the window's edges",
    "use a wider window or a shorter distance",
    warn=1.0,
    refuse=0.2,
)

# The default accuracy cuts 0.4 to 1.7 % of the light, which the edges of microlenses scatter far, and the coarsest
# one up to 4 %, for microlens Fresnel numbers from 0.4 to 13; apertures with gaps between them lose 2 to 4 %. A quarter
# is lost where a part of the cone of geometry does not fit the grid.
PATCH = Guard(
    "patch_loss",
    "of the power behind the microlenses is lost by the patches of the point spreads",
    "use a smaller 'accuracy', or method 'full_field'",
    warn=0.05,
    refuse=0.25,
)

# The same light, cut by the grid of the full field, which keeps all but 0.2 %; of a point in focus beside an aperture,
# whose light passes its edge only, all but 3 %.
MICROLENS = Guard(
    "microlens_loss",
    "of the power behind the microlenses is sent into directions that the grid does not hold",
    "the microlenses are too strong for scalar thin elements",
    warn=0.05,
    refuse=0.25,
)

# Evenly grey pixels lose what lies beside the round micro-images: 65 % by the default camera. More is not a capture of
# this camera.
PUPIL = Guard(
    "outside_pupil",
    "of the capture's light does not go back through the main lens",
    "check that the camera is the capture's own",
    warn=0.5,
    refuse=0.999,
)

# The planned window is wider than the geometric image, by bins that only what the pupil's edge diffracts reaches.
OBJECT = Guard(
    "object_window",
    "of the light through the main lens misses the window that is kept of the object plane, or comes to its rim",
    "its aperture is so small that diffraction blurs over many bins",
    warn=0.05,
    refuse=0.5,
)

# The lenses that can light a pixel follow from geometry; that of a wide field is approximate. 16 samples a pixel are
# noisier than the one bound; a single lens at f/3 would lose 28 %.
CROSSTALK = Guard(
    "crosstalk_missed",
    "of the light comes through microlenses that are too far from a pixel to be tried",
    "use a smaller aperture or a longer mla_distance",
    warn=0.002,
    refuse=0.05,
)


# A real main lens's path is a polynomial over its exit pupil. Its error, root mean square in waves, takes
# (2 pi error)^2 from the peak of a point: 0.4 % for a hundredth of a wave.
MAIN_LENS = Guard(
    "main_lens_fit",
    "of a point's peak is uncertain, since the path through the main lens is too uneven for its polynomial",
    "stop the main lens down",
    warn=0.004,
    refuse=0.25,
)


class _Findings(dict[Guard, float]):
    """Worst fraction so far, by guard."""


_findings: ContextVar[_Findings | None] = ContextVar("findings", default=None)


@contextlib.contextmanager
def watch() -> Iterator[dict[str, float]]:
    """Gather what guards find in a computation, and warn of each guard at most once, of its worst finding.

    Yields
    ------
    dict
        By the name of the guard, its worst fraction, once the computation is done. Within another `watch` it stays
        empty: the outer one gathers all.
    """
    if _findings.get() is not None:
        yield {}
        return
    findings = _Findings()
    fractions: dict[str, float] = {}
    token = _findings.set(findings)
    try:
        yield fractions
    finally:
        _findings.reset(token)
    for guard, fraction in findings.items():
        fractions[guard.name] = _rounded(fraction)
        _warn(guard, fraction)


def judge(guard: Guard, fraction: float) -> None:
    """Take note of a fraction of the power.

    Parameters
    ----------
    guard : Guard
        What was watched.
    fraction : float
        What was measured, from 0 to 1.

    Raises
    ------
    PhysicsError
        If it is more than the guard's bound.
    """
    require(guard, fraction)
    fraction = max(0.0, fraction)
    findings = _findings.get()
    if findings is None:
        _warn(guard, fraction)
    else:
        findings[guard] = max(fraction, findings.get(guard, 0.0))


def require(guard: Guard, fraction: float) -> None:
    """Refuse a fraction of the power that is beyond a guard's bound, without taking note of it.

    Parameters
    ----------
    guard : Guard
        What was watched.
    fraction : float
        What was measured, from 0 to 1.

    Raises
    ------
    PhysicsError
        With the fraction.
    """
    if fraction > guard.refuse:
        raise PhysicsError(_sentence(guard, fraction))


def judge_window(in_rim: float, before: float = 0.0) -> None:
    """Take note of the fraction of a field's power in the rim of its window, after a way and before.

    Parameters
    ----------
    in_rim : float
        The fraction after the way.
    before : float
        The fraction before it.

    Raises
    ------
    PhysicsError
        If light has gone round the window.
    """
    judge(WINDOW, in_rim)
    judge(WRAPPED, in_rim - before)


def _rounded(number: float) -> float:
    return float(f"{number:.{_DIGITS}g}")


def _sentence(guard: Guard, fraction: float) -> str:
    return f"{fraction:.2%} {guard.fault}; {guard.remedy}"


def _warn(guard: Guard, fraction: float) -> None:
    if fraction > guard.warn:
        warnings.warn(_sentence(guard, fraction), PhysicsWarning, stacklevel=_callers_level())


def _callers_level() -> int:
    """Frames from `_warn` up to the first one outside this package."""
    ours = str(Path(__file__).parent.parent)
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and (
        frame.f_code.co_filename.startswith(ours) or frame.f_code.co_filename == contextlib.__file__
    ):
        level, frame = level + 1, frame.f_back
    return level
