"""Which way to compute a wave capture is the quicker one."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

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
    if accuracy == 0:
        return False
    window, lens = LensWindow.of(camera), main_lens(camera)
    if per_lens * len(window.index) <= _WORTH / _most_work(camera):
        return False
    # It takes a third of the package's loading time.
    from scipy.stats import qmc

    places = qmc.Sobol(4, scramble=True, rng=seed).random(_PROBES).astype(np.float32)
    x, y, s, t = (mi.Float(np.ascontiguousarray(column)) for column in places.T)
    q = [
        mi.Float(low) + part * float(high - low)
        for part, low, high in zip((x, y), window.low, window.high, strict=True)
    ]
    P = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(s, t)) * lens.pupil_radius
    radiance, distance = sight.look((P.x, P.y), lens.aim((P.x, P.y), (q[0], q[1])), seed)
    shines = np.max([channel.numpy() for channel in radiance], axis=0) > 0
    vergence = np.broadcast_to(lens.vergence(distance).numpy(), shines.shape)
    far = shines * (1 - near_weight(camera, vergence, accuracy))
    work = float(np.mean(far * np.maximum(1, np.abs(blur_of(camera, vergence)) / _BLUR) ** 2))
    return per_lens * len(window.index) * work > _WORTH


def _most_work(camera: PlenopticCamera) -> float:
    """Return the largest work of a radiator over that of one blurred over `_BLUR` lenses, for light from infinity."""
    blur = abs(blur_of(camera, main_lens(camera).vergence(math.inf)))
    return float(max(1.0, blur / _BLUR) ** 2)
