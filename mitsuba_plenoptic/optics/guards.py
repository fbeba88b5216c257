"""Guards of the physics: the light that a computation loses or aliases, measured in its data, with bounds.

Grids and windows are chosen beforehand, by geometry or by the caller. Each guard checks that choice by a measured
fraction of the power in the computed fields. All bounds are defined here, with their reasons.
"""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar
from dataclasses import dataclass

from ..errors import InputError, warn


class PhysicsWarning(UserWarning):
    """Warning that a result is less accurate than promised, with the fraction of power concerned."""


class PhysicsError(InputError):
    """Error for a result that would be false, because its sampling loses or aliases too much light."""


@dataclass(frozen=True)
class Guard:
    """A fraction of the power that a computation may lose, with the bounds for warning and error.

    Attributes
    ----------
    name : str
        Name in metadata.
    fault : str
        Text after the fraction in messages.
    remedy : str
        Advice to the user.
    warn, refuse : float
        Fractions above which a warning is issued, and an error is raised.
    """

    name: str
    fault: str
    remedy: str
    warn: float
    refuse: float


# The spectrum of a field that the grid resolves decays before the grid's band limit; the hard edge of a pupil leaves
# 0.1 % in the outer eighth. Uncorrelated samples have 23 %: such a field is undetermined between its samples.
UNDERSAMPLED = Guard(
    "undersampled",
    "of a field's power is in the outer eighth of its spectrum, next to what its pitch can hold: it is under-sampled",
    "use a finer pitch",
    warn=0.01,
    refuse=0.2,
)

# Waves with components finer than the wavelength do not propagate, and the angular spectrum omits them.
EVANESCENT = Guard(
    "evanescent",
    "of a field's power is in detail finer than the wavelength, which does not propagate",
    "check pitch and wavelength",
    warn=0.01,
    refuse=0.5,
)

# Light that crosses the edge of a window re-enters it on the other side. The rim must be dark to exclude that. A
# periodic field correctly has light in the rim, but equally before and after propagation.
WINDOW = Guard(
    "window_rim",
    "of a field's power is in the outer eighth of its window, from where light comes in on the other side",
    "use a wider window, unless the field is periodic",
    warn=0.01,
    refuse=1.0,
)

# Light that has re-entered from all sides fills the window uniformly: 23 % of it is then in the rim.
WRAPPED = Guard(
    "wrapped",
    "of a field's power has come into the outer eighth of its window on the way: it has gone round the window's edges",
    "use a wider window or a shorter distance",
    warn=1.0,
    refuse=0.2,
)

# The default accuracy loses 0.4 to 1.7 % of the light, which the edges of microlenses scatter far, and the coarsest
# one up to 4 %, for microlens Fresnel numbers from 0.4 to 13; apertures with gaps between them lose 2 to 4 %. A quarter
# is lost if a part of the geometric cone does not fit the grid.
PATCH = Guard(
    "patch_loss",
    "of the power behind the microlenses is lost by the patches of the point spreads",
    "use a smaller 'accuracy', or method 'full_field'",
    warn=0.05,
    refuse=0.25,
)

# The same light, lost at the band limit of the full field's grid, which retains all except 0.2 %, or except 3 % for a
# point in focus near an aperture, where only the edge is lit.
MICROLENS = Guard(
    "microlens_loss",
    "of the power behind the microlenses is sent into directions that the grid does not hold",
    "the microlenses are too strong for scalar thin elements",
    warn=0.05,
    refuse=0.25,
)

# Uniformly grey pixels lose the light outside the round micro-images: 65 % with the default camera. If more is lost,
# the capture is not from this camera.
PUPIL = Guard(
    "outside_pupil",
    "of the capture's light does not go back through the main lens",
    "check that the camera is the capture's own",
    warn=0.5,
    refuse=0.999,
)

# The window is six bins wider than the geometric image of a lens, for the light that the pupil's edge diffracts. What
# is diffracted beyond comes in on the other side, so that it is not missing from sums; its fraction is that of an Airy
# pattern. With the paper's array a hundredth is outside at f/20, and the first bound is met at f/100.
OBJECT = Guard(
    "object_window",
    "of the light of a lens is diffracted beyond the computed window of the object plane, and comes in on its other "
    "side",
    "use a larger aperture_radius: diffraction blurs over many bins",
    warn=0.05,
    refuse=0.5,
)

