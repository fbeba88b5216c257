"""Which way to compute a wave capture is the quicker one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics.main_lens import main_lens
from .bank import near_weight
from .bank.blend import blur_of
from .lens_window import LensWindow
from .sight import Sight

_PROBES = 2**14
"""Rays by which the scene's distances are found."""

_BLUR = 13.0
"""Lenses of blur from which on the time of a patch grows with their area."""

_WORTH = 150_000
"""Radiators blurred over `_BLUR` lenses whose patches take as long as learning a bank and tracing its rays, about.

A rough figure for the camera of the paper: full letters, of 70,000 radiators, are quicker by patches, and a full still
life, of 1,150,000, by the bank.
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

        window, lens = LensWindow.of(camera), main_lens(camera)
        places = qmc.Sobol(4, scramble=True, rng=seed).random(_PROBES).astype(np.float32)
        x, y, s, t = (mi.Float(np.ascontiguousarray(column)) for column in places.T)
        q = [
            mi.Float(low) + part * float(high - low)
            for part, low, high in zip((x, y), window.low, window.high, strict=True)
        ]
        P = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(s, t)) * lens.pupil_radius
        radiance, distance = sight.look((P.x, P.y), lens.aim((P.x, P.y), (q[0], q[1])), seed)
        channels = [np.broadcast_to(channel.numpy(), _PROBES) for channel in radiance]
        return cls(np.stack(channels), np.broadcast_to(lens.vergence(distance).numpy(), _PROBES))


def bank_is_quicker(camera: PlenopticCamera, sight: Sight, per_lens: int, accuracy: float, seed: int) -> bool:
    """Estimate from some rays whether a kernel bank records what is out of focus sooner than patches do.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    sight : Sight
        The scene.
    per_lens : int
        Radiators in a lens, of all passes.
    accuracy : float
        Allowed relative error; at 0 nothing may be the bank's.
    seed : int
        Of the random numbers.
    """
    count = per_lens * len(LensWindow.of(camera).index)
    if accuracy == 0 or count <= _WORTH / _most_work(camera):
        return False
    probes = Probes.of(camera, sight, seed)
    far = (probes.radiance.max(0) > 0) * (1 - near_weight(camera, probes.vergence, accuracy))
    work = float(np.mean(far * np.maximum(1, np.abs(blur_of(camera, probes.vergence)) / _BLUR) ** 2))
    return count * work > _WORTH


def _most_work(camera: PlenopticCamera) -> float:
    """Return the largest work of a radiator over that of one blurred over `_BLUR` lenses, for light from infinity."""
    blur = abs(blur_of(camera, main_lens(camera).vergence(math.inf)))
    return float(max(1.0, blur / _BLUR) ** 2)
