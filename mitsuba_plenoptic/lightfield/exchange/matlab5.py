"""What a MATLAB file of version 5 holds, variable by variable, before anything of it is loaded.

A variable may be compressed a thousand times, and its header need not tell the truth about what follows. This walks
over the file as "MAT-File Format" (MathWorks) describes it, in a bounded amount of memory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from ...errors import InputError

_MATRIX, _COMPRESSED = 14, 15
_INT32, _UINT32, _INT8 = 5, 6, 1

NUMERIC = range(6, 16)
"""Classes of arrays of numbers: double, single, and integers of 8 to 64 bits."""

_COMPLEX = -1

_HEADER = 128
_BLOCK = 2**16
_MOST_DIMENSIONS = 32
_LONGEST_NAME = 64


@dataclass(frozen=True)
class Variable:
    """A variable as its header tells of it.

    Attributes
    ----------
    shape : tuple of ints
        Its dimensions.
    kind : int
        Its class.
    """

    shape: tuple[int, ...]
    kind: int
    _file: BinaryIO
    _start: int
    _length: int
    _is_compressed: bool

    def require_size(self, limit: float) -> None:
        """Refuse the variable if its data are longer than allowed, when they are no longer compressed.

        Raises
        ------
        InputError
            With the limit.
        """
        size = 0
        if self._is_compressed:
            for block in _inflated(self._file, self._start, self._length):
                size += len(block)
                if size > limit:
                    break
        else:
            size = self._length
        if size > limit:
            raise InputError(f"a variable of shape {self.shape} holds more than {limit:.4g} bytes")


def read_variables(file: BinaryIO) -> Iterator[tuple[str, Variable]]:
    """Tell the name and header of each variable.

    Raises
    ------
    InputError
        If the file is not of version 5, or is damaged.
    """
    end = file.seek(0, 2)
    file.seek(0)
    head = file.read(_HEADER)
    if len(head) < _HEADER or head[126:] not in (b"IM", b"MI") or head[124:126] not in (b"\0\1", b"\1\0"):
        raise InputError("it is neither a MATLAB file of version 5 nor of version 7.3")
    order = "<" if head[126:] == b"IM" else ">"
    place = _HEADER
    while place < end:
        file.seek(place)
        kind, length = _unpack(f"{order}II", file.read(8))
        start = place + 8
        if kind not in (_MATRIX, _COMPRESSED) or start + length > end:
            raise InputError(f"its element at byte {place} is of an unknown kind, or longer than the file")
        if kind == _COMPRESSED:
            data = next(_inflated(file, start, length), b"")
            inner, _ = _unpack(f"{order}II", data[:8])
            if inner != _MATRIX:
                raise InputError(f"its element at byte {place} holds no variable")
            data = data[8:]
        else:
            data = file.read(min(length, _BLOCK))
        name, shape, array_class = _matrix_header(order, data)
        yield name, Variable(shape, array_class, file, start, length, kind == _COMPRESSED)
        place = start + length


def _inflated(file: BinaryIO, start: int, length: int) -> Iterator[bytes]:
    """Yield what a compressed element holds, block by block."""
    inflate = zlib.decompressobj()
    file.seek(start)
    while length > 0 and not inflate.eof:
        place = file.tell()
        data = file.read(min(_BLOCK, length))
        length -= len(data)
        if not data:
            return
        place += len(data)
        while data and not inflate.eof:
            block = inflate.decompress(data, _BLOCK)
            data = inflate.unconsumed_tail
            if block:
                yield block
                # Whoever takes the blocks may read elsewhere meanwhile.
                file.seek(place)


def _matrix_header(order: str, data: bytes) -> tuple[str, tuple[int, ...], int]:
    """Name, dimensions and class of a matrix, from its first bytes."""
    _, flags, data = _element(order, data, _UINT32)
    word, _ = _unpack(f"{order}II", flags)
    # Complex numbers are of the class of their parts.
    array_class = _COMPLEX if word & 0x800 else word & 0xFF
    _, sizes, data = _element(order, data, _INT32)
    count = len(sizes) // 4
    if len(sizes) % 4 or not 2 <= count <= _MOST_DIMENSIONS:
        raise InputError("a variable's dimensions are damaged")
    shape = struct.unpack(f"{order}{count}i", sizes)
    if min(shape) < 0:
        raise InputError(f"a variable has the shape {shape}")
    _, name, _ = _element(order, data, _INT8)
    if len(name) > _LONGEST_NAME:
        raise InputError(f"the name of a variable is longer than {_LONGEST_NAME} bytes")
    return name.decode("latin-1"), shape, array_class


def _element(order: str, data: bytes, wanted: int) -> tuple[int, bytes, bytes]:
    """Kind and content of a data element, and what follows it."""
    (word,) = _unpack(f"{order}I", data[:4])
    if word >> 16:
        kind, size, start, follows = word & 0xFFFF, word >> 16, 4, 8
    else:
        kind, (size,), start = word, _unpack(f"{order}I", data[4:8]), 8
        follows = start + -(-size // 8) * 8
    if kind != wanted or start + size > len(data) or (word >> 16 and size > 4):
        raise InputError("a variable's header is damaged")
    return kind, data[start : start + size], data[follows:]


def _unpack(form: str, data: bytes) -> tuple[int, ...]:
    if len(data) != struct.calcsize(form):
        raise InputError("a variable's header is damaged")
    return struct.unpack(form, data)
