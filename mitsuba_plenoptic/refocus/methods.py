"""The registry of reconstruction methods by name, and the checks of their arguments.

Each method is a module that registers one function of a `Task`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..camera import PlenopticCamera, Use
from ..errors import (
    InputError,
    argument,
    refuse_if,
    require_choice,
    require_count,
    require_flag,
    require_number,
    require_wavelength,
    short_repr,
    warn,
)
from ..extension import missing
from ..fields import OpticalSystem
from ..io import Capture, Checkpoint, require_demosaiced
from ..optics import in_millimetres
from ..refocus_options import Option, all_options, options_of_methods
from ..runtime import Array, BatchMap, Named, Sizes, as_array, require_memory_for

Progress = Callable[[float], None]
"""Called with the fraction of the work that is done."""


@dataclass(frozen=True, eq=False)
class Task:
    """Checked inputs of a reconstruction method.

    Attributes
    ----------
    image : (rows, columns, channels) float32 array
        The capture.
    camera : PlenopticCamera
        The camera; its recorded window is the image.
    distances : sequence of floats
        Object distances.
    oversample : int
        Bins per lens along each axis.
    wavelengths : sequence of floats
        Wavelengths of the channels in nanometres; empty for ray methods.
    white : (rows, columns, 1 or channels) float32 array, or None
        Capture of a scene of uniform radiance 1 by the same camera.
    computed : (rows, columns, 1 or channels) float32 array, or None
        Computed capture of such a scene, by the capture's model of light; None if `white` is given, or for methods that
        compute white themselves.
    progress : callable
        Called with the fraction of the work that is done.
    passed : (rows, columns) float32 array, optional
        Part of a white scene's light that the capture's pixels hold; None if they hold all.
    recorded : sequence of floats, optional
        Wavelengths of the channels in nanometres at which a wave capture was recorded; None for a ray capture.
    exposure : dict, optional
        Metadata that `expose` has stored with the capture.
    checkpoint : Checkpoint, optional
        For long methods: saves intermediate results.
    batch_map : BatchMap, optional
        For long methods: computes their point spreads.
    systems : dict
        Optical systems that `system` has built.
    """

    image: Array
    camera: PlenopticCamera
    distances: Sequence[float]
    oversample: int
    wavelengths: Sequence[float]
    white: Array | None
    progress: Progress
    computed: Array | None = None
    passed: Array | None = None
    recorded: Sequence[float] | None = None
    exposure: Named | None = None
    checkpoint: Checkpoint | None = None
    batch_map: BatchMap | None = None
    systems: dict[float, OpticalSystem] = field(default_factory=dict)

    def system(self, wavelength: float) -> OpticalSystem:
        """Return the optical system at a channel's wavelength, made once per task."""
        if wavelength not in self.systems:
            self.systems[wavelength] = OpticalSystem(self.camera, wavelength)
        return self.systems[wavelength]


@dataclass(frozen=True, eq=False)
class Found:
    """Image (rows, columns, channels), NaN where no light can come from, and facts as plain data by name."""

    image: Array
    facts: Named = field(default_factory=dict)


def portion(progress: Progress, index: int, works: Sequence[float]) -> Progress:
    """Return a progress callback for one of several parts of a computation, weighted by their amounts of work."""
    before = sum(works[:index])
    work = works[index]
    total = sum(works)
    return lambda done: progress((before + work * done) / total)


def work_of(wavelengths: Sequence[float]) -> list[float]:
    """Return the amounts of work for waves of given wavelengths, from the number of samples along both axes."""
    return [wavelength**-2 for wavelength in wavelengths]


Refocus = Callable[..., Sequence[Array | Found]]
"""From a `Task`, and the method's options by name, to an image (rows, columns, channels) for every distance."""


@dataclass(frozen=True)
class RegisteredMethod:
    """A reconstruction method with its options, as `method` registers it."""

    name: str
    refocus: Refocus
    options: Mapping[str, Option]
    waves: bool
    as_it_is: bool = False
    long: bool = False
    as_recorded: bool = False

    @property
    def use(self) -> Use:
        """The use of a camera, in the table of support."""
        if self.as_it_is:
            return Use.RESPONSES
        return Use.FIELDS if self.waves else Use.RAY_REFOCUSING

    def takes(self, option: str) -> bool:
        """Return whether the method has an option of `reconstruct` that only some methods have."""
        if option in ("wavelength", "white"):
            return option == "white" or self.waves
        # The command has the last three.
        return option in self.options or (
            self.long and option in ("checkpoint", "batch_map", "resume", "workers", "scheduler")
        )


METHODS: dict[str, RegisteredMethod] = {}


def registered(name: object) -> RegisteredMethod:
    """Return the method of a name; refuse unknown names, and those of an extension that is not installed."""
    if isinstance(name, str) and name in METHODS:
        return METHODS[name]
    refuse_if(absent := missing("methods", str(name)), f"method = {absent}")
    return METHODS[require_choice("method", name, METHODS)]


