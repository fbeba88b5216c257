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
    """What every method is asked for; all of it is checked.

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
        Of the channels, in nanometres; empty for a method without waves.
    white : (rows, columns, 1 or channels) float32 array, or None
        What the same camera recorded of a scene of uniform radiance 1.
    progress : callable
        Called with the fraction of the work that is done.
    recorded : sequence of floats, optional
        Of the channels, the wavelengths in nanometres at which waves recorded the capture; None by rays.
    exposure : dict, optional
        What `expose` has kept with the capture.
    checkpoint : Checkpoint, optional
        For a method that is long: keeps what is done.
    batch_map : BatchMap, optional
        For a method that is long: computes its point spreads.
    systems : dict
        What `system` has bound.
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
    """An image, and what its method has to tell of it.

    Attributes
    ----------
    image : (rows, columns, channels) float32 array
        Radiance; NaN where no light can come from.
    facts : dict
        Plain numbers and strings by name.
    """

    image: np.ndarray
    facts: dict[str, Any] = field(default_factory=dict)


Refocus = Callable[..., Sequence[np.ndarray | Found]]
"""From a `Task`, and the method's options by name, to an image (rows, columns, channels) for every distance."""


@dataclass(frozen=True)
class Method:
    """A way to refocus.

    Attributes
    ----------
    name : str
        As users call it.
    refocus : callable
        What does it.
    options : tuple of str
        The options of `reconstruct` that it takes.
    waves : bool
        Whether it needs wavelengths.
    as_it_is : bool
        Whether it needs the camera with the aberrations of its main lens; others form images by the lens as it
        should be.
    long : bool
        Whether it may take so long that it keeps checkpoints and takes workers.
    """

    name: str
    refocus: Refocus
    options: tuple[str, ...]
    waves: bool
    as_it_is: bool = False
    long: bool = False

    def takes(self, option: str) -> bool:
        """Whether an option of `reconstruct` that not all methods take is of use for this one."""
        if option == "wavelength":
            return self.waves
        return option in self.options or (self.long and option in ("checkpoint", "batch_map"))


METHODS: dict[str, Method] = {}


def require_taken(chosen: Method, **given: Any) -> None:
    """Refuse options of `reconstruct` that a method would ignore; None stands for one that is not given."""
    for name, value in given.items():
        if value is not None and not chosen.takes(name):
            methods = ", ".join(other.name for other in METHODS.values() if other.takes(name))
            raise InputError(f"{argument(name)}: method {chosen.name} does not take it; methods that do: {methods}")


def method(
    name: str, *, options: tuple[str, ...], waves: bool, as_it_is: bool = False, long: bool = False
) -> Callable[[Refocus], Refocus]:
    """Register a function as a `Method`.

    Parameters
    ----------
    name : str
        As users call it.
    options : tuple of str
        The options of `reconstruct` that it takes.
    waves : bool
        Whether it needs wavelengths.
    as_it_is : bool
        Whether it needs the camera with its aberrations.
    long : bool
        Whether it keeps checkpoints and takes workers.
    """

    def register(refocus: Refocus) -> Refocus:
        METHODS[name] = Method(name, refocus, options, waves, as_it_is, long)
        return refocus

    return register