# The lenses that can light a pixel follow from geometry, which is approximate for a wide field. With 16 samples a pixel
# the noise exceeds the first bound; a single lens at f/3 would lose 28 %.
CROSSTALK = Guard(
    "crosstalk_missed",
    "of the light comes through microlenses that are too far from a pixel to be tried",
    "use a smaller aperture, a longer mla_distance, or lens_model ideal",
    warn=0.002,
    refuse=0.05,
)


# The path through a real main lens is a polynomial over its exit pupil. A root mean square error of it, in waves,
# reduces the peak of a point by (2 pi error)^2: 0.4 % for a hundredth of a wave.
MAIN_LENS = Guard(
    "main_lens_fit",
    "of a point's peak is uncertain, since the path through the main lens is too uneven for its polynomial",
    "stop the main lens down",
    warn=0.004,
    refuse=0.25,
)

# The field of a point passes the whole pupil. Edges of objects hide points behind them from parts of it, which matters
# where much of a laser's light comes from there.
HIDDEN = Guard(
    "partly_hidden",
    "of the laser light comes from points that objects hide from parts of the pupil, as if they did not",
    "move objects away from lines between lit surfaces and the main lens, or use a smaller aperture",
    warn=0.02,
    refuse=0.2,
)


# Signed rays follow the slopes of the path over the pupil. Light of points of the pupil whose interference has the
# period of a lens loses this fraction of its contrast; see `ThinLens.beyond_slopes`.
SCREEN = Guard(
    "phase_screen",
    "of the light interferes at microlenses otherwise than the slopes of the phase_screen say: it varies too fast",
    "use ray captures, or CaptureOperator with method full_field",
    warn=0.01,
    refuse=0.1,
)

# The window between pupil and array follows from the camera's aperture. A given wavefront that fits has all of its
# light there but the less than a hundredth that interpolation spreads; one of twice the diameter loses half.
APERTURE = Guard(
    "outside_aperture",
    "of the wavefront's power is outside the window that the camera's aperture_radius determines",
    "use an aperture_radius of about the wavefront's aperture",
    warn=0.01,
    refuse=0.05,
)


_findings: ContextVar[dict[Guard, float] | None] = ContextVar("findings", default=None)
"""The largest fraction that each guard has found so far."""


@contextlib.contextmanager
def watch() -> Iterator[dict[str, float]]:
    """Collect the largest fraction of each guard during a computation, and warn at most once per guard.

    Yields
    ------
    dict
        The largest fraction by name of the guard, filled when the computation is complete. Within another `watch` it
        stays empty, since the outer one collects all findings.
    """
    if _findings.get() is not None:
        yield {}
        return
    findings: dict[Guard, float] = {}
    fractions: dict[str, float] = {}
    token = _findings.set(findings)
    try:
        yield fractions
    finally:
        _findings.reset(token)
    for guard, fraction in findings.items():
        # Further digits vary with the number of threads.
        fractions[guard.name] = float(f"{fraction:.3g}")
        _warn(guard, fraction)


def check(guard: Guard, fraction: float) -> None:
    """Record a fraction of the power, from 0 to 1; raise a `PhysicsError` if it exceeds the guard's `refuse`."""
    if fraction > guard.refuse:
        raise PhysicsError(_sentence(guard, fraction))
    fraction = max(0.0, fraction)
    findings = _findings.get()
    if findings is None:
        _warn(guard, fraction)
    else:
        findings[guard] = max(fraction, findings.get(guard, 0.0))


def check_window(in_rim: float, before: float = 0.0) -> None:
    """Record the fraction of a field's power in its window's rim, `in_rim`, and the growth since `before`."""
    check(WINDOW, in_rim)
    check(WRAPPED, in_rim - before)


def _sentence(guard: Guard, fraction: float) -> str:
    # Estimates of what is lost may exceed all of the light.
    return f"{min(fraction, 1):.2%} {guard.fault}; {guard.remedy}"


def _warn(guard: Guard, fraction: float) -> None:
    if fraction > guard.warn:
        warn(_sentence(guard, fraction), PhysicsWarning)
