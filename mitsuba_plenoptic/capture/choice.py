"""Which way to compute a wave capture is possible, and the quicker one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics.fitted_lens import farthest_points, lens_of_rays, lens_of_waves
from ..optics.main_lens import MainLens, main_lens
from ..optics.open_pupil import pupil_bound
from .accuracy import WAVES_PER_ERROR
from .bank import near_weight
from .bank.blend import blur_of
from .bank.radial import distance_of
from .lens_window import LensWindow
from .patch_plan import patches_fit
from .sharing import patterns_at
from .sight import Sight

_PROBES = 2**14
"""Rays by which the scene's distances are found."""

_BLUR = 13.0
"""Lenses of blur from which on the time of a patch grows with their area."""

_BANK, _BANK_PER_PIXEL = 4000, 0.004
"""Patches blurred over `_BLUR` lenses that take as long as learning a bank, and as its rays to a pixel, about.

Rough figures for the camera of the paper; `tools/benchmark.py --only choice` shows both ways side by side.
"""


@dataclass(frozen=True)
class Probes:
    """Light along rays from the pupil to evenly spread places of the array.

    Attributes
    ----------
    radiance : float32 array (channels, n)
        For each channel.
    vergence : float32 array (n,)
        Of the image of the point that each ray meets, in 1/mm.
    """

    radiance: NDArray[np.float32]
    vergence: NDArray[np.float32]

    @classmethod
    def of(cls, camera: PlenopticCamera, sight: Sight, seed: int) -> Probes:
        """Trace them."""
        # It takes a third of the package's loading time.
        from scipy.stats import qmc

        window, lens = LensWindow.of(camera), lens_of_rays(camera)
        places = qmc.Sobol(4, scramble=True, rng=seed).random(_PROBES).astype(np.float32)
        x, y, s, t = (mi.Float(np.ascontiguousarray(column)) for column in places.T)
        q = [
            mi.Float(low) + part * float(high - low)
            for part, low, high in zip((x, y), window.low, window.high, strict=True)
        ]
        P = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(s, t)) * pupil_bound(camera)
        point, slope, is_open = lens.ray((P.x, P.y), (q[0], q[1]))
        radiance, distance = sight.look(point, slope, seed)
        channels = [np.broadcast_to(dr.select(is_open, channel, 0).numpy(), _PROBES) for channel in radiance]
        return cls(np.stack(channels), np.broadcast_to(lens.vergence(point[2] + distance).numpy(), _PROBES))


def bank_is_better(
    camera: PlenopticCamera, sight: Sight, wavelength: float, per_lens: int, accuracy: float, seed: int
) -> bool:
    """Find whether patches would be too large, or a kernel bank records sooner than they what is out of focus.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    sight : Sight
        The scene.
    wavelength : float
        Wavelength in nanometres.
    per_lens : int
        Radiators in a lens, of all passes.
    accuracy : float
        Allowed relative error; at 0 nothing may be the bank's.
    seed : int
        Of the random numbers.
    """
    if accuracy == 0:
        return False
    lens = lens_of_rays(camera)

    def too_large(vergences: NDArray[np.floating], found: float) -> bool:
        ends = np.array([vergences.min(), vergences.max()], np.float64)
        return not patches_fit(camera, wavelength, accuracy, distance_of(lens, ends), int(found))

    window = len(LensWindow.of(camera).index)
    count, worth = per_lens * window, _BANK + _BANK_PER_PIXEL * math.prod(camera.shape)
    few = count * _most_work(camera) <= worth
    # What the scene's size tells costs no rays; mirrors show what is beyond it.
    if few and sight.optics.plain and not too_large(np.array(sight.vergences(lens)), 1):
        return False
    probes = Probes.of(camera, sight, seed)
    far = (probes.radiance.max(0) > 0) * (1 - near_weight(camera, probes.vergence, accuracy))
    lit = far > 0
    if not lit.any():
        return False
    found = count * float(lit.mean())
    # The patches of few are wider, and there may be fewer than the probes tell.
    if too_large(probes.vergence[lit], found / 2):
        return True
    blurred = np.maximum(1, np.abs(blur_of(camera, probes.vergence)) / _BLUR) ** 2
    distances = distance_of(lens, probes.vergence[lit].astype(np.float64))
    waves = _lens_of_waves(camera, distances, wavelength)
    patterns = min(found, patterns_at(camera, waves, distances, window, wavelength, accuracy * WAVES_PER_ERROR))
    return patterns * float((far * blurred)[lit].mean()) > worth


def _lens_of_waves(camera: PlenopticCamera, distances: NDArray[np.float64], wavelength: float) -> MainLens:
    """Return the main lens for all points at some distances that a detector sees."""
    if camera.prescription is None:
        return main_lens(camera)
    ends = farthest_points(camera, wavelength, (float(distances.min()), float(distances.max())))
    return lens_of_waves(camera, ends, wavelength)


def _most_work(camera: PlenopticCamera) -> float:
    """Return the largest work of a radiator over that of one blurred over `_BLUR` lenses, for light from infinity."""
    blur = abs(blur_of(camera, lens_of_rays(camera).vergence(math.inf)))
    return float(max(1.0, blur / _BLUR) ** 2)
