"""Pictures of other programs, PNG and TIFF, to and from linear values.

Samples mean what the file says (Adobe, "TIFF", revision 6.0; W3C, "Portable Network Graphics", third edition): whole
numbers are encoded, from black to white; floating-point numbers are proportional to light. What has no such meaning is
refused.
"""

import contextlib
import math
import struct
from pathlib import Path
from typing import NamedTuple

import mitsuba as mi
import numpy as np
import tifffile
from PIL import Image
from tifffile import EXTRASAMPLE, PHOTOMETRIC

from ..errors import refusing, require_number
from ..runtime import Array, atomic_output, native_output_dropped, of_one_file, require_file, require_memory

TIFF = (".tif", ".tiff")

KEY = "mitsuba_plenoptic"
"""Name of the PNG chunk that states camera and detector, and of the object in a TIFF's description."""

# Bytes of a sample while it is read: as a number, in double and in single precision.
_SAMPLE_BYTES = 16


class StoredPicture(NamedTuple):
    """The numbers in a file, (rows, columns[, 3]), and what it says of them."""

    numbers: Array
    white: float | None  # None for numbers that are proportional to light
    encoding: float | bytes | None  # exponent, colour profile of the ICC, or None for sRGB
    text: str

    def values(self, linear: bool, black_level: float = 0) -> Array:
        """Return linear values in single precision, 0 at the black level, and 1 where whole numbers are white."""
        most = None if self.white is None else self.white - 1
        values = self.numbers - np.float64(require_number("black_level", black_level, minimum=0, maximum=most))
        if self.white is not None:
            values /= self.white - black_level
        if self.white is not None and not linear:
            if isinstance(self.encoding, bytes) and b"sRGB" not in self.encoding.replace(b"\0", b""):
                raise ValueError("its colour profile is not sRGB: convert it, or say that its numbers are linear")
            values = values ** (1 / self.encoding) if isinstance(self.encoding, float) else linear_of(values)
        return values.astype(np.float32)


def read_picture(path: str | Path, *, linear: bool = False) -> Array:
    """Return the linear values of a PNG, TIFF or BMP, grey or of three colours.

    Parameters
    ----------
    path : path
        File of one picture. Its samples are unsigned whole numbers or, in TIFF files, floating point.
    linear : bool
        Whether whole numbers are proportional to light, as in raw data, instead of encoded in sRGB or by the exponent
        that a PNG states.

    Returns
    -------
    (rows, columns[, 3]) float32 array
        From 0 to 1 for whole numbers, else as they are; without a channel axis where the picture is grey. Transparency
        is dropped.
    """
    picture = read_numbers(path)
    with refusing(f"{path}: it cannot be read as a picture:"):
        return picture.values(linear)


@of_one_file
def read_numbers(path: str | Path) -> StoredPicture:
    """Return the numbers in a PNG, TIFF or BMP; refuse numbers whose meaning the file does not say."""
    path = require_file(path)
    require_memory(2 * path.stat().st_size, f"{path}: {path.stat().st_size} bytes")
    with refusing(f"{path}: it cannot be read as a picture:"):
        if path.suffix.lower() == ".bmp":
            with Image.open(path, formats=["BMP"]) as picture:
                require_memory(4.0 * _SAMPLE_BYTES * math.prod(picture.size), f"{path}: {picture.size} pixels")
                values = np.array(picture.convert("L" if picture.mode in ("1", "L") else "RGB"))
            return StoredPicture(values, 255, None, "")
        return read_tiff(path) if path.suffix.lower() in TIFF else read_png(path)


def read_png(path: Path) -> StoredPicture:
    """Return the numbers in a PNG."""
    with path.open("rb") as file:
        head = file.read(24)
    if len(head) < 24 or head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR":
        raise ValueError("it does not begin as a PNG file; write it as .png or .tiff")
    columns, rows = struct.unpack(">II", head[16:])
    require_memory(4.0 * _SAMPLE_BYTES * columns * rows, f"{path}: {columns} x {rows} pixels")
    with Image.open(path, formats=["PNG"]) as described:
        stated = described.info
        count = getattr(described, "n_frames", 1)
    if count > 1:
        raise ValueError(f"it holds {count} pictures: write one")
    with native_output_dropped():
        numbers = np.array(mi.Bitmap(str(path))).reshape(rows, columns, -1)
    numbers = numbers[..., :3] if numbers.shape[2] > 2 else numbers[..., 0]
    encoding = stated.get("icc_profile", None if "srgb" in stated else stated.get("gamma") or None)
    return StoredPicture(numbers, np.iinfo(numbers.dtype).max, encoding, str(stated.get(KEY, "")))


