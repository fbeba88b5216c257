"""Checks of an OpenEXR file before its library sees it: what the file claims, against what it holds.

The library allocates what a header claims and follows the offsets that a file gives. So a damaged or hostile file is
judged here first, from its first bytes, as "OpenEXR File Layout" (openexr.com, version 2) describes them: sizes within
what memory allows, and every chunk within the file.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

_MAGIC = 20000630
_VERSION = 2
_TILED, _LONG_NAMES, _DEEP, _PARTS = 0x200, 0x400, 0x800, 0x1000

# Longer headers are damaged: those of this package take kilobytes.
_LONGEST_HEADER = 2**24
_MOST_PARTS = 2**16
_MOST_CHANNELS = 1024

# Coordinates of a window; their differences stay far within 32 bits.
_FARTHEST = 2**30

# Scan lines in a chunk by compression: none, RLE, ZIPS, ZIP, PIZ. The others lose precision, which is not for captures.
_LINES = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32}

# Bytes of a value by pixel type: UINT, HALF, FLOAT.
_BYTES = {0: 4, 1: 2, 2: 4}


class DamageError(ValueError):
    """What is wrong with a file."""


@dataclass(frozen=True)
class Part:
    """What one part of a file claims to hold.

    Attributes
    ----------
    columns, rows : int
        Size of its data window.
    channels : dict
        Bytes of a value by name of the channel.
    text : dict
        Its attributes of type string.
    chunk_lines : int
        Scan lines in a chunk.
    first_line : int
        Coordinate of the first scan line.
    """

    columns: int
    rows: int
    channels: dict[str, int]
    text: dict[str, str]
    chunk_lines: int
    first_line: int

    @property
    def size(self) -> int:
        """Bytes of its pixels."""
        return self.columns * self.rows * sum(self.channels.values())


def check_exr(path: Path, allow: Callable[[list[Part]], None]) -> list[Part]:
    """Judge a file of scan lines, and tell what it holds.

    Parameters
    ----------
    path : Path
        An existing file.
    allow : callable
        Given the parts as claimed by the headers, refuses those that are not wanted or too large.

    Raises
    ------
    DamageError
        If a header or a chunk is not what the format demands, or of a kind that is not read.
    """
    with path.open("rb") as file:
        length = file.seek(0, 2)
        file.seek(0)
        magic, version = struct.unpack("<ii", _read(file, 8))
        if magic != _MAGIC:
            raise DamageError("it does not begin as an OpenEXR file")
        if version & 0xFF != _VERSION or version & ~(0xFF | _TILED | _LONG_NAMES | _DEEP | _PARTS):
            raise DamageError(f"its version {version:#x} is unknown")
        if version & (_TILED | _DEEP):
            raise DamageError("it holds tiles or deep pixels instead of scan lines")
        several = bool(version & _PARTS)
        parts = [_read_header(file, several)]
        while several:
            if len(parts) > _MOST_PARTS:
                raise DamageError(f"it has more than {_MOST_PARTS} parts")
            if _read(file, 1) == b"\0":
                break
            file.seek(-1, 1)
            parts.append(_read_header(file, several))
        allow(parts)
        _check_chunks(file, length, parts, several)
    return parts


def _read(file: BinaryIO, count: int) -> bytes:
    if file.tell() + count > _LONGEST_HEADER:
        raise DamageError(f"its header is longer than {_LONGEST_HEADER} bytes")
    data = file.read(count)
    if len(data) < count:
        raise DamageError("it ends within its header")
    return data


def _read_name(file: BinaryIO) -> str:
    name = b""
    while not name.endswith(b"\0"):
        if len(name) > 255:
            raise DamageError("a name in its header is longer than 255 bytes")
        name += _read(file, 1)
    return name[:-1].decode(errors="replace")


def _read_header(file: BinaryIO, several: bool) -> Part:
    attributes: dict[str, tuple[str, bytes]] = {}
    while name := _read_name(file):
        kind = _read_name(file)
        (size,) = struct.unpack("<i", _read(file, 4))
        if size < 0:
            raise DamageError(f"its attribute {name} has the size {size}")
        if name in attributes:
            raise DamageError(f"its attribute {name} is there twice")
        attributes[name] = kind, _read(file, size)

    def value(name: str, kind: str, form: str) -> tuple[int, ...]:
        found, data = attributes.get(name, (None, b""))
        if found != kind or len(data) != struct.calcsize(form):
            raise DamageError(f"its attribute {name} is missing, or is no {kind}")
        return struct.unpack(form, data)

    windows = [value(name, "box2i", "<iiii") for name in ("dataWindow", "displayWindow")]
    for window in windows:
        if max(map(abs, window)) > _FARTHEST or window[2] < window[0] or window[3] < window[1]:
            raise DamageError(f"its window is {window}")
    for name, kind, form in (
        ("pixelAspectRatio", "float", "<f"),
        ("screenWindowCenter", "v2f", "<ff"),
        ("screenWindowWidth", "float", "<f"),
    ):
        if not all(map(math.isfinite, value(name, kind, form))):
            raise DamageError(f"its attribute {name} is not finite")
    if value("lineOrder", "lineOrder", "<B")[0] > 2:
        raise DamageError("its lineOrder is unknown")
    (compression,) = value("compression", "compression", "<B")
    if compression not in _LINES:
        raise DamageError(f"its compression {compression} is lossy or unknown")
    if several and attributes.get("type", ("", b""))[1] != b"scanlineimage":
        raise DamageError("a part holds tiles or deep pixels instead of scan lines")
    low_x, low_y, high_x, high_y = windows[0]
    return Part(
        columns=high_x - low_x + 1,
        rows=high_y - low_y + 1,
        channels=_read_channels(attributes.get("channels", ("", b""))),
        text={name: data.decode(errors="replace") for name, (kind, data) in attributes.items() if kind == "string"},
        chunk_lines=_LINES[compression],
        first_line=low_y,
    )


def _read_channels(attribute: tuple[str, bytes]) -> dict[str, int]:
    kind, data = attribute
    channels: dict[str, int] = {}
    while kind == "chlist" and data and data != b"\0":
        raw, _, rest = data.partition(b"\0")
        if not raw or len(raw) > 255 or len(rest) < 16 or len(channels) >= _MOST_CHANNELS:
            raise DamageError("its list of channels is damaged")
        pixel_type, _, across, down = struct.unpack("<iiii", rest[:16])
        name = raw.decode(errors="replace")
        if pixel_type not in _BYTES or (across, down) != (1, 1) or name in channels:
            raise DamageError(f"its channel {name} is of an unknown kind or subsampled")
        channels[name] = _BYTES[pixel_type]
        data = rest[16:]
    if not channels or data != b"\0":
        raise DamageError("its list of channels is missing or damaged")
    return channels


def _check_chunks(file: BinaryIO, length: int, parts: list[Part], several: bool) -> None:
    """See that each chunk lies within the file, is of one of the part's lines, and is no larger than its pixels."""
    counts = [-(-part.rows // part.chunk_lines) for part in parts]
    start = file.tell()
    if start + 8 * sum(counts) > length:
        raise DamageError("it is shorter than its table of chunks")
    tables = [np.frombuffer(file.read(8 * count), "<u8") for count in counts]
    first = start + 8 * sum(counts)
    head = 12 if several else 8
    for index, (part, table) in enumerate(zip(parts, tables, strict=True)):
        if table.min() < first or table.max() > length - head:
            raise DamageError("a chunk lies outside of it")
        heads = np.array([_read_at(file, int(place), head) for place in table], "V").view("<i4")
        heads = heads.reshape(len(table), -1)
        if several and (heads[:, 0] != index).any():
            raise DamageError("a chunk is of another part")
        line, size = heads[:, -2].astype(np.int64) - part.first_line, heads[:, -1].astype(np.int64)
        if (line != np.arange(len(table)) * part.chunk_lines).any():
            raise DamageError("a chunk is of other lines than the table says")
        lines = np.minimum(part.chunk_lines, part.rows - line)
        most = lines * part.columns * sum(part.channels.values())
        if (size <= 0).any() or (size > most).any() or (table.astype(np.int64) + head + size > length).any():
            raise DamageError("a chunk is longer than its pixels or than the file")


def _read_at(file: BinaryIO, place: int, count: int) -> bytes:
    file.seek(place)
    return file.read(count)
