"""Random patterns for the surfaces of generated scenes."""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

_TEXELS = (64, 512)
"""Texels along an edge, at least and at most."""

_PER_LENS = 4
"""Texels to a lens, where that many are allowed."""

_DETAIL = (0.2, 2.0)
"""Size of a pattern's details, in lenses, evenly in its logarithm: from below what the lenses tell apart to coarse."""

_DARKEST, _BRIGHTEST = 0.02, 0.95
"""Bounds of a reflectance."""


def random_diffuse(random: np.random.Generator, plain: float, width: float) -> dict[str, Any]:
    """Describe a diffuse surface with a random pattern for ``mi.load_dict``.

    Band-limited noise or a checkerboard; in variants of three channels between two random colours.

    Parameters
    ----------
    random : numpy.random.Generator
        Source of what is random.
    plain : float
        Probability that there is no pattern.
    width : float
        Of the surface, in lens pitches where it stands.

    Returns
    -------
    dict
        A ``diffuse`` on both sides.
    """
    # All are drawn, whichever is used, so that what follows does not depend on it.
    is_plain, is_noise = random.random() < plain, random.random() < 0.75
    level = random.uniform(0.1, 0.8)
    detail = math.exp(random.uniform(math.log(_DETAIL[0]), math.log(_DETAIL[1])))
    colours = random.uniform(_DARKEST, _BRIGHTEST, (2, 3)).astype(np.float32)
    texels = int(np.clip(_PER_LENS * width, *_TEXELS))
    field = random.normal(size=(texels, texels))
    if is_noise:
        field = gaussian_filter(field, min(detail * texels / width, texels / 4), mode="wrap")
        pattern = 0.45 + 0.22 * field / field.std()
    else:
        cells = int(np.clip(width / (2 * detail), 2, texels / 2))
        row, column = np.indices(field.shape) * cells // texels
        pattern = np.where((row + column) % 2, 0.5 + level / 2, 0.5 - level / 2)
    if is_plain:
        pattern = np.full(field.shape, level)
    pattern = np.clip(pattern, _DARKEST, _BRIGHTEST).astype(np.float32)[..., None]
    coloured = colours[0] + pattern * (colours[1] - colours[0]) if mi.is_rgb else pattern
    texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(coloured)}
    return {"type": "twosided", "surface": {"type": "diffuse", "reflectance": texture}}
