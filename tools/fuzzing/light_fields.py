"""Light fields of other programs: MATLAB files, HDF5 and pictures."""

from __future__ import annotations

import io
import json
import struct
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io

from mitsuba_plenoptic.lightfield.exchange import open_light_field

from . import corpus
from .cases import Case
from .values import mutate, pick

NAMES = ("uint8.mat", "uint16.mat", "single.mat", "version7.mat", "version7.mat", "views.png", "lenses.eslf.png")


def bytes_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a file with damaged bytes."""
    name = pick(random, NAMES)
    data, what = mutate(random, corpus.files()[name])
    return _case(folder, name, data, what, forbidden=False)


def lie_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a whole file that claims or holds what is not allowed."""
    make = pick(random, (_matlab, _matlab, _matlab_header, _hdf5, _hdf5, _png, _png))
    name, data, what = make(random, folder)
    return _case(folder, name, data, what, forbidden=True)


def _case(folder: Path, name: str, data: bytes, what: str, *, forbidden: bool) -> Case:
    path = folder / name
    if data:
        path.write_bytes(data)
    views = corpus.light_field().sizes["u"] if name.endswith(".png") else None

    def run() -> Any:
        return open_light_field(path, views=views)

    return Case(f"{name}: {what}", run, forbidden)


def _matlab(random: np.random.Generator, folder: Path) -> tuple[str, bytes, str]:
    """Make a file of version 5 with variables that are no light field."""
    whole = np.ones((3, 3, 4, 4, 2), np.uint8)
    grid = {"HSpacing": 16.0, "VSpacing": 16.0, "HOffset": 8.0, "VOffset": 8.0, "Rot": 0.0, "UMax": 4.0, "VMax": 4.0,
            "FirstPosShiftRow": 5.0, "Orientation": "horz"}  # fmt: skip
    name = pick(random, sorted(grid))
    value = pick(random, (np.nan, np.inf, -1e300, "wide", [1.0, 2.0], {"a": 1.0}, np.zeros((50, 50)), 1j))
    numbers = whole.astype(np.float32)
    numbers[tuple(int(random.integers(n)) for n in numbers.shape)] = pick(random, (np.nan, np.inf, -np.inf, 3e38))
    camera = corpus.camera().to_dict()
    camera[pick(random, ("focal_length", "mla_pitch", "resolution"))] = pick(random, (-1, None, "x", float("nan"), []))
    choices: tuple[tuple[dict[str, Any], str], ...] = (
        ({"XX": whole}, "no LF"),
        ({"LF": whole[0]}, "four dimensions with five channels of views") if False else ({"LF": whole[0, 0]}, "3 axes"),
        ({"LF": np.ones((2, 2, 3, 3, 7), np.uint8)}, "seven channels"),
        ({"LF": np.zeros((0, 2, 3, 3, 2), np.uint8)}, "no views"),
        ({"LF": "text"}, "text"),
        ({"LF": {"a": 1}}, "a structure"),
        ({"LF": np.array([[1, "a"]], dtype=object)}, "cells"),
        ({"LF": whole * 1j}, "complex numbers"),
        ({"LF": numbers}, "a sample not finite or too large"),
        ({"LF": whole, "MaxLum": pick(random, (np.nan, np.inf, -1.0, "a", 1e38))}, "MaxLum"),
        ({"LF": whole, "LensletGridModel": {**grid, name: value}}, f"{name} = {ascii(value)[:40]}")
        if name != "Orientation"
        else ({"LF": whole, "MaxLum": -np.inf}, "MaxLum = -inf"),
        ({"LF": whole, "LensletGridModel": {"HSpacing": 16.0}}, "grid of one number"),
        ({"LF": whole, "Camera": json.dumps(camera)}, "a wrong camera"),
        ({"LF": whole, "Camera": "{" * 50_000}, "JSON nested 50,000 deep"),
        ({"LF": whole, "Camera": "cos\nsystem\n(S'true'\ntR."}, "a pickle for a camera"),
        ({"LF": whole, "LensletGridModel": {**grid, "HSpacing": np.zeros(4_000_000)}}, "a bomb of 32 MB"),
    )
    variables, what = pick(random, choices)
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, variables, do_compression=bool(random.random() < 0.5) or "bomb" in what)
    return "light.mat", buffer.getvalue(), what