def read_tiff(path: Path) -> StoredPicture:
    """Return the numbers in a TIFF."""
    # Series of these kinds may name other files.
    with tifffile.TiffFile(path, is_ome=False, is_mmstack=False, is_ndtiff=False) as file:
        pages = [page for page in file.pages if not page.is_reduced]
        page = pages[0]
        kind = page.dtype
        meaning = page.photometric
        # Samples of a pixel's colour; 0 for meanings that are not read.
        of_one = (PHOTOMETRIC.MINISWHITE, PHOTOMETRIC.MINISBLACK, PHOTOMETRIC.PALETTE)
        colours = 3 if meaning == PHOTOMETRIC.RGB else int(meaning in of_one)
        count = page.imagedepth * max(len(pages), file.series[0].size // max(page.size, 1))
        floats = str(kind).startswith("float")
        turned = page.tags.valueof("Orientation", default=1)
        extra = page.samplesperpixel - colours
        if (
            (count, turned) != (1, 1)
            or not (floats or str(kind) in ("bool", "uint8", "uint16", "uint32"))
            or not colours
            or (floats and meaning in (PHOTOMETRIC.MINISWHITE, PHOTOMETRIC.PALETTE))
            or (extra and tuple(page.extrasamples) != (EXTRASAMPLE.UNASSALPHA,))
        ):
            raise ValueError(
                f"it holds {count} pictures of {page.samplesperpixel} channels, {getattr(meaning, 'name', meaning)}, "
                f"{kind}, with orientation {turned}: write one in grey or RGB, upright, of unsigned numbers or "
                "floating point, without premultiplied transparency"
            )
        require_memory(_SAMPLE_BYTES * page.size, f"{path}: its pixels")
        numbers = decoded(page, path)
        white = None if floats else 2**page.bitspersample - 1
        if "S" in page.axes:
            numbers = np.moveaxis(numbers, page.axes.index("S"), -1)[..., slice(3) if colours == 3 else 0]
        if meaning == PHOTOMETRIC.MINISWHITE:
            numbers = np.int64(white or 0) - numbers
        if meaning == PHOTOMETRIC.PALETTE:
            numbers = np.moveaxis(page.colormap[:, numbers], 0, -1)
            white = 65535
        return StoredPicture(numbers, white, page.tags.valueof("InterColorProfile"), str(page.description))


def decoded(page: tifffile.TiffPage, path: Path) -> Array:
    """Return a page's samples as they are stored, decoded by Pillow where tifffile lacks the means."""
    try:
        return page.asarray()
    except ValueError as error:
        # Pillow converts some kinds as it reads them.
        converted = page.bitspersample < 8 or page.photometric == PHOTOMETRIC.MINISWHITE or page.index
        if "imagecodecs" in str(error) and not converted:
            with contextlib.suppress(OSError, ValueError), Image.open(path, formats=["TIFF"]) as picture:
                samples = np.asarray(picture)
                if (samples.shape, samples.dtype.name) == (page.shape, page.dtype.name):
                    return samples
        raise


def linear_of(encoded: Array) -> Array:
    """Return linear values for values from 0 to 1 that are encoded in sRGB (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def write_picture(path: str | Path, image: Array, text: str) -> None:
    """Write linear values (rows, columns[, 3]), clipped to 0 to 1, as a PNG of 16 bits a channel in sRGB encoding.

    The text is stored in quotes under the name `KEY`.
    """
    light = np.clip(np.asarray(image, float), 0, 1)
    # Mitsuba's conversion is off by up to one step.
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    bitmap = mi.Bitmap(np.ascontiguousarray(np.rint(65535 * encoded), np.uint16))
    bitmap.set_srgb_gamma(True)
    bitmap.metadata()[KEY] = text
    with atomic_output(path, ".png") as temporary:
        bitmap.write(str(temporary))
