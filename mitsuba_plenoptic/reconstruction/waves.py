"""What the wave methods share: channel by channel, from power in fine bins to units of radiance."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from ..camera import PlenopticCamera
from ..system.optical_system import OpticalSystem
from .conjugates import Conjugates, RealConjugates, ThinConjugates, behind_thin_lens, undistorted
from .lens_tiles import Tile
from .methods import Progress, Task
from .radiance import lens_scale, over_lenses, to_radiance
from .ray_sums import white_sums
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
        judged: bool,
        progress: Progress,
        conjugates: Conjugates,
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
        judged : bool
            Whether guards are told of the light that is lost.
        progress : callable
            Called with the fraction of the work that is done.
        conjugates : Conjugates
            The main lens.

        Returns
        -------
        list of (rows, columns) float64 arrays
            In pixel values times pixels.
        """


def refocus_by_waves(task: Task, power: Power, *, relay: bool) -> list[np.ndarray]:
    """Refocus every channel.

    An amplitude is the square root of a pixel. Pixels below zero, which `expose` makes of dark ones, are refocused
    apart, by their magnitude, and what they give is subtracted: so noise of mean zero leaves no light on average.

    The white that bins are divided by, if there is no white capture, is that of rays: without interference, less what
    waves lose of a micro-image at the edge of the pupil.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance.
    """
    camera = task.camera
    rays = [white_sums(camera, g, camera.lit_radius, "lens", task.oversample) for g in task.distances]

    def sums(image: np.ndarray, distances: Sequence[float], progress: Progress) -> list[np.ndarray]:
        of_distances = dataclasses.replace(task, distances=distances)
        channels = []
        for number, wavelength in enumerate(task.wavelengths[: image.shape[2]]):

            def part(done: float, number: int = number) -> None:
                progress((number + done) / image.shape[2])

            channels.append(_in_bins(image[..., number], of_distances, wavelength, power, relay, part))
        return [np.stack(planes, axis=-1) for planes in zip(*channels, strict=True)]

    def model() -> list[np.ndarray]:
        def white(wavelength: float, distance: float) -> np.ndarray:
            fine = fine_bins(task.system(wavelength), task.oversample)
            return white_light(camera, wavelength, distance, task.oversample, fine=fine, relay=relay)

        return [np.stack([white(w, g) for w in task.wavelengths], axis=-1) for g in task.distances]

    return to_radiance(task, sums, model=model, reach=rays)


def _in_bins(
    image: np.ndarray, task: Task, wavelength: float, power: Power, relay: bool, progress: Progress
) -> list[np.ndarray]:
    """Return the power in bins, where the light of lenses that do not lie on them is spread over what these cover."""
    if image.min() < 0:
        parts = np.maximum(image, 0), np.maximum(-image, 0)
        bright = _of_amplitudes(parts[0], task, wavelength, power, relay, lambda done: progress(done / 2))
        dark = _of_amplitudes(
            parts[1], task, wavelength, power, relay, lambda done: progress((1 + done) / 2), judged=False
        )
        return [more - less for more, less in zip(bright, dark, strict=True)]
    return _of_amplitudes(image, task, wavelength, power, relay, progress)


def _of_amplitudes(
    image: np.ndarray,
    task: Task,
    wavelength: float,
    power: Power,
    relay: bool,
    progress: Progress,
    *,
    judged: bool = True,
) -> list[np.ndarray]:
    """Return the power in bins of pixels that are not negative."""
    camera, oversample, system = task.camera, task.oversample, task.system(wavelength)
    real, seen, distances = None, camera, task.distances
    if camera.lens_data.traced_surfaces:
        real = RealConjugates.of(system, list(distances), oversample)
        seen, distances = real.camera, [real.distance(distance) for distance in distances]
    fine = fine_bins(system, oversample)
    totals = power(
        image,
        seen,
        distances,
        wavelength,
        relay=relay,
        oversample=oversample * fine,
        judged=judged,
        progress=progress,
        conjugates=real or ThinConjugates(system),
    )
    if real is not None:
        found = []
        for total, distance in zip(totals, task.distances, strict=True):
            moved, scale = undistorted(total, real, camera, distance, oversample * fine)
            found.append(over_lenses(moved, camera, oversample, fine, scale * lens_scale(camera, distance)))
        return found
    if fine == 1:
        return totals
    return [
        over_lenses(total, camera, oversample, fine, lens_scale(camera, distance))
        for total, distance in zip(totals, task.distances, strict=True)
    ]


def fine_bins(system: OpticalSystem, oversample: int) -> int:
    """Return how many fine bins across a bin power is summed in, before it is spread over lenses."""
    camera = system.camera
    if camera.lens_data.traced_surfaces:
        camera = behind_thin_lens(system)
    elif camera.lenses_are_bins:
        return 1
    return Tile(camera, system.wavelength, 1, oversample).samples // oversample
