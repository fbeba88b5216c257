"""The wave methods: which route they take, and how their images come in units of radiance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint
from ._plan import Plan, plan
from .coherent import lit_window, reconstruct_subsets
from .lens_by_lens import Tile, is_aligned, reconstruct_lens_by_lens, tile_lenses, white_power, white_throughput
from .ray import at_least, lenses_fill_bins, pixels_per_bin, white_bins

Interleave = int | str
"""Period of a subset of lenses along each axis, or "auto"."""

_RAY_BINS = 36
"""Fine bins across a lens in which the rays of a white scene are counted."""

_APART = 2
"""Bins between the geometric images of two lenses that do not interfere, for diffraction."""


def reconstruct_wave(
    image: np.ndarray,
    camera: PlenopticCamera,
    distances: Sequence[float],
    wavelength: float,
    *,
    interleave: Interleave = 1,
    relay: bool = True,
    oversample: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> list[np.ndarray]:
    """Refocus one channel by waves.

    Parameters
    ----------
    image : (rows, columns) float32 array
        The capture, not negative.
    camera : PlenopticCamera
        The camera; its recorded window is the image.
    distances : sequence of floats
        Object distances.
    wavelength : float
        Wavelength in nanometres.
    interleave : int or "auto"
        Period of a subset of lenses along each axis: 1 is fully coherent. With ``"auto"`` no two
        lenses interfere.
    relay : bool
        Whether the microlenses act in the MLA plane.
    oversample : int
        Bins per lens along each axis.
    progress : callable
        Called with the share of the work done.

    Returns
    -------
    list of (rows, columns) float32 arrays
        Radiance.
    """
    period = full_field_period(image, camera, distances, wavelength) if interleave == "auto" else int(interleave)
    fine = 1 if is_aligned(camera) else Tile(camera, wavelength, 1, oversample).samples // oversample
    if period is None:
        power = reconstruct_lens_by_lens(
            image, camera, distances, wavelength, relay=relay, oversample=oversample * fine, progress=progress
        )
    else:
        power = reconstruct_subsets(
            image,
            camera,
            distances,
            wavelength,
            interleave=period,
            relay=relay,
            oversample=oversample * fine,
            progress=progress,
        )
    if fine > 1:
        power = [
            _over_lenses(total, camera, oversample, fine, _lens_scale(camera, distance))
            for total, distance in zip(power, distances, strict=True)
        ]
    whites = (_white(camera, wavelength, distance, oversample, fine, relay) for distance in distances)
    return [(total / white).astype(np.float32) for total, white in zip(power, whites, strict=True)]


def _white(
    camera: PlenopticCamera, wavelength: float, distance: float, oversample: int, fine: int, relay: bool
) -> np.ndarray | float:
    """Power that comes to each bin from a white scene, in pixel values times pixels."""
    unfocused = focus_type(camera) == "unfocused"
    if is_aligned(camera) and not unfocused:
        power = white_power(camera, wavelength, distance, relay=relay, oversample=oversample)
        return at_least(power, camera, oversample)
    throughput = white_throughput(camera, wavelength, relay=relay)
    if lenses_fill_bins(camera) and unfocused:
        return pixels_per_bin(camera, oversample) * throughput
    # Rays go to points, where waves go to spots: the grid on which they are counted must not show.
    fine *= -(-_RAY_BINS // (oversample * fine))
    white = white_bins(camera, distance, oversample * fine)
    white = _over_lenses(white, camera, oversample, fine, _lens_scale(camera, distance))
    return at_least(white, camera, oversample) * throughput


def _lens_scale(camera: PlenopticCamera, distance: float) -> float:
    """Part of a lens over which its light is spread: all for an unfocused one, none where a focused one is sharp."""
    if focus_type(camera) == "unfocused":
        return 1.0
    return min(lens_footprint(camera, distance, f2) for f2 in camera.mla_focal_lengths)


def _over_lenses(
    power: np.ndarray, camera: PlenopticCamera, oversample: int, fine: int, scale: float = 1.0
) -> np.ndarray:
    """Spread what comes from each lens over its aperture, enlarged by `scale`, and sum fine bins to bins.

    A lens has gathered light over its aperture. Where a lens lies on every bin spreading it would change nothing in
    focus; elsewhere the light of all of a lens would go to the one bin that holds its centre, and some bins would get
    none.
    """
    aperture = camera.lattice.aperture_image(camera.mla_pitch / (oversample * fine), scale)
    spread = scipy.signal.oaconvolve(power, aperture, mode="same")
    rows, columns = (size // fine for size in power.shape)
    # the transform's rounding is not light
    return np.asarray(spread.reshape(rows, fine, columns, fine).sum((1, 3))).clip(min=0)


def full_field_period(
    image: np.ndarray, camera: PlenopticCamera, distances: Sequence[float], wavelength: float
) -> int | None:
    """Period at which subsets of lenses do not interfere, where full fields are cheaper than single lenses; else None.

    Full fields are, near focus, where few subsets do; the cost is the number of samples that are transformed.
    """
    lit = lit_window(image, camera)
    if lit is None:
        return 1
    blur = max(camera.blur_diameter(g) for g in distances) / camera.mla_pitch
    period = math.ceil(blur - 1e-6) + _APART
    fields = period**2 * _samples(plan(camera, wavelength, distances, lit))
    tile = Tile(camera, wavelength, tile_lenses(camera, distances), 1)
    lenses = math.prod((end - first) / camera.pixels_per_lens for first, end in lit)
    single = lenses * tile.transformed * len(distances)
    return period if fields < single else None


def _samples(grids: Plan) -> int:
    """Count the samples that one coherent reconstruction transforms."""
    return sum(leg.transformed for leg in (grids.detector, grids.main_lens, *grids.objects))
