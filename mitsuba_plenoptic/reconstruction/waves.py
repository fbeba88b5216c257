"""What the wave methods share: channel by channel, from power in fine bins to units of radiance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from ..camera import PlenopticCamera
from .lens_tiles import Tile
from .methods import Task
from .spread import lens_scale, over_lenses
from .white import white_light


class Power(Protocol):
    """A way back for one channel of a capture."""

    def __call__(
        self,
        image: np.ndarray,
        camera: PlenopticCamera,
        distances: Sequence[float],
        wavelength: float,
        *,
        relay: bool,
        oversample: int,
        progress: Callable[[float], None],
    ) -> list[np.ndarray]:
        """Return the power in each bin of the object planes.

        Parameters
        ----------
        image : (rows, columns) float32 array
            Not negative.
        camera : PlenopticCamera
            The camera, whose lenses are thin parabolic phase elements.
        distances : sequence of floats
            Object distances, which share the way up to the main lens.
        wavelength : float
            Wavelength in nanometres.
        relay : bool
            Whether the microlenses act in the MLA plane.
        oversample : int
            Bins per lens along each axis.
        progress : callable
            Called with the fraction of the work that is done.

        Returns
        -------
        list of (rows, columns) float64 arrays
            In pixel values times pixels.
        """


def refocus_by_waves(task: Task, power: Power, *, relay: bool) -> list[np.ndarray]:
    """Refocus every channel.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance.
    """
    channels = []
    for number, wavelength in enumerate(task.wavelengths):

        def progress(done: float, number: int = number) -> None:
            task.progress((number + done) / len(task.wavelengths))

        channels.append(_refocus(task, number, wavelength, power, relay, progress))
    return [np.stack(planes, axis=-1) for planes in zip(*channels, strict=True)]


def _refocus(
    task: Task, channel: int, wavelength: float, power: Power, relay: bool, progress: Callable[[float], None]
) -> list[np.ndarray]:
    camera, oversample = task.camera, task.oversample
    fine = 1 if camera.lenses_are_bins else Tile(camera, wavelength, 1, oversample).samples // oversample
    totals = power(
        task.image[..., channel],
        camera,
        task.distances,
        wavelength,
        relay=relay,
        oversample=oversample * fine,
        progress=progress,
    )
    images = []
    for distance, total in zip(task.distances, totals, strict=True):
        if fine > 1:
            total = over_lenses(total, camera, oversample, fine, lens_scale(camera, distance))
        white = white_light(camera, wavelength, distance, oversample, fine=fine, relay=relay)
        images.append((total / white).astype(np.float32))
    return images
