"""Files of other programs that tests write byte by byte."""

import struct
import zlib

import h5py


def write_matlab_7(path, fill):
    """Write a MATLAB 7.3 file, which is HDF5 behind a header of 512 bytes, and return its path."""
    with h5py.File(path, "w", userblock_size=512) as file:
        fill(file)
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")
    return path


def png(columns, rows):
    """Return a picture that claims to be of a size, and holds a million bytes."""
    head = struct.pack(">IIBBBBB", columns, rows, 16, 2, 0, 0, 0)
    chunks = (b"IHDR", head), (b"IDAT", zlib.compress(bytes(10**6))), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
