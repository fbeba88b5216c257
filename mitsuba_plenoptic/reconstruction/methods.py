"""The methods of reconstruction, by name: each is a module that registers one function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError, argument
from ..io.checkpoints import Checkpoint
from ..runtime.batches import BatchMap
from ..system.optical_system import OpticalSystem

Progress = Callable[[float], None]
"""Called with the fraction of the work that is done."""


@dataclass(frozen=True, eq=False)
class Task:
    """The inputs of a method of reconstruction, all of which have been checked.

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
    progress : callable
        Called with the fraction of the work that is done.
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

    image: np.ndarray
    camera: PlenopticCamera
    distances: Sequence[float]
    oversample: int
    wavelengths: Sequence[float]
    white: np.ndarray | None
    progress: Progress
    recorded: Sequence[float] | None = None
    exposure: dict[str, Any] | None = None
    checkpoint: Checkpoint | None = None
    batch_map: BatchMap | None = None
    systems: dict[float, OpticalSystem] = field(default_factory=dict)

    def system(self, wavelength: float) -> OpticalSystem:
        """Return the camera bound to the wavelength of a channel, once for all that is done with the task."""
        if wavelength not in self.systems:
            self.systems[wavelength] = OpticalSystem(self.camera, wavelength)
        return self.systems[wavelength]


@dataclass(frozen=True, eq=False)
class Found:
    """An image (rows, columns, channels), NaN where no light can come from, and facts about it: plain data by name."""

    image: np.ndarray
    facts: dict[str, Any] = field(default_factory=dict)


def portion(progress: Progress, number: int, count: int) -> Progress:
    """Return a progress callback for one of several parts of a computation."""
    return lambda done: progress((number + done) / count)


Refocus = Callable[..., Sequence[np.ndarray | Found]]
"""From a `Task`, and the method's options by name, to an image (rows, columns, channels) for every distance."""


@dataclass(frozen=True)
class RegisteredMethod:
    """A method of reconstruction as `method` registers it."""

    name: str
    refocus: Refocus
    options: tuple[str, ...]
    waves: bool
    as_it_is: bool = False
    long: bool = False

    def takes(self, option: str) -> bool:
        """Whether the method uses an option of `reconstruct` that not all methods take."""
        if option == "wavelength":
            return self.waves
        return option in self.options or (self.long and option in ("checkpoint", "batch_map"))


METHODS: dict[str, RegisteredMethod] = {}


def require_taken(chosen: RegisteredMethod, **given: Any) -> None:
    """Refuse options of `reconstruct` that a method would ignore; None means not given."""
    for name, value in given.items():
        if value is not None and not chosen.takes(name):
            methods = ", ".join(other.name for other in METHODS.values() if other.takes(name))
            raise InputError(f"{argument(name)}: method {chosen.name} does not take it; methods that do: {methods}")


def method(
    name: str, *, options: tuple[str, ...], waves: bool, as_it_is: bool = False, long: bool = False
) -> Callable[[Refocus], Refocus]:
    """Register a function as a method of reconstruction.

    Parameters
    ----------
    name : str
        The name under which users select it.
    options : tuple of str
        The options of `reconstruct` that it takes.
    waves : bool
        Whether it needs wavelengths.
    as_it_is : bool
        Whether it needs the camera with the aberrations of its main lens; others form images by the ideal lens.
    long : bool
        Whether it may take long: then it writes checkpoints and takes workers.
    """

    def register(refocus: Refocus) -> Refocus:
        METHODS[name] = RegisteredMethod(name, refocus, options, waves, as_it_is, long)
        return refocus

    return register
