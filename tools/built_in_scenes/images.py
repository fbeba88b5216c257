"""Pictures as files that come out the same, byte for byte, wherever they are written: without compression."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Colour = tuple[int, int, int]


def write_png(path: Path, indices: NDArray[np.uint8], palette: Sequence[Colour]) -> None:
    """Write a PNG of 4 bits per pixel with a palette of up to 16 sRGB colours, uncompressed."""
    rows, columns = indices.shape
    packed = (indices[:, 0::2] << 4) | indices[:, 1::2]
    raw = np.hstack([np.zeros((rows, 1), np.uint8), packed.astype(np.uint8)]).tobytes()
    stream = b"\x78\x01"
    for start in range(0, len(raw), 65535):
        block = raw[start : start + 65535]
        stream += struct.pack("<BHH", start + 65535 >= len(raw), len(block), len(block) ^ 0xFFFF) + block
    stream += struct.pack(">I", zlib.adler32(raw))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 4, 3, 0, 0, 0))
        + chunk(b"PLTE", bytes(value for colour in palette for value in colour))
        + chunk(b"IDAT", stream)
        + chunk(b"IEND", b"")
    )


def write_hdr(path: Path, image: NDArray[np.float64]) -> None:
    """Write (rows, columns, 3) radiances as Radiance HDR, uncompressed."""
    exponent = np.frexp(image.max(axis=-1))[1]
    mantissa = np.clip(np.floor(np.ldexp(image, 8 - exponent[..., None]) + 0.500001), 0, 255)
    pixels = np.concatenate([mantissa, exponent[..., None] + 128], axis=-1).astype(np.uint8)
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {len(image)} +X {image.shape[1]}\n"
    path.write_bytes(header.encode("ascii") + pixels.tobytes())
