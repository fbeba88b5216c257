"""Images as pictures: the value drawn as white, and PNG files."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..choices import ANIMATED
from ..errors import InputError, put_checked, require_number
from ..runtime import Array, Named, atomic_output

SHOWN = (".png", ".pdf", *ANIMATED)
"""Suffixes of files that show radiances as brightness."""

LONGEST = 960
"""Pixels of a picture's longer side up to which small images are enlarged by default."""


def write_png(path: str | Path, image: Array, *, peak: float | None = None) -> None:
    """Write a linear image as an 8-bit PNG, encoded by `to_bytes`; a file is replaced only by a complete one."""
    with atomic_output(path, ".png") as temporary:
        Image.fromarray(to_bytes(image, peak)).save(temporary, format="PNG")


def to_bytes(image: Array, peak: float | None = None) -> Array:
    """Return a linear image (rows, columns[, 3]) encoded in 8 bits, sRGB.

    `peak`, by default the image's maximum, becomes white; negative values and NaN become black.
    """
    values = np.nan_to_num(np.asarray(image, dtype=np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    if peak is None:
        peak = float(values.max())
    # An image that is all black stays so.
    values = np.clip(values / peak, 0, 1) if peak > 0 else np.zeros_like(values)
    return np.round(255 * srgb(values)).astype(np.uint8)


def luminance(image: Array) -> Array:
    """Return the luminance (rows, columns) of an image (rows, columns[, 3]) in linear sRGB."""
    return image if image.ndim == 2 else image @ np.array([0.2126, 0.7152, 0.0722], image.dtype)


def encode(image: Array, bits: int, full: float) -> Named:
    """Return a linear image (rows, columns[, 3]) as the URL of a PNG from which a page reads the values.

    The values from 0 to `full`, encoded in sRGB, are integers of 8 or 16 bits; of 16 bits, the upper eight are stored
    above the lower eight in one picture. NaN is transparent. Values out of range are clipped.
    """
    finite = np.isfinite(image if image.ndim == 2 else image.sum(axis=2))
    values = np.where(finite.T, image.T, 0).T
    codes = np.rint((2**bits - 1) * srgb(np.clip(values / full, 0, 1))).astype(np.uint16)
    pixels = (codes if bits == 8 else np.concatenate([codes >> 8, codes & 255])).astype(np.uint8)
    if not finite.all():
        opaque = np.tile(finite, (bits // 8, 1)).astype(np.uint8) * 255
        pixels = np.dstack([pixels, opaque])
    source = data_url("png", encoded(Image.fromarray(pixels), format="PNG"))
    return {"source": source, "bits": bits, "full": full, "channels": 1 if image.ndim == 2 else 3}


def encoded(picture: Image.Image, **options: Any) -> bytes:
    """Return the content of a picture's file, by Pillow's options for saving it."""
    buffer = io.BytesIO()
    picture.save(buffer, **options)
    return buffer.getvalue()


def data_url(kind: str, content: bytes) -> str:
    """Return the URL that holds the content of a picture's file."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def enlarge(image: Array, scale: int) -> Array:
    """Return an image with each pixel repeated `scale` times along both axes."""
    return image.repeat(scale, axis=0).repeat(scale, axis=1)


def enlargement(image: Array, longest: int = LONGEST) -> int:
    """Return the integer factor, at least 1, that makes an image's longer side at most `longest` pixels."""
    return max(1, longest // max(image.shape[:2]))


def shrink(image: Array, longest: int) -> Array:
    """Return an image averaged over whole blocks of pixels until neither side is longer than `longest`."""
    rows, columns = image.shape[:2]
    factor = -(-max(rows, columns) // longest)
    if factor == 1:
        return image
    # A long and narrow image keeps at least one block on its short side.
    down = min(factor, rows)
    across = min(factor, columns)
    divisible = image[: rows // down * down, : columns // across * across]
    blocks = divisible.reshape(rows // down, down, columns // across, across, *image.shape[2:])
    return blocks.mean(axis=(1, 3), dtype=np.float32)


def srgb(linear: Array) -> Array:
    """Return linear values from 0 to 1 encoded as sRGB (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class Brightness:
    """Rule for the value drawn as white; brighter values are white, too.

    Parameters
    ----------
    exposure : float, optional
        In stops, the same for every picture: the value 2^-exposure becomes white, 1 at 0.
    percentile : float, optional
        Instead, the percentage of the bins or pixels that do not surpass the value, above 0 and up to 100. Default:
        99.5 without an exposure, or less where highlights would darken a picture that is lit all over. If the value is
        black, the brightest becomes white.
    """

    exposure: float | None = None
    percentile: float | None = None

    def __post_init__(self) -> None:
        if self.exposure is not None and self.percentile is not None:
            raise InputError(f"exposure = {self.exposure:g}, percentile = {self.percentile:g}: give one of the two")
        stops = partial(require_number, minimum=-100.0, maximum=100.0)
        put_checked(self, exposure=stops, percentile=partial(require_number, positive=True, maximum=100))

    def peak(self, images: Sequence[Array]) -> float:
        """Return the value drawn as white in pictures that are viewed together; NaN is ignored."""
        if self.exposure is not None:
            return float(2.0**-self.exposure)
        values = np.concatenate([image[np.isfinite(image)] for image in images])
        if not values.size:
            return 1.0
        percentile = 99.5 if self.percentile is None else self.percentile
        # A lamp in sight covers more than the rest of the percentile once it is out of focus. White of a picture that
        # is lit all over is at most five times the 90th percentile. Stars and letters on black, whose surroundings are
        # even, too, have less than a tenth of their light there.
        half, most, value = np.percentile(values, (50, 90.0, percentile))
        if self.percentile is None and most <= 10.0 * half:
            shared = values[values <= most].sum(dtype=np.float64) >= 0.1 * values.sum(dtype=np.float64)
            value = min(value, 5.0 * most) if shared else value
        return next((float(candidate) for candidate in (value, values.max()) if candidate > 0), 1.0)


@dataclass(frozen=True)
class Drawing:
    """Settings for drawing pictures: exposure, scale, whether to draw a figure, and its dots per inch."""

    brightness: Brightness = Brightness()
    # Pixels that a bin is wide; None: as suits the picture.
    scale: int | None = None
    # Whether a PNG is a labelled figure; a PDF always is.
    figure: bool = False
    # Dots per inch of a figure in a PNG; None: as figures of papers have.
    dpi: int | None = None

    def is_figure(self, path: Path) -> bool:
        """Return whether a file is written as a labelled figure."""
        return self.figure or path.suffix.lower() == ".pdf"
