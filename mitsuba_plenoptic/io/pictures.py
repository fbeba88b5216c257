"""Pictures of other programs, PNG and TIFF, to and from linear values.

Samples mean what the file says (Adobe, "TIFF", revision 6.0; W3C, "Portable Network Graphics", third edition): whole
numbers are encoded, from black to white; floating-point numbers are proportional to light. What has no such meaning is
refused.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import tifffile
from PIL import Image, ImageCms
from tifffile import EXTRASAMPLE, PHOTOMETRIC

from ..errors import refusing, require_number
from ..runtime.files import atomic_output, native_output_dropped, require_file
from ..runtime.limits import require_memory

TIFF = (".tif", ".tiff")

KEY = "mitsuba_plenoptic"
"""Name of the PNG chunk that states camera and detector, and of the object in a TIFF's description."""

# Bytes of a sample while it is read: as a number, in double and in single precision.
_SAMPLE_BYTES = 4 + 8 + 4

_COLOURS = {PHOTOMETRIC.MINISWHITE: 1, PHOTOMETRIC.MINISBLACK: 1, PHOTOMETRIC.RGB: 3, PHOTOMETRIC.PALETTE: 1}
"""Samples of a pixel's colour in TIFF files, by the meanings of samples that are read."""

_ORIENTATION, _PROFILE = 274, 34675
"""Tags of TIFF: how the picture is turned, and the colour profile of the ICC."""


class Picture(NamedTuple):
    """The numbers in a file, (rows, columns[, 3]), and what it says of them."""

    numbers: np.ndarray
    white: float | None  # None for numbers that are proportional to light
    encoding: float | bytes | None  # exponent, colour profile of the ICC, or None for sRGB
    text: str

    def values(self, linear: bool, black_level: float = 0) -> np.ndarray:
        """Return linear values in single precision, 0 at the black level, and 1 where whole numbers are white."""
        black = require_number("black_level", black_level, minimum=0)
        values = self.numbers.astype(np.float64) - black
        if self.white is not None:
            require_number("black_level", black_level, maximum=self.white - 1)
            values /= self.white - black
            if not linear and isinstance(self.encoding, bytes):
                profile = ImageCms.ImageCmsProfile(io.BytesIO(self.encoding))
                name = ImageCms.getProfileDescription(profile).strip()
                if "srgb" not in name.lower():
                    raise ValueError(f"its colour profile is {name}: convert it to sRGB, or to numbers that are linear")
            if not linear:
                values = values ** (1 / self.encoding) if isinstance(self.encoding, float) else linear_of(values)
        return values.astype(np.float32)


def read_picture(path: str | Path, *, linear: bool = False) -> np.ndarray:
    """Return the linear values of a PNG or TIFF, grey or of three colours.

    Parameters
    ----------
    path : path
        File to read, of one picture. Samples are unsigned whole numbers of up to 32 bits or, in TIFF files, floating
        point.
    linear : bool
        Whether whole numbers are proportional to light, as in raw data, instead of encoded in sRGB or by the exponent
        that a PNG states.

    Returns
    -------
    (rows, columns[, 3]) float32 array
        Values from 0 to 1 of whole numbers; floating-point values as they are. Without a channel axis where the picture
        is grey. Transparency is dropped.

    Raises
    ------
    InputError
        If the file does not exist, is neither, is damaged, holds several pictures or samples of another kind, or would
        take more memory than is allowed.
    """
    picture = read_numbers(path)
    with refusing(f"{path}: it cannot be read as a picture:"):
        return picture.values(linear)


def read_numbers(path: str | Path) -> Picture:
    """Return the numbers in a PNG or TIFF; refuse numbers whose meaning the file does not say."""
    path = require_file(path)
    require_memory(2 * path.stat().st_size, f"{path}: {path.stat().st_size} bytes")
    with refusing(f"{path}: it cannot be read as a picture:"):
        return _read_tiff(path) if path.suffix.lower() in TIFF else _read_png(path)


def _read_png(path: Path) -> Picture:
    with path.open("rb") as file:
        head = file.read(24)
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR":
        raise ValueError("it does not begin as a PNG file; write it as .png or .tiff")
    columns, rows = struct.unpack(">II", head[16:])
    require_memory(4.0 * _SAMPLE_BYTES * columns * rows, f"{path}: {columns} x {rows} pixels")
    with Image.open(path, formats=["PNG"]) as described:
        stated, text = described.info, str(described.info.get(KEY, ""))
        if getattr(described, "n_frames", 1) > 1:
            raise ValueError(f"it holds {described.n_frames} pictures: write the one that is meant alone")  # type: ignore[attr-defined]
    with native_output_dropped():
        bitmap = mi.Bitmap(str(path))
    numbers = np.array(bitmap)
    if bitmap.pixel_format() in (mi.Bitmap.PixelFormat.Y, mi.Bitmap.PixelFormat.YA):
        numbers = numbers.reshape(rows, columns, -1)[..., 0]
    encoding = stated.get("icc_profile", None if "srgb" in stated else stated.get("gamma") or None)
    return Picture(numbers[..., :3] if numbers.ndim == 3 else numbers, np.iinfo(numbers.dtype).max, encoding, text)


