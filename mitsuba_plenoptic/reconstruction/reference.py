"""White captures by which images are divided: which ones suit a capture."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..errors import InputError, shown
from ..io.captures import Capture, as_array, require_pixels, require_suitable_white
from ..lightfield.white import scaled_white
from ..mosaic import require_demosaiced
from .ray_sums import white_pixels


def reference_white(white: Any, capture: Capture, recorded: Any) -> np.ndarray:
    """Return a white capture as an array with the channels of the capture that it is to divide.

    Parameters
    ----------
    white : Capture or array
        What is given for it.
    capture : Capture
        The capture, with the camera by which it is refocused.
    recorded : Capture or array
        The same with the camera that it was recorded with, if it has one.

    Returns
    -------
    (rows, columns, channels) float32 array
        Scaled to a radiance of 1, see `lightfield.white.white_radiance`.

    Raises
    ------
    InputError
        If it has other pixels than the capture, or was recorded by another camera, by waves for a capture by rays, at
        other wavelengths, or through a mosaic; or if it is saturated, or does not fill the view.
    """
    pixels = white.image if isinstance(white, Capture) else as_array("white", white)
    require_pixels("white", pixels)
    image = np.atleast_3d(capture.image)
    if pixels.shape not in {image.shape[:2], (*image.shape[:2], 1), image.shape}:
        raise InputError(f"white of shape {pixels.shape}: it must have the pixels of the capture, {image.shape[:2]}")
    if isinstance(white, Capture):
        require_demosaiced(white)
        own = [taken.camera for taken in (capture, recorded) if isinstance(taken, Capture)]
        require_suitable_white(white, own)
        _require_same_light(white, capture, image.shape[2])
    scaled = scaled_white(np.atleast_3d(pixels), white_pixels(capture.camera), capture.camera)
    return np.ascontiguousarray(np.broadcast_to(scaled, image.shape))


def _require_same_light(white: Capture, capture: Capture, channels: int) -> None:
    """Refuse a white by waves that lost other parts of the light at the edges of its micro-images."""
    if white.model == "wave" and capture.model != "wave":
        raise InputError("white: it was captured by waves, and the capture by rays, which lose no light at edges")
    if white.wavelength is None or capture.wavelength is None:
        return
    theirs, own = (np.broadcast_to(light, channels) for light in (white.wavelength, capture.wavelength))
    if not np.array_equal(theirs, own):
        raise InputError(
            f"white of {shown(white.wavelength)} nm: the capture is of {shown(capture.wavelength)} nm; it must be of "
            "the same wavelengths"
        )
