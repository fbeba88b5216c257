"""Pictures of 8 and 16 bits a channel, to and from linear values."""

from __future__ import annotations

import struct
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

from ..errors import refusing
from ..runtime.files import atomic_output, native_output_dropped, require_file
from ..runtime.limits import require_memory

TIFF = (".tif", ".tiff")

# Bytes of a pixel while it is read: up to four channels of 16 bits, and these and three of them in single precision.
_PIXEL_BYTES = 8 + 16 + 12


def read_picture(path: str | Path, *, linear: bool = False) -> np.ndarray:
    """Return a PNG or TIFF of 8 or 16 bits a channel; TIFF files must be grey or have 8 bits.

    Parameters
    ----------
    path : path
        File to read.
    linear : bool
        Whether the values are proportional to light, as in raw data, instead of encoded in sRGB.

    Returns
    -------
    (rows, columns[, 3]) float32 array
        Linear values from 0 to 1; without a channel axis where the picture is grey. Transparency is dropped.

    Raises
    ------
    InputError
        If the file does not exist, is neither, is damaged, or would take more memory than is allowed.
    """
    path = require_file(path)
    require_memory(2 * path.stat().st_size, f"{path}: {path.stat().st_size} bytes")
    if path.suffix.lower() in TIFF:
        with refusing(f"{path}: it cannot be read as a TIFF picture:"), Image.open(path) as picture:
            require_memory(float(_PIXEL_BYTES) * picture.width * picture.height, f"{path}: its pixels")
            wide = picture.mode.startswith("I")
            values = np.asarray(picture if wide or picture.mode in ("L", "RGB") else picture.convert("RGB"))
        image = values.astype(np.float32) / np.float32(65535 if wide else 255)
        return image if linear else linear_of(image).astype(np.float32)
    with refusing(f"{path}: it cannot be read as a PNG picture:"):
        with path.open("rb") as file:
            head = file.read(24)
        if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR":
            raise ValueError("it does not begin as a PNG file")
        columns, rows = struct.unpack(">II", head[16:])
        require_memory(float(_PIXEL_BYTES) * columns * rows, f"{path}: {columns} x {rows} pixels")
        with native_output_dropped():
            bitmap = mi.Bitmap(str(path))
        bitmap.set_srgb_gamma(not linear)
        grey = bitmap.pixel_format() in (mi.Bitmap.PixelFormat.Y, mi.Bitmap.PixelFormat.YA)
        kind = mi.Bitmap.PixelFormat.Y if grey else mi.Bitmap.PixelFormat.RGB
        values = np.array(bitmap.convert(kind, mi.Struct.Type.Float32, srgb_gamma=False), dtype=np.float32)
    return values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values


def linear_of(encoded: np.ndarray) -> np.ndarray:
    """Return linear values for values from 0 to 1 that are encoded in sRGB (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def write_picture(path: str | Path, image: np.ndarray) -> None:
    """Write linear values (rows, columns[, 3]), clipped to 0 to 1, as a PNG of 16 bits a channel in sRGB encoding."""
    bitmap = mi.Bitmap(np.ascontiguousarray(np.clip(image, 0, 1), dtype=np.float32))
    encoded = bitmap.convert(bitmap.pixel_format(), mi.Struct.Type.UInt16, srgb_gamma=True)
    with atomic_output(path, ".png") as temporary:
        encoded.write(str(temporary))
