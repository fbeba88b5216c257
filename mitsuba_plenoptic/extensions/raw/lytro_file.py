"""Raw pictures of Lytro's cameras: containers (``.lfp``, ``.lfr``), and white pictures (``.raw`` with ``.txt``).

The layout was reverse-engineered and published by N. Patel (lfptools, README: sections of a container), the Department
of Optics & Acoustics (optics.miloush.net/lytro: 12-bit pixels, white pictures, positions of the microlenses) and the
authors of LFToolbox and imageio (10-bit pixels, names of the metadata). A container is

- a header of 16 bytes: 89 "LFP" 0D 0A 1A 0A, a version, and 4 bytes of zero;
- sections: 89 "LFM" or "LFC" 0D 0A 1A 0A, a version, the length of the data (4 bytes, big-endian), 80 bytes that begin
  with the name of the data, ``sha1-`` and their digest in hexadecimal, the data, and zeros.

The first section is JSON and names others: ``metadataRef``, again JSON, and ``imageRef``, the pixels. Two pixels of 12
bits occupy 3 bytes, big-endian. Of four pixels of 10 bits, 4 bytes hold the upper 8 bits, and a fifth byte the lower 2,
with the first pixel's lowest.
"""

import hashlib
import json
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from ... import choices
from ...camera import PlenopticCamera
from ...errors import InputError, naming, refuse_if, require_choice, require_count, require_number, short_repr
from ...io import RECORDED, Capture, recording_of
from ...runtime import Named, Pair, read_text, require_memory, require_size, turn

CONTAINERS = (".lfp", ".lfr")

_LARGEST_TEXT = 2**24

_MAGIC = b"\x89LF%c\r\n\x1a\n"
_HEADER = 16

_TILINGS = {"hexUniformRowMajor": "hexagonal", "squareUniform": "square"}

_FILTERS = ("r", "gr", "gb", "b")


@dataclass(frozen=True)
class _Picture:
    """Content of a Lytro file: the metadata of the frame, and the packed pixels."""

    metadata: Any
    pixels: bytes

    def entry(self, name: str) -> Any:
        """Return an entry of the metadata by its path, such as ``devices.mla.lensPitch``."""
        value = _within(self.metadata, *name.split("."))
        refuse_if(value is None, f"its metadata have no {name}")
        return value

    def number(self, name: str, **rules: Any) -> float:
        """Return a number of the metadata by its name."""
        return require_number(name, self.entry(name), **rules)

    @property
    def details(self) -> str:
        """Metadata entry that describes the pixels; the first cameras have another name for it."""
        return "image.rawDetails" if _within(self.metadata, "image", "rawDetails") else "image"

    @property
    def steps(self) -> Pair:
        """Positions of the zoom and focus motors, in steps."""
        return self.number("devices.lens.zoomStep"), self.number("devices.lens.focusStep")


def read_lytro(path: str | Path) -> Capture:
    """Read a raw picture of a Lytro camera.

    The result is a mosaic for `demosaic`. Pixels are 0 at the black level and 1 at the white level of their filter. The
    camera follows from the metadata: pixels, lattice (pitches, rotation, offset), the distance of the lenses from the
    pixels, focal length and f-number of the main lens. As the metadata state neither the distance in focus nor the
    focal length of the microlenses, main lens and microlenses are focused at infinity. The main lens is thin, so that
    its pupil is one focal length from the array; pitches and offset are scaled by the distance of the true exit pupil
    so that micro-images are centred as in the file.

    Parameters
    ----------
    path : path
        A container (``.lfp`` or ``.lfr``); or pixels (``.raw``), whose metadata are next to it in a text file of the
        same name, as in the white pictures of a camera.

    Returns
    -------
    Capture
        With the entries ``image`` and ``devices`` of the metadata, the mosaic, and the number of saturated pixels in
        `metadata` under ``raw``.

    Raises
    ------
    InputError
        If the file does not exist, is damaged, or holds no raw picture, as those made for the web.
    """
    path = Path(path)
    picture = _read(path)
    with naming(path):
        return _capture_of(picture)