def used_by(chosen: RegisteredMethod, **given: Any) -> Named:
    """Return options, with None for options that the method ignores; one warning names them."""
    unused = [name for name, value in given.items() if value is not None and not chosen.takes(name)]
    if unused:
        takers = {name: " and ".join(entry.name for entry in METHODS.values() if entry.takes(name)) for name in unused}
        named = ", ".join(f"{argument(name)} (of {takers[name]})" for name in unused)
        warn(f"method {chosen.name} has no use for {named}")
    return {**given, **dict.fromkeys(unused)}


def method(
    name: str,
    *,
    options: tuple[str, ...] = (),
    waves: bool,
    as_it_is: bool = False,
    long: bool = False,
    as_recorded: bool = False,
) -> Callable[[Refocus], Refocus]:
    """Register a function as a reconstruction method.

    Parameters
    ----------
    name : str
        The name under which users select it.
    options : tuple of str
        Options of other methods that it takes, besides its own (see `refocus_options`).
    waves : bool
        Whether the method needs wavelengths.
    as_it_is : bool
        Whether the method needs the main lens's aberrations; other methods form images by the ideal lens.
    long : bool
        Whether the method may take long, so that it writes checkpoints and uses workers.
    as_recorded : bool
        Whether the method knows displaced and unequal lenses, so that captures and white are not straightened.
    """
    accepted = {option: all_options()[option] for option in options} | options_of_methods().get(name, {})

    def register(refocus: Refocus) -> Refocus:
        METHODS[name] = RegisteredMethod(name, refocus, accepted, waves, as_it_is, long, as_recorded)
        return refocus

    return register


def as_capture(capture: Capture | Array, camera: PlenopticCamera | None) -> Capture:
    """Return a capture with its own camera, or with a given one instead."""
    if isinstance(capture, Capture):
        require_demosaiced(capture)
        if camera is None:
            return capture
        return replace(capture, camera=camera)
    if camera is None:
        raise InputError("camera = None: a plain array needs the camera that recorded it; give camera")
    return Capture(as_array("capture", capture, dtype=None), camera)


def require_distances(distance: Any, camera: PlenopticCamera) -> list[float]:
    """Return the distances; refuse one that does not lie before the camera."""
    try:
        is_list = np.ndim(distance) > 0
    except ValueError:
        # Lists of several lengths.
        is_list = None
    if is_list is None or isinstance(distance, (str, bytes)):
        raise InputError(f"distance = {short_repr(distance)}: it must be a number or several")
    values = distance if is_list else [distance]
    distances = [require_number("distance", value, finite=False) for value in values]
    for value in distances:
        camera.lens_data.require_distance(camera, value)
    refuse_if(not distances, "distance = []: give at least one")
    return distances


def require_option(option: Option, name: str, value: Any, camera: PlenopticCamera) -> Any:
    """Return an option's value as methods expect it, or the default of its record if none is given."""
    if value is None:
        return option.default
    if option.check:
        return option.check(name, value, max(camera.lens_count))
    if option.choices:
        return require_choice(name, value, option.choices)
    return require_flag(name, value) if bool in option.types else require_count(name, value)


def require_response(response: str | None, capture: Capture, wavelength: Any) -> str:
    """Return the light model of a response: by default waves if there is a wavelength, else the capture's model."""
    if response == "ray":
        refuse_if(wavelength is not None, f"{argument('wavelength')}: a response by rays has none; leave it out")
    model = response or (capture.model if wavelength is None else "wave")
    lens = capture.camera.lens_data
    refuse_if(model == "ray" and not lens.is_thin, f"response = ray: behind main_lens = {lens.label} it must be wave")
    return model


def require_wavelengths(capture: Capture, wavelength: Any, channels: int, camera: PlenopticCamera) -> list[float]:
    """Return the wavelength of each channel; refuse lenses too narrow for scalar waves."""
    value_s: Any = capture.wavelength if wavelength is None else wavelength
    if value_s is None:
        raise InputError(
            f"wavelength = None: a wave method needs one, and the capture has none; give {argument('wavelength')}"
        )
    values = [value_s] * channels if np.ndim(value_s) == 0 else list(value_s)
    refuse_if(
        len(values) != channels,
        f"wavelength = {short_repr(value_s)}: the capture has {channels} channels; give one, or one for each",
    )
    checked = [require_wavelength(value) for value in values]
    if in_millimetres(max(checked)) >= min(camera.mla_pitches):
        raise InputError(
            f"wavelength = {max(checked):g} nm: it must be less than the pitch of the microlenses, "
            f"{min(camera.mla_pitches):g} mm"
        )
    return checked


def require_image_memory(
    camera: PlenopticCamera, distances: Sequence[float], oversample: int, shape: Sizes, drawn_back: bool
) -> None:
    """Refuse images too large for the memory before anything is allocated."""
    columns, rows = camera.bin_count
    height, _, channels = shape

    def memory(oversample: int) -> float:
        across = float(columns * oversample)
        down = float(rows * oversample)
        # Ray methods bin one axis before the other; wave methods sum powers in double precision.
        fits = 20 * 8 * channels * across * down if drawn_back else 0
        return 4 * channels * across * (down * (len(distances) + 1) + height) + 12 * across * down + fits

    label = f"images of {columns * oversample} x {rows * oversample} bins at {len(distances)} distances"
    require_memory_for(memory, oversample, label, lambda largest: f"{argument('oversample')} = {largest}")
