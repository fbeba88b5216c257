"""The methods of reconstruction, by name: each is a module that registers one function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..camera import PlenopticCamera

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
    """

    image: np.ndarray
    camera: PlenopticCamera
    distances: Sequence[float]
    oversample: int
    wavelengths: Sequence[float]
    white: np.ndarray | None
    progress: Progress


Refocus = Callable[..., list[np.ndarray]]
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
    """

    name: str
    refocus: Refocus
    options: tuple[str, ...]
    waves: bool


METHODS: dict[str, Method] = {}


def method(name: str, *, options: tuple[str, ...], waves: bool) -> Callable[[Refocus], Refocus]:
    """Register a function as a `Method`.

    Parameters
    ----------
    name : str
        As users call it.
    options : tuple of str
        The options of `reconstruct` that it takes.
    waves : bool
        Whether it needs wavelengths.
    """

    def register(refocus: Refocus) -> Refocus:
        METHODS[name] = Method(name, refocus, options, waves)
        return refocus

    return register