def nearest_white(folder: str | Path, capture: Capture) -> Path:
    """Return the white picture of a folder with the zoom and focus nearest to a capture's.

    Parameters
    ----------
    folder : path
        Folder of white pictures of the same camera, each a ``.raw`` with its ``.txt``, or a container.
    capture : Capture
        The capture, from `read_lytro`.

    Returns
    -------
    pathlib.Path
        The picture with the nearest zoom step, and of these the nearest focus step; of several such pictures the
        brightest with at most 1 % of saturated pixels.
    """
    with naming("capture"):
        zoom, focus = _Picture(recording_of(capture), b"").steps
    folder = Path(folder)
    refuse_if(not folder.is_dir(), f"{folder}: there is no such folder")
    pictures: dict[Pair, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in choices.LYTRO_SUFFIXES:
            picture = _read(path)
            with naming(path):
                steps = picture.steps
            pictures.setdefault((abs(steps[0] - zoom), abs(steps[1] - focus)), []).append(path)
    refuse_if(not pictures, f"{folder}: it has no white pictures, .raw with .txt, .lfp or .lfr")
    nearest = pictures[min(pictures)]
    return nearest[0] if len(nearest) == 1 else max(nearest, key=_brightness)


def _brightness(path: Path) -> tuple[bool, float]:
    """Return the sort key of a white picture: unsaturated before saturated, then by brightness."""
    capture = read_lytro(path)
    saturated = recording_of(capture)["saturated_pixels"] / capture.image.size
    return saturated <= 0.01, float(capture.image.mean())


def _read(path: Path) -> _Picture:
    suffix = require_choice("suffix", path.suffix.lower(), choices.LYTRO_SUFFIXES)
    content = require_size(path, 2**28).read_bytes()
    with naming(path):
        if suffix in CONTAINERS:
            sections = list(_sections(content))
            refuse_if(not sections, "it has no sections")
            parts = dict(sections[1:])
            frame = _frame(_json(sections[0][1]))
            metadata, image = (_within(parts, _within(frame, name)) for name in ("metadataRef", "imageRef"))
            if metadata is None or image is None:
                raise InputError(
                    "it has no raw picture; files made for the web have none: give the one that the camera wrote"
                )
            return _Picture(_json(metadata), image)
        texts = [path.with_suffix(text) for text in (".txt", ".TXT") if path.with_suffix(text).is_file()]
        refuse_if(not texts, f"its metadata are not next to it, in {path.stem}.txt")
    with naming(texts[0]):
        text = _json(read_text(texts[0], _LARGEST_TEXT).encode())
        return _Picture(_within(_frame(text.get("master", text)), "metadata"), content)


def _sections(content: bytes) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the data of each section of a container."""
    refuse_if(not content.startswith(_MAGIC % b"P"), "it does not begin as a Lytro container")
    position = _HEADER
    while position < len(content):
        head = content[position : position + _HEADER]
        refuse_if(
            len(head) < _HEADER or head[:8] not in (_MAGIC % b"M", _MAGIC % b"C"),
            f"byte {position}: no section begins there, as it should: the file is damaged or cut off",
        )
        length = struct.unpack(">I", head[12:])[0]
        start = position + _HEADER + 80
        data = content[start : start + length]
        refuse_if(len(data) < length, f"byte {position}: a section of {length} bytes is cut off")
        name = content[position + _HEADER : start][:45].decode("ascii", "replace")
        refuse_if(
            name != f"sha1-{hashlib.sha1(data, usedforsecurity=False).hexdigest()}",
            f"byte {position}: the data of a section are damaged: their digest is another",
        )
        yield name, data
        position = start + length
        while content[position : position + 1] == b"\0":
            position += 1


def _json(data: bytes) -> Named:
    def refuse(constant: str) -> NoReturn:
        raise ValueError(f"{constant} is no number")

    refuse_if(len(data) > _LARGEST_TEXT, f"its metadata have {len(data)} bytes: they may have at most {_LARGEST_TEXT}")
    try:
        document = json.loads(data, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(f"its metadata are not JSON: {error}") from None
    refuse_if(not isinstance(document, dict), f"its metadata = {short_repr(document)}: they must be entries by name")
    return dict(document)


def _within(value: Any, *names: str | int) -> Any:
    """Return the value at a path of names in nested mappings and lists, None if the path does not exist."""
    for name in names:
        try:
            value = value[name]
        except (KeyError, IndexError, TypeError):
            return None
    return value


def _frame(contents: Any) -> Any:
    """Return the first frame of a table of contents, in ``frames`` of newer cameras or ``picture`` of others."""
    newer = _within(contents, "frames", 0, "frame")
    return _within(contents, "picture", "frameArray", 0, "frame") if newer is None else newer


def _capture_of(picture: _Picture) -> Capture:
    columns, rows = (require_count(f"image.{name}", picture.entry(f"image.{name}")) for name in ("width", "height"))
    # Of a pixel: its number of 2 bytes, two values in double precision and one in single.
    require_memory(22.0 * columns * rows, f"{columns} x {rows} pixels")
    numbers = _numbers(picture, columns, rows)
    tile = _tile(picture)
    # Digital numbers of the filters.
    black, white = (
        np.array([[picture.number(f"{levels}.{colour}", minimum=0, maximum=65535) for colour in row] for row in tile])
        for levels in (f"{picture.details}.pixelFormat.{name}" for name in ("black", "white"))
    )
    refuse_if((white <= black).any(), f"{picture.details}.pixelFormat: white must be above black")
    saturated = 0
    image = np.empty((rows, columns), np.float32)
    for j, i in np.ndindex(2, 2):
        plane = numbers[j::2, i::2]
        image[j::2, i::2] = (plane - black[j, i]) / (white[j, i] - black[j, i])
        saturated += int(np.count_nonzero(plane >= white[j, i]))
    mosaic = "".join(name[-1] if name in ("r", "b") else "g" for name in tile.flat).upper()
    record = {
        "mosaic": mosaic,
        "saturated_pixels": saturated,
        "image": picture.entry("image"),
        "devices": picture.entry("devices"),
    }
    return Capture(image, _camera_of(picture, columns, rows), metadata={RECORDED: record})


def _numbers(picture: _Picture, columns: int, rows: int) -> NDArray[np.uint16]:
    """Return the digital numbers of the pixels, unpacked."""
    packing = f"{picture.details}.pixelPacking"
    bits = picture.entry(f"{packing}.bitsPerPixel")
    order = picture.entry(f"{packing}.endianness")
    refuse_if(
        (bits, order) not in ((12, "big"), (10, "little")),
        f"{packing}: {short_repr(bits)} bits, {short_repr(order)}-endian: known are 12 bits, big, and 10 bits, little",
    )
    shift = picture.number(f"{picture.details}.pixelFormat.rightShift")
    refuse_if(shift != 0, f"{picture.details}.pixelFormat.rightShift = {shift:g}: only 0 is known")
    pixels = columns * rows
    data = np.frombuffer(picture.pixels, np.uint8)
    refuse_if(
        len(data) * 8 != pixels * bits or pixels % (2 if bits == 12 else 4),
        f"image: {len(data)} bytes for {columns} x {rows} pixels of {bits} bits",
    )
    numbers = np.empty(pixels, np.uint16)
    if bits == 12:
        first, second, third = data.reshape(-1, 3).T.astype(np.uint16)
        numbers[0::2] = first << 4 | second >> 4
        numbers[1::2] = (second & 15) << 8 | third
    else:
        *upper, lower = data.reshape(-1, 5).T.astype(np.uint16)
        for k, eight in enumerate(upper):
            numbers[k::4] = eight << 2 | lower >> 2 * k & 3
    return numbers.reshape(rows, columns)


def _tile(picture: _Picture) -> NDArray[np.str_]:
    """Return the colour filters of the first two pixels of the first two rows, (2, 2)."""
    name = f"{picture.details}.mosaic"
    text = picture.entry(f"{name}.tile")
    first = picture.entry(f"{name}.upperLeftPixel")
    refuse_if(text != "r,gr:gb,b", f"{name}.tile = {short_repr(text)}: only r,gr:gb,b is known")
    tile = np.array(_FILTERS).reshape(2, 2)
    j, i = divmod(_FILTERS.index(require_choice(f"{name}.upperLeftPixel", first, _FILTERS)), 2)
    return np.roll(tile, (-j, -i), (0, 1))


def _camera_of(picture: _Picture, columns: int, rows: int) -> PlenopticCamera:
    """Return the camera described by metadata in metres, with lengths in millimetres."""

    def length(name: str, **rules: Any) -> float:
        return picture.number(f"devices.{name}", **rules) * 1e3

    tiling = picture.entry("devices.mla.tiling")
    require_choice("devices.mla.tiling", tiling, _TILINGS)
    focal_length = length("lens.focalLength", positive=True)
    gap = length("mla.sensorOffset.z", positive=True)
    exit_pupil = length("lens.exitPupilOffset.z") or math.inf
    # Micro-images are (e + z) / e times as far from the axis as their lenses, and here (b + z) / b times.
    ours = focal_length / (focal_length + gap)
    scale = ours * (1 + gap / exit_pupil)
    pitch = length("mla.lensPitch", positive=True) * scale
    pitches = [pitch * picture.number(f"devices.mla.scaleFactor.{axis}", positive=True) for axis in "xy"]
    rotation = math.degrees(picture.number("devices.mla.rotation"))
    offset = np.array([length("mla.sensorOffset.x"), length("mla.sensorOffset.y")]) * ours
    if _TILINGS[tiling] == "square":
        # Our lattice has the corner of four lenses there, theirs a lens.
        offset += turn(pitches[0] / 2, pitches[1] / 2, rotation)
    return PlenopticCamera(
        focal_length=focal_length,
        aperture_radius=focal_length / (2 * picture.number("devices.lens.fNumber", positive=True)),
        mla_distance=focal_length,
        mla_focal_length=gap,
        mla_pitch=pitches[0] if pitches[0] == pitches[1] else tuple(pitches),
        mla_lattice=_TILINGS[tiling],
        mla_rotation=rotation,
        mla_offset=(float(offset[0]), float(offset[1])),
        detector_distance=gap,
        detector_width=columns * length("sensor.pixelPitch", positive=True),
        resolution=(columns, rows),
    )
