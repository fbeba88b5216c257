"""From sums over bins to radiance, by one rule for all methods and lattices.

A bin is divided by what it gets of white in the same way: of a white capture of the same camera where there is one,
else of the white that the camera would record. So a white scene reads 1 everywhere, at the borders too, where part of
the light misses the detector. A bin that gets less than a hundredth of the rays that the best one gets is not reached:
there is next to nothing to be divided, and it is NaN, for every method alike. Between the footprints of lenses, fine
bins may get little light of waves though many rays reach them: by the computed white, which is least sure of them, they
are not brightened without end. A white capture knows what they get, and where waves interfere; it also tells from
where beside them bins get their light (see `mitsuba_plenoptic.reconstruction.displacement`), and the image is drawn
back from there.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint
from ..errors import InputError
from ..runtime.fft import blur, convolve
from .displacement import brought_back, displacements, is_known, tilt, tilted_whites
from .methods import Progress, Task, portion

_LEAST_REACHED = 0.01

_LEAST_WHITE = 0.25
"""Fraction of the light that as many rays usually bring, as which no bin's computed white counts less."""


def captures(task: Task) -> Iterator[tuple[np.ndarray, Sequence[float], Progress]]:
    """Yield what a method has to sum over bins, (rows, columns, channels), with the distances and the progress of it.

    That is the capture and, where there is one, the white capture; where displacements are known, too, for every
    distance two that are made of it.
    """
    work = [(task.image, task.distances)] + ([] if task.white is None else [(task.white, task.distances)])
    tilted: Iterator[tuple[float, np.ndarray]] = iter(())
    steps = len(work)
    if task.white is not None and is_known(task.camera):
        steps += 2 * len(task.distances)
        tilted = tilted_whites(task.white, task.camera, task.distances, task.recorded)
    made = itertools.chain(work, ((image, [distance]) for distance, image in tilted))
    for done, (image, distances) in enumerate(made):
        yield image, distances, portion(task.progress, done, steps)


def to_radiance(
    task: Task, sums: Sequence[Sequence[np.ndarray]], white: Sequence[np.ndarray], reach: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Divide the sums of a capture over bins by those of white; NaN where no light can come from.

    Parameters
    ----------
    task : Task
        With the white capture if there is one.
    sums : sequence of sequences of (rows, columns, channels) arrays
        For each of the `captures` of the task the sums over bins at its distances.
    white : sequence of arrays (rows, columns) or (rows, columns, channels)
        What the bins get of the white that the camera would record, for every distance; with a white capture it is
        not looked at.
    reach : sequence of (rows, columns) arrays
        Pixels of white whose rays reach the bins, for every distance.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance.
    """
    light, *others = sums
    whites = white if task.white is None else others.pop(0)
    images = []
    for number, (distance, total, own, rays) in enumerate(zip(task.distances, light, whites, reach, strict=True)):
        divisor, reached = divisors(own, rays, distance, computed=task.white is None)
        image = _divided(total, divisor, reached)
        if others:
            rising = [_divided(found, divisor, reached) for (found,) in others[2 * number : 2 * number + 2]]
            moved = displacements(rising, tilt(task.camera, distance)[0], task.camera, task.oversample)
            image = brought_back(image, moved, np.broadcast_to(divisor, image.shape), task.oversample)
        images.append(image.astype(np.float32, copy=False))
    return images


def _divided(total: np.ndarray, divisor: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Divide the bins that are reached; the others are NaN."""
    image = np.full(total.shape, np.nan, np.float32)
    np.divide(total, divisor, out=image, where=np.broadcast_to(reached, total.shape), casting="same_kind")
    return image


def divisors(white: np.ndarray, rays: np.ndarray, distance: float, *, computed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return by what the sums over bins of a plane are divided, and which bins are."""
    white = np.atleast_3d(white)
    reached = is_reached(rays)[..., None] & (white > 0)
    if not reached.any():
        raise InputError(f"distance = {distance:g}: no light comes from any of the {rays.size} bins there")
    if computed:
        # Both sums are of all bins, since light that misses one of them is in another.
        usual = white.sum() / (float(rays.sum()) * white.shape[2])
        white = np.maximum(white, _LEAST_WHITE * usual * rays[..., None])
    return white, reached


def is_reached(rays: np.ndarray) -> np.ndarray:
    """Return which bins get enough of the rays of white, (rows, columns), to be divided by what they get."""
    return np.asarray((rays >= _LEAST_REACHED * rays.max()) & (rays > 0))


def lens_scale(camera: PlenopticCamera, distance: float) -> float:
    """Part of a lens over which its light is spread: all for an unfocused one, none where a focused one is sharp."""
    if focus_type(camera) == "unfocused":
        return 1.0
    return min(lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths)


class LensSpread:
    """The spread of the light of each lens over its aperture, enlarged by `scale`, and the sum of fine bins to bins.

    A lens has gathered light over its aperture. Where a lens lies on every bin spreading it would change nothing in
    focus; elsewhere the light of all of a lens would go to the one bin that holds its centre, and some bins would get
    none.
    """

    def __init__(self, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0) -> None:
        self._aperture = camera.lattice.aperture_image(camera.mla_pitch / (oversample * fine), scale)
        self._fine = fine

    def forward(self, power: np.ndarray) -> np.ndarray:
        """Spread the power of fine bins, and sum it to bins."""
        rows, columns = (size // self._fine for size in power.shape)
        return blur(power, self._aperture).reshape(rows, self._fine, columns, self._fine).sum((1, 3))

    def vjp(self, bins: np.ndarray) -> np.ndarray:
        """Apply the transpose of `forward`."""
        fine = bins.repeat(self._fine, 0).repeat(self._fine, 1)
        whole = convolve(fine, self._aperture[::-1, ::-1])
        rows, columns = (k - 1 - (k - 1) // 2 for k in self._aperture.shape)
        return whole[rows : rows + fine.shape[0], columns : columns + fine.shape[1]]


def over_lenses(
    power: np.ndarray, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0
) -> np.ndarray:
    """Spread fine bins over lenses; the rounding of the transform below zero is not light."""
    return LensSpread(camera, oversample, fine, scale).forward(power).clip(min=0)
