"""Light of single lenses, spread over what they have gathered it from."""

from __future__ import annotations

import numpy as np

from ..camera import PlenopticCamera
from ..design import focus_type, lens_footprint
from ..runtime.convolve import blur


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
    aperture = camera.lattice.aperture_image(camera.mla_pitch / (oversample * fine), scale)
    spread = blur(power, aperture)
    rows, columns = (size // fine for size in power.shape)
    # the transform's rounding is not light
    return spread.reshape(rows, fine, columns, fine).sum((1, 3)).clip(min=0)