def _matlab_header(random: np.random.Generator, folder: Path) -> tuple[str, bytes, str]:
    """Make a matrix whose dimensions claim more than there is, compressed or not."""
    size = pick(random, ((2**31 - 1, 2**31 - 1, 1, 1), (100_000, 100_000, 10, 10), (-1, 2, 3, 4), (2**16, 2**16, 9, 9)))
    dimensions = struct.pack("<4i", *size)
    body = struct.pack("<IIII", 6, 8, 9, 0) + struct.pack("<II", 5, 16) + dimensions
    body += (
        struct.pack("<HH4s", 1, 2, b"LF\0\0") + struct.pack("<II", 2, pick(random, (16, 2**31, 2**32 - 1))) + b"x" * 16
    )
    matrix = struct.pack("<II", 14, pick(random, (len(body), 2**32 - 1, 8))) + body
    start = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"
    if random.random() < 0.5:
        packed = zlib.compress(matrix)
        return "light.mat", start + struct.pack("<II", 15, len(packed)) + packed, f"compressed, claims {size}"
    return "light.mat", start + matrix, f"claims {size}"


def _hdf5(random: np.random.Generator, folder: Path) -> tuple[str, bytes, str]:
    """Make a file of version 7.3 with links to other files, or sizes that are not there."""
    (folder / "secret").write_bytes(b"\1" * 4096)
    with h5py.File(folder / "other.h5", "w") as other:
        other["LF"] = np.ones((2, 4, 4, 3, 3), np.uint8)
    what = pick(random, ("external link", "soft link", "external storage", "virtual", "huge", "text", "group", "nan",
                         "compound", "references", "channels", "empty"))  # fmt: skip
    path = folder / "light.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        if what == "external link":
            file["LF"] = h5py.ExternalLink(str(folder / "other.h5"), "LF")
        elif what == "soft link":
            file["LF"] = h5py.SoftLink("/nowhere")
        elif what == "external storage":
            file.create_dataset("LF", (2, 4, 4, 3, 3), np.uint8, external=[(str(folder / "secret"), 0, 4096)])
        elif what == "virtual":
            layout = h5py.VirtualLayout((2, 4, 4, 3, 3), np.uint8)
            layout[...] = h5py.VirtualSource(str(folder / "other.h5"), "LF", (2, 4, 4, 3, 3))
            file.create_virtual_dataset("LF", layout)
        elif what == "huge":
            shape = pick(random, ((2, 10**6, 10**6, 9, 9), (2, 2**15, 2**15, 15, 15)))
            file.create_dataset("LF", shape, np.uint8, chunks=(1, 16, 16, 3, 3))
        elif what == "text":
            file["LF"] = "text"
        elif what == "group":
            file.create_group("LF")
        elif what == "nan":
            file["LF"] = np.full((2, 4, 4, 3, 3), np.nan, np.float32)
        elif what == "compound":
            file["LF"] = np.zeros((2, 4, 4, 3, 3), [("a", "f4"), ("b", "f4")])
        elif what == "references":
            file.create_dataset("LF", (2, 4, 4, 3, 3), h5py.ref_dtype)
        elif what == "channels":
            file["LF"] = np.ones((9, 4, 4, 3, 3), np.uint8)
        else:
            file["LF"] = h5py.Empty("f4")
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    return "light.mat", b"", what


def _png(random: np.random.Generator, folder: Path) -> tuple[str, bytes, str]:
    """Make a picture whose header claims too much or another size."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    sizes = (
        (10**6, 10**6),
        (2**31 - 1, 1),
        (1, 2**31 - 1),
        (2**31 - 1, 2**31 - 1),
        (0, 0),
        (2**32 - 1, 7),
        (60_000, 60_000),
    )
    columns, rows = pick(random, sizes)
    depth, colour = pick(random, ((8, 0), (16, 0), (8, 2), (16, 6), (8, 3), (1, 0), (7, 9)))
    head = struct.pack(">IIBBBBB", columns, rows, depth, colour, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head)
    if random.random() < 0.3:
        data += chunk(b"zTXt", b"a\0\0" + zlib.compress(b"\0" * 10_000_000))
    data += chunk(b"IDAT", zlib.compress(b"\0" * 1000)) + chunk(b"IEND", b"")
    return "views.png", data, f"{columns} x {rows} pixels, depth {depth}, colour {colour}"
