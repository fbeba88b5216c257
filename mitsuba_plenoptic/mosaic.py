"""Mosaics of colour filters: which pixel records which colour."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .camera import PlenopticCamera
from .errors import InputError
from .io.captures import Capture

MOSAICS = ("RGGB", "GRBG", "GBRG", "BGGR")
"""Bayer's mosaic and its turns (Bayer 1976, US patent 3971065), by the filters of the first two rows of two pixels."""


def filters(camera: PlenopticCamera, mosaic: str) -> NDArray[np.int64]:
    """Return the channel, 0 to 2 for red to blue, that each recorded pixel sees."""
    tile = np.array(["RGB".index(letter) for letter in mosaic]).reshape(2, 2)
    left, top = camera.crop_offset
    rows, columns = camera.shape
    return np.asarray(tile[np.ix_((np.arange(rows) + top) % 2, (np.arange(columns) + left) % 2)])


def mosaic_of(capture: Capture) -> str | None:
    """Return the mosaic that a capture was recorded through and still has, None if it has none."""
    exposure = capture.metadata.get("exposure")
    mosaic = exposure.get("mosaic") if isinstance(exposure, dict) else None
    return mosaic if mosaic in MOSAICS and capture.image.ndim == 2 else None


def require_demosaiced(capture: Capture) -> None:
    """Refuse a capture whose pixels have colours of their own, for work that takes them for one."""
    mosaic = mosaic_of(capture)
    if mosaic is not None:
        raise InputError(f"mosaic = {mosaic}: each pixel of the capture has one colour; demosaic it first")
