"""OpenEXR files: damaged ones, and whole ones that lie."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import decode, read_capture, reconstruct
from mitsuba_plenoptic.camera import LATER
from mitsuba_plenoptic.io.exr import ATTRIBUTE

from . import cameras, corpus
from .cases import Case
from .values import mutate, pick

NAMES = ("grey.exr", "grey.exr", "colour.exr", "refocused.exr", "views.exr", "foreign.exr")
CAPTURES = NAMES[:3]


def bytes_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a file with damaged bytes."""
    name = pick(random, NAMES)
    data, what = mutate(random, corpus.files()[name])
    path = folder / name
    path.write_bytes(data)

    def run() -> Any:
        capture = read_capture(path)
        return [capture, reconstruct(capture, _beyond(capture)), decode(capture)]

    return Case(f"{name}: {what}", run)


def header_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a whole file, one attribute of whose header is changed."""
    name = pick(random, CAPTURES)
    what, change, forbidden = pick(random, CHANGES)
    start, attributes, rest = _take_apart(corpus.files()[name])
    attributes, start, rest, told = change(random, attributes, start, rest)
    path = folder / name
    path.write_bytes(_put_together(start, attributes, rest))

    def run() -> Any:
        capture = read_capture(path)
        return [capture, reconstruct(capture, _beyond(capture))]

    return Case(f"{name}: {what} {told}", run, forbidden)


def json_case(random: np.random.Generator, folder: Path) -> Case:
    """Make a whole file whose JSON about the camera breaks a rule."""
    name = pick(random, CAPTURES)
    start, attributes, rest = _take_apart(corpus.files()[name])
    facts = json.loads(attributes[ATTRIBUTE][1].decode())
    way = random.random()
    if way < 0.5:
        facts["camera"].update(cameras.bad_parameter(random))
        facts["camera"].pop("focus_distance", None)
        what = f"camera {ascii(facts['camera'])[:300]}"
        if "focus_distance" not in facts["camera"] and _same_camera(facts["camera"], attributes):
            facts["camera"]["zoom"] = 1
    elif way < 0.8:
        key, values = pick(random, JSON_VALUES)
        facts[key] = pick(random, values)
        what = f"{key} = {ascii(facts[key])[:60]}"
    elif way < 0.9:
        key = pick(random, ("camera", "kind", "model"))
        del facts[key]
        what = f"no {key}"
    else:
        key = pick(random, sorted(set(facts["camera"]) - LATER))
        del facts["camera"][key]
        what = f"camera without {key}"
    try:
        text = json.dumps(facts).encode()
    except (TypeError, ValueError):
        text = json.dumps(facts, default=repr, skipkeys=True).encode()
    if way < 0.5 and random.random() < 0.1:
        text, what = pick(random, BROKEN_JSON)
    attributes[ATTRIBUTE] = "string", text
    path = folder / name
    path.write_bytes(_put_together(start, attributes, rest))
    return Case(f"{name}: JSON {what}", lambda: read_capture(path), forbidden=True)


JSON_VALUES: tuple[tuple[str, tuple[Any, ...]], ...] = (
    ("kind", ("reconstruction", "", None, 1, [], {"a": 1}, "capture\n", "\x1b[31mcapture")),
    ("model", ("magic", "", None, 3, [], {}, "RAY", "\x1b]0;title\x07")),
    ("metadata", ("text", 3, ["a"], True, 1.5)),
    ("camera", (None, 3, [], "camera", {}, [1, 2])),
    ("wavelength", (-1, 0, "633", [], [1.0, 2.0], {}, True, float("nan"), float("inf"), 1e300, [0, 0, 0])),
)
BROKEN_JSON: tuple[tuple[bytes, str], ...] = (
    (b"{", "unfinished"),
    (b"", "empty"),
    (b"[]", "a list"),
    (b"null", "null"),
    (b"[" * 100_000, "nested 100,000 deep"),
    (b'{"a":' * 100_000, "objects nested 100,000 deep"),
    (b"9" * 100_000, "a number of 100,000 digits"),
    (b'{"kind": "capture", "camera": {"focal_length": ' + b"9" * 5000 + b"}}", "a length of 5,000 digits"),
    (b"\xff\xfe{}", "no UTF-8"),
    (b'{"kind": "capture"} extra', "something after it"),
    (b"cos\nsystem\n(S'true'\ntR.", "a pickle"),
)


def _same_camera(camera: dict[str, Any], attributes: dict[str, tuple[str, bytes]]) -> bool:
    return repr(camera) == repr(json.loads(attributes[ATTRIBUTE][1].decode())["camera"])


Attributes = dict[str, tuple[str, bytes]]
Changed = tuple[Attributes, bytes, bytes, str]


def _window(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    name = pick(random, ("dataWindow", "displayWindow"))
    numbers = [0, 0, 63, 63]
    for _ in range(int(random.integers(1, 3))):
        numbers[int(random.integers(4))] = int(pick(random, WINDOW_NUMBERS))
    attributes[name] = "box2i", struct.pack("<iiii", *numbers)
    return attributes, start, rest, f"{name} = {numbers}"


WINDOW_NUMBERS = (-(2**31), 2**31 - 1, -1, -64, 1, 31, 62, 64, 127, 4095, 65535, 10**9, -(10**9), 2**24)


def _data_window(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    size = pick(random, (1, 2, 32, 65, 128, 1000, 65536, 10**6, 10**9, 2**30))
    other = pick(random, (1, 63, 64, 65, 10**9))
    columns, rows = (size, other) if random.random() < 0.5 else (other, size)
    if (columns, rows) == (64, 64):
        rows = 10**9
    attributes["dataWindow"] = "box2i", struct.pack("<iiii", 0, 0, columns - 1, rows - 1)
    return attributes, start, rest, f"of {columns} x {rows} pixels"


def _channels(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    bad = (
        [],
        [("Z", 2, 1, 1)],
        [("R", 2, 1, 1)],
        [("R", 2, 1, 1), ("G", 2, 1, 1)],
        [("Y", 3, 1, 1)],
        [("Y", -1, 1, 1)],
        [("Y", 2, 0, 0)],
        [("Y", 2, 2, 2)],
        [("Y", 2, -1, 1)],
        [("Y", 2, 1, 1), ("Y", 2, 1, 1)],
        [("Y", 2, 2**31 - 1, 1)],
        [(f"c{i}", 2, 1, 1) for i in range(1000)],
        [(f"c{i}", 2, 1, 1) for i in range(5000)],
        [("Y" * 300, 2, 1, 1)],
        [("R", 2, 1, 1), ("G", 2, 1, 1), ("B", 2, 1, 1), ("Y", 2, 1, 1)],
    )
    chosen = pick(random, bad)
    data = b"".join(name.encode() + b"\0" + struct.pack("<iiii", kind, 0, x, y) for name, kind, x, y in chosen)
    attributes["channels"] = "chlist", data + (b"\0" if random.random() < 0.9 else b"")
    return attributes, start, rest, f"{len(chosen)}: {ascii(chosen[:2])[:60]}"


def _compression(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    value = int(pick(random, (0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 99, 255)))
    attributes["compression"] = "compression", bytes([value])
    return attributes, start, rest, str(value)


def _missing(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    name = pick(random, ("channels", "compression", "dataWindow", "displayWindow", "lineOrder", ATTRIBUTE))
    attributes.pop(name)
    return attributes, start, rest, name


def _kind(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    name = pick(random, ("channels", "compression", "dataWindow", "displayWindow", "lineOrder", ATTRIBUTE))
    kind = pick(random, ("int", "float", "nosuch", "box2f", "m44d", "opaque", "preview", "timecode"))
    attributes[name] = kind, attributes[name][1]
    return attributes, start, rest, f"{name} as {kind}"


def _size(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    name = pick(random, sorted(attributes))
    kind, data = attributes[name]
    count = int(pick(random, (0, 1, 3, len(data) + 1, len(data) * 2, 100_000)))
    attributes[name] = kind, (data * (count // max(1, len(data)) + 1))[:count]
    return attributes, start, rest, f"{name} of {count} bytes"


def _table(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    edited = bytearray(rest)
    entry = int(random.integers(4))
    value = int(pick(random, (0, 1, 2**63, 2**64 - 1, 2**32, 10**9, len(rest), 8)))
    edited[8 * entry : 8 * entry + 8] = value.to_bytes(8, "little")
    return attributes, start, bytes(edited), f"entry {entry} = {value}"


def _chunk(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    edited = bytearray(rest)
    place = 32 + 4 * int(random.integers(2))
    value = int(pick(random, (-1, 2**31 - 1, -(2**31), 10**9, 7, 65535)))
    edited[place : place + 4] = struct.pack("<i", value)
    return attributes, start, bytes(edited), f"word {place} = {value}"


def _version(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    version = int(pick(random, (0, 1, 3, 0x202, 0x802, 0x1002, 0x1802, 0x10002, 2**31 - 1)))
    return attributes, start[:4] + struct.pack("<i", version), rest, hex(version)


def _pixels(random: np.random.Generator, attributes: Attributes, start: bytes, rest: bytes) -> Changed:
    """Pixels that are NaN, infinite or too large, stored without compression."""
    names = [name for name in ("B", "G", "R", "Y") if name.encode() + b"\0" in attributes["channels"][1]]
    rows = np.ones((64, len(names), 64), np.float32)
    value = pick(random, (np.nan, np.inf, -np.inf, 3e38, -3e38, 2e30))
    rows[int(random.integers(64)), int(random.integers(len(names))), int(random.integers(64))] = value
    attributes["compression"] = "compression", b"\0"
    chunks = [struct.pack("<ii", line, row.nbytes) + row.tobytes() for line, row in enumerate(rows)]
    # The table is put in when the header's length is known.
    return attributes, start, b"".join(chunks), f"{value}"


# What OpenEXR reads in spite of the change is whole; what must be refused is said so.
CHANGES = (
    ("window", _window, False),
    ("data window", _data_window, True),
    ("channels", _channels, True),
    ("compression", _compression, False),
    ("missing attribute", _missing, False),
    ("type of", _kind, False),
    ("size of", _size, False),
    ("table of chunks:", _table, False),
    ("chunk:", _chunk, True),
    ("version", _version, False),
    ("a pixel is", _pixels, True),
)


def _take_apart(data: bytes) -> tuple[bytes, Attributes, bytes]:
    """Split a file of one part into magic and version, attributes, and the rest."""
    place, attributes = 8, {}
    while data[place]:
        name, place = _text(data, place)
        kind, place = _text(data, place)
        (size,) = struct.unpack_from("<i", data, place)
        attributes[name] = kind, data[place + 4 : place + 4 + size]
        place += 4 + size
    return data[:8], attributes, data[place + 1 :]


def _text(data: bytes, place: int) -> tuple[str, int]:
    end = data.index(b"\0", place)
    return data[place:end].decode(), end + 1


def _put_together(start: bytes, attributes: Attributes, rest: bytes) -> bytes:
    """Write a file again, with the chunks' offsets moved along."""
    header = start
    for name, (kind, data) in attributes.items():
        header += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(data)) + data
    header += b"\0"
    if attributes.get("compression", ("", b""))[1] == b"\0" and rest[:4] == b"\0\0\0\0":
        size = struct.unpack_from("<i", rest, 4)[0] + 8
        table = len(header) + 8 * 64 + np.arange(64, dtype="<u8") * size
        return header + table.tobytes() + rest
    return header + _moved(rest, len(header))


def _moved(rest: bytes, length: int) -> bytes:
    """Shift the offsets of the four chunks by as much as the header has grown; damaged ones stay."""
    table = np.frombuffer(rest[:32], "<u8").copy()
    first = int(table[0])
    if 0 < first < 2**24:
        table[table < 2**24] += np.uint64(length + 32) - np.uint64(first)
    return table.tobytes() + rest[32:]


def _beyond(capture: Any) -> float:
    """Choose a distance that the camera can be refocused to."""
    return min(3 * capture.camera.focal_length, 9e8) if capture.camera.focal_length < 3e8 else 9.9e8