def _read_tiff(path: Path) -> Picture:
    # Series of these kinds may name other files.
    with tifffile.TiffFile(path, is_ome=False, is_mmstack=False, is_ndtiff=False) as file:
        pages = [page for page in file.pages if not page.is_reduced]
        if not pages:
            raise ValueError("it holds no picture")
        page, colours = pages[0], _COLOURS.get(pages[0].photometric, 0)
        require_memory(_SAMPLE_BYTES * page.size, f"{path}: its pixels")
        held = file.series[0].size if len(pages) == 1 else len(pages) * page.size
        count = page.imagedepth * held // max(page.size, 1)
        kind, bits, extra = page.dtype, page.bitspersample, page.extrasamples
        floats, meaning = kind is not None and kind.kind == "f", getattr(page.photometric, "name", page.photometric)
        turned = page.tags.valueof(_ORIENTATION, default=1)
        for broken, rule in (
            (count != 1, f"it holds {count} pictures: write the one that is meant alone"),
            (not colours, f"its samples mean {meaning}: convert it to grey or RGB"),
            (
                kind is None or kind.kind not in "buf",
                f"its samples are {kind}: write unsigned numbers or floating point",
            ),
            (floats and meaning not in ("MINISBLACK", "RGB"), f"its samples are {kind} and mean {meaning}: black is 0"),
            (turned != 1, f"its orientation is {turned}: write it upright, with orientation 1"),
            (
                len(extra) > 1 or EXTRASAMPLE.UNSPECIFIED in extra or page.samplesperpixel != colours + len(extra),
                f"it has {page.samplesperpixel} channels: write it in grey or RGB",
            ),
        ):
            if broken:
                raise ValueError(rule)
        numbers = _decoded(page, path)
        if "S" in page.axes:
            numbers = np.moveaxis(numbers, page.axes.index("S"), -1)
        numbers = numbers.astype(np.uint8) if kind.kind == "b" else numbers
        white = None if floats else 2**bits - 1
        if EXTRASAMPLE.ASSOCALPHA in extra and (numbers[..., -1] != (white or 1)).any():
            raise ValueError("its colours are multiplied by its transparency: write it without")
        numbers = numbers[..., :colours] if "S" in page.axes else numbers
        numbers = numbers[..., 0] if numbers.ndim == 3 and numbers.shape[2] == 1 else numbers
        if page.photometric == PHOTOMETRIC.MINISWHITE:
            numbers = numbers.dtype.type(white) - numbers
        if page.photometric == PHOTOMETRIC.PALETTE:
            numbers, white = np.moveaxis(page.colormap[:, numbers], 0, -1), 65535
        return Picture(numbers, white, page.tags.valueof(_PROFILE), str(page.description))


def _decoded(page: tifffile.TiffPage, path: Path) -> np.ndarray:
    """Return a page's samples as they are stored, decoded by Pillow where tifffile lacks the means."""
    try:
        return page.asarray()
    except ValueError as error:
        if "imagecodecs" not in str(error):
            raise
        with Image.open(path, formats=["TIFF"]) as picture:
            samples = np.asarray(picture)
        # Pillow converts some kinds as it reads them.
        alike = samples.shape == page.shape and samples.dtype.newbyteorder("=") == page.dtype.newbyteorder("=")
        if not alike or page.bitspersample < 8 or page.photometric == PHOTOMETRIC.MINISWHITE or page.index:
            name = getattr(page.compression, "name", page.compression)
            raise ValueError(f"its compression {name} needs the package imagecodecs: write it without") from None
        return samples


def linear_of(encoded: np.ndarray) -> np.ndarray:
    """Return linear values for values from 0 to 1 that are encoded in sRGB (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def write_picture(path: str | Path, image: np.ndarray) -> None:
    """Write linear values (rows, columns[, 3]), clipped to 0 to 1, as a PNG of 16 bits a channel in sRGB encoding."""
    bitmap = mi.Bitmap(np.ascontiguousarray(np.clip(image, 0, 1), dtype=np.float32))
    encoded = bitmap.convert(bitmap.pixel_format(), mi.Struct.Type.UInt16, srgb_gamma=True)
    with atomic_output(path, ".png") as temporary:
        encoded.write(str(temporary))
