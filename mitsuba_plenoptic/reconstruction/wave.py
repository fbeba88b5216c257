"""The wave methods: which route they take, and how their images come in units of radiance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from ..camera import PlenopticCamera
from ._plan import Plan, plan
from .coherent import lit_window, reconstruct_subsets
from .lens_by_lens import Tile, reconstruct_lens_by_lens, tile_lenses, white_bins, white_throughput
from .ray import LEAST_WEIGHT, pixels_per_bin

Interleave = int | str
"""Period of a subset of lenses along each axis, or "auto"."""

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
    if period is None:
        power = reconstruct_lens_by_lens(
            image, camera, distances, wavelength, relay=relay, oversample=oversample, progress=progress
        )
    else:
        power = reconstruct_subsets(
            image,
            camera,
            distances,
            wavelength,
            interleave=period,
            relay=relay,
            oversample=oversample,
            progress=progress,
        )
    white = pixels_per_bin(camera, oversample)
    if camera.kind == "unfocused":
        white *= white_throughput(camera, wavelength, relay=relay)
        return [(total / white).astype(np.float32) for total in power]
    whites = (white_bins(camera, wavelength, g, relay=relay, oversample=oversample) for g in distances)
    return [
        (total / np.maximum(bins, LEAST_WEIGHT * white)).astype(np.float32)
        for total, bins in zip(power, whites, strict=True)
    ]


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
