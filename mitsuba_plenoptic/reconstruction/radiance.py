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

from collections.abc import Callable, Sequence

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint
from ..errors import InputError
from ..runtime.fft import blur, convolve
from .displacement import brought_back, displacements, is_known, tilted_whites
from .methods import Progress, Task

_LEAST_REACHED = 0.01

_LEAST_WHITE = 0.25
"""Fraction of the light that as many rays usually bring, as which no bin's computed white counts less."""

Sums = Callable[[np.ndarray, Sequence[float], Progress], list[np.ndarray]]
"""From a capture (rows, columns, channels) and distances to the sums (rows, columns, channels) over their bins."""


def to_radiance(
    task: Task, sums: Sums, *, model: Callable[[], Sequence[np.ndarray]], reach: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Divide the sums of a capture by those of white.

    Parameters
    ----------
    task : Task
        With the capture, and the white capture if there is one.
    sums : callable
        Sums of a capture over bins.
    model : callable
        Returns what the bins get of the white that the camera would record, for every distance; arrays (rows, columns)
        or (rows, columns, channels).
    reach : sequence of (rows, columns) arrays
        Pixels of white whose rays reach the bins, for every distance.

    Returns
    -------
    list of (rows, columns, channels) float32 arrays
        Radiance; NaN where no light can come from.

    Raises
    ------
    InputError
        If light comes from none of a plane's bins.
    """
    drawn_back = task.white is not None and is_known(task.camera)
    steps = (1 if task.white is None else 2) + 2 * drawn_back * len(task.distances)
    done = 0

    def summed(image: np.ndarray, distances: Sequence[float]) -> list[np.ndarray]:
        nonlocal done
        found = sums(image, distances, lambda part: task.progress((done + part) / steps))
        done += 1
        return found

    light = summed(task.image, task.distances)
    whites = model() if task.white is None else summed(task.white, task.distances)
    images = []
    for distance, total, white, rays in zip(task.distances, light, whites, reach, strict=True):
        white, reached = divisors(white, rays, distance, computed=task.white is None)
        image = _divided(total, white, reached)
        if drawn_back and task.white is not None:
            rising = list(tilted_whites(task.white, task.camera, distance, task.recorded))
            seen = [_divided(summed(capture, [distance])[0], white, reached) for capture, _ in rising]
            moved = displacements(seen, [slope for _, slope in rising], task.camera, task.oversample)
            image = brought_back(image, moved, np.broadcast_to(white, image.shape), task.oversample)
        images.append(image.astype(np.float32, copy=False))
    return images


def _divided(total: np.ndarray, divisor: np.ndarray, reached: np.ndarray) -> np.ndarray:
    """Divide the bins that are reached; the others are NaN."""
    image = np.full(total.shape, np.nan, np.float32)
    np.divide(total, divisor, out=image, where=np.broadcast_to(reached, total.shape), casting="same_kind")
    return image


def divisors(white: np.ndarray, rays: np.ndarray, distance: float, *, computed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return by what the sums over bins of a plane are divided, and which bins are.

    Parameters
    ----------
    white : (rows, columns) or (rows, columns, channels) array
        What the bins get of white.
    rays : (rows, columns) array
        Pixels of white whose rays reach them.
    distance : float
        Of the plane.
    computed : bool
        Whether the white is computed, and not recorded.

    Returns
    -------
    divisors, reached : (rows, columns, channels) arrays

    Raises
    ------
    InputError
        If light comes from none of the bins.
    """
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


def over_lenses(
    power: np.ndarray, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0
) -> np.ndarray:
    """Spread what comes from each lens over its aperture, enlarged by `scale`, and sum fine bins to bins.

    A lens has gathered light over its aperture. Where a lens lies on every bin spreading it would change nothing in
    focus; elsewhere the light of all of a lens would go to the one bin that holds its centre, and some bins would get
    none.
    """
    # the transform's rounding is not light
    return _spread(power, _aperture(camera, oversample, fine, scale), fine).clip(min=0)


class LensSpread:
    """`over_lenses` as a function with derivatives, which does nothing where there is a lens on each bin.

    Parameters
    ----------
    camera, oversample, fine
        As of `over_lenses`.
    distance : float
        Object distance, which tells the scale.
    """

    def __init__(self, camera: PlenopticCamera, distance: float, oversample: int, fine: int) -> None:
        self._aperture, self._fine = None, fine
        if fine > 1:
            self._aperture = _aperture(camera, oversample, fine, lens_scale(camera, distance))

    def at(self, power: np.ndarray) -> SpreadBins:
        """Spread a power."""
        return SpreadBins(self._aperture, self._fine, power)


class SpreadBins:
    """A power in bins, spread over lenses, and its derivatives there.

    Attributes
    ----------
    bins : (rows, columns) array
        The power.
    """

    def __init__(self, aperture: np.ndarray | None, fine: int, power: np.ndarray) -> None:
        self._aperture, self._fine = aperture, fine
        spread = power if aperture is None else _spread(power, aperture, fine)
        self._lit = spread > 0
        self.bins = np.where(self._lit, spread, 0)

    def tangent(self, change: np.ndarray) -> np.ndarray:
        """Return the change of the bins with that of the power."""
        spread = change if self._aperture is None else _spread(change, self._aperture, self._fine)
        return np.where(self._lit, spread, 0)

    def back(self, bins: np.ndarray) -> np.ndarray:
        """Apply the transpose of `tangent`."""
        bins = np.where(self._lit, bins, 0)
        if self._aperture is None:
            return bins
        rows, columns = ((k - 1) // 2 for k in self._aperture.shape)
        fine = bins.repeat(self._fine, 0).repeat(self._fine, 1)
        whole = convolve(fine, self._aperture[::-1, ::-1])
        first = [k - 1 - middle for k, middle in zip(self._aperture.shape, (rows, columns), strict=True)]
        return whole[first[0] : first[0] + fine.shape[0], first[1] : first[1] + fine.shape[1]]


def _aperture(camera: PlenopticCamera, oversample: int, fine: int, scale: float) -> np.ndarray:
    """Return what light of a lens is spread over, on fine bins."""
    return camera.lattice.aperture_image(camera.mla_pitch / (oversample * fine), scale)


def _spread(power: np.ndarray, aperture: np.ndarray, fine: int) -> np.ndarray:
    """Spread fine bins, and sum them to bins."""
    rows, columns = (size // fine for size in power.shape)
    return blur(power, aperture).reshape(rows, fine, columns, fine).sum((1, 3))
