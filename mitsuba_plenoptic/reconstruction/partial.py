"""Refocusing by waves of interleaved subsets of lenses, whose intensities are added.

Light that passed different microlenses from different scene points never interferes, yet the fields of all lenses of a
coherent reconstruction do (see `mitsuba_plenoptic.reconstruction.coherent`). Fields of lenses in subsets (every K-th
column and row) interfere less; where the lenses of a subset are farther apart than their images are wide, not at all.
That limit is found by full fields with such a period, or lens by lens, whichever costs less.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from .full_fields import lit_window, reconstruct_subsets
from .lens_by_lens import reconstruct_lens_by_lens
from .lens_tiles import Tile, tile_lenses
from .methods import Task, method
from .planning import plan
from .waves import refocus_by_waves

_APART = 2
"""Bins between the geometric images of two lenses that do not interfere, for diffraction."""


@method("partial", options=("interleave", "relay"), waves=True)
def refocus(task: Task, *, interleave: int | str, relay: bool) -> list[np.ndarray]:
    """Follow the light back as one wave for each subset of lenses, or for each lens."""
    if isinstance(interleave, str):
        return refocus_by_waves(task, _without_interference, relay=relay)
    return refocus_by_waves(task, functools.partial(reconstruct_subsets, interleave=interleave), relay=relay)


def _without_interference(
    image: np.ndarray, camera: PlenopticCamera, distances: Sequence[float], wavelength: float, **options: Any
) -> list[np.ndarray]:
    """Add the intensities of all lenses, by the cheaper way."""
    period = full_field_period(image, camera, distances, wavelength)
    if period is None:
        return reconstruct_lens_by_lens(image, camera, distances, wavelength, **options)
    return reconstruct_subsets(image, camera, distances, wavelength, interleave=period, **options)


def full_field_period(
    image: np.ndarray, camera: PlenopticCamera, distances: Sequence[float], wavelength: float
) -> int | None:
    """Period at which subsets of lenses do not interfere, where full fields are cheaper than single lenses; else None.

    Full fields are, near focus, where few subsets do; the cost is the number of samples that are transformed.
    """
    lit = lit_window(image, camera)
    if lit is None:
        return 1
    blur = max(camera.blur_diameter(g) for g in distances) / min(camera.mla_pitches)
    period = math.ceil(blur - 1e-6) + _APART
    tile = Tile(camera, wavelength, tile_lenses(camera, distances), 1)
    lenses = math.prod((end - first) / camera.pixels_per_lens for first, end in lit)
    single = lenses * tile.transformed * len(distances)
    # A field takes at least this; how much more needs grids, of which those of large cameras are not worth planning.
    if period**2 * math.prod(end - first for first, end in lit) >= single:
        return None
    return period if period**2 * plan(camera, wavelength, distances, lit).transformed < single else None
