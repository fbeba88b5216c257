"""Float32 OpenEXR images with one JSON attribute, written completely or not at all, and those of other programs."""

from __future__ import annotations

import contextlib
import itertools
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from ..errors import InputError, advice, naming, refuse_if, refusing, short_repr
from ..runtime.files import atomic_output, native_output_dropped, require_file
from ..runtime.limits import require_memory
from .versions import require_seal, sealed

ATTRIBUTE = "mitsuba_plenoptic"

_NOISE = "noise."

_LARGEST_HEADER = 2**26

_MAGIC = bytes((0x76, 0x2F, 0x31, 0x01))
"""Bytes that every OpenEXR file begins with."""

_LONGEST_NAME = 256

_SEVERAL_PARTS = 0x1000
"""Bit of the version that says so."""

_SRGB = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""Chromaticities of the primaries and of white (ITU-R BT.709), which files without any mean."""

# The others lose precision, which is not for captures.
_LOSSLESS = (
    OpenEXR.NO_COMPRESSION,
    OpenEXR.RLE_COMPRESSION,
    OpenEXR.ZIPS_COMPRESSION,
    OpenEXR.ZIP_COMPRESSION,
    OpenEXR.PIZ_COMPRESSION,
)


class ExrPart(NamedTuple):
    """The header of one part of an OpenEXR file: its data window, its channels, and all attributes."""

    origin: tuple[int, int]  # column and row
    columns: int
    rows: int
    channels: tuple[str, ...]
    header: dict[str, Any]


def write_exr(
    path: str | Path,
    image: np.ndarray,
    attributes: dict[str, Any],
    *,
    noise: np.ndarray | None = None,
    offset: tuple[int, int] = (0, 0),
    full_size: tuple[int, int] | None = None,
) -> None:
    """Write an image (rows, columns) as channel Y, or (rows, columns, 3) as channels R, G and B, of an OpenEXR file.

    Shapes: `image` (rows, columns[, 3]), `offset`, `full_size` (columns, rows).
    """
    channels = image_channels(image)
    if noise is not None:
        channels |= {_NOISE + name: values for name, values in image_channels(noise).items()}
    _write(path, {"": channels}, attributes, offset, full_size or image.shape[1::-1])


def write_exr_parts(
    path: str | Path, parts: Mapping[str, Mapping[str, np.ndarray]], attributes: dict[str, Any]
) -> None:
    """Write the parts of an OpenEXR file, each of channels (rows, columns) by name; the first has attributes."""
    # All parts of a file must share one display window.
    shapes = [plane.shape for channels in parts.values() for plane in channels.values()]
    _write(path, parts, attributes, (0, 0), (max(shape[1] for shape in shapes), max(shape[0] for shape in shapes)))


def _write(
    path: str | Path,
    parts: Mapping[str, Mapping[str, np.ndarray]],
    attributes: dict[str, Any],
    offset: tuple[int, int],
    full_size: tuple[int, ...],
) -> None:
    written: list[OpenEXR.Part] = []
    floats = [
        {key: np.ascontiguousarray(plane, np.float32) for key, plane in channels.items()} for channels in parts.values()
    ]
    for name, planes in zip(parts, floats, strict=True):
        rows, columns = next(iter(planes.values())).shape
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "dataWindow": _window(*offset, columns, rows),
            "displayWindow": _window(0, 0, *full_size),
        }
        if not written:
            with refusing(f"{path}: its attributes must be plain data for JSON:", TypeError, ValueError):
                header[ATTRIBUTE] = json.dumps(sealed(attributes, _in_order(floats)), sort_keys=True)
        written.append(OpenEXR.Part(header, planes, name))
    with refusing(f"{path}: it cannot be written:", RuntimeError, OSError), atomic_output(path, ".exr") as temporary:
        OpenEXR.File(written).write(str(temporary))


def _in_order(parts: Iterable[Mapping[str, np.ndarray]]) -> Iterator[np.ndarray]:
    """Yield the channels of parts in the order of the digest."""
    for planes in parts:
        for name in sorted(planes):
            yield planes[name]


def _window(x: int, y: int, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y], dtype=np.int32), np.array([x + columns - 1, y + rows - 1], dtype=np.int32)


def image_channels(image: np.ndarray) -> dict[str, np.ndarray]:
    """Return an image's channels by name: Y of (rows, columns), or R, G and B of (rows, columns, 3)."""
    if image.ndim == 2:
        return {"Y": image}
    return {name: image[..., i] for i, name in enumerate("RGB")}


def read_exr(path: str | Path) -> tuple[np.ndarray, np.ndarray | None, dict[str, Any]]:
    """Return the image, the noise if any, and the attributes of a file of `write_exr`."""
    path = require_file(path)
    parts = read_parts(path)
    with _undamaged(path):
        part = parts[0]
        refuse_if(
            ATTRIBUTE not in part.header,
            f"{path}: it has no attribute '{ATTRIBUTE}' in its header, so its camera is unknown; give "
            + advice(python="camera", shell="--camera, where a command has it"),
        )
        _require_lossless(part)
        colours = set("YRGB").intersection(part.channels)
        names: tuple[str, ...] = ("Y",) if colours == {"Y"} else ("R", "G", "B")
        if colours != set(names):
            hint = ", as ground truth has: name the capture that it belongs to" if "depth.Z" in part.channels else ""
            raise ValueError(f"it has the channels {', '.join(part.channels)} instead of Y or R, G, B{hint}")
        attributes = _attributes(part)
        layers = [names]
        if any(name.startswith(_NOISE) for name in part.channels):
            layers.append(tuple(_NOISE + name for name in names))
        # The library's arrays of all parts, of at most four bytes a pixel and channel, and ours.
        samples = sum(one.columns * one.rows * len(one.channels) for one in parts)
        samples += part.columns * part.rows * len(names) * len(layers)
        require_memory(4 * samples, f"{path}: {part.columns} x {part.rows} pixels of {len(part.channels)} channels")
        with _opened(path, parts) as file:
            found = file.channels()
            images, planes = [], {}
            for layer in layers:
                image = np.empty((part.rows, part.columns, len(layer)), dtype=np.float32)
                for index, name in enumerate(layer):
                    image[..., index] = found.pop(name).pixels.reshape(part.rows, part.columns)
                    planes[name] = image[..., index]
                images.append(image if len(layer) == 3 else image[..., 0])
        with naming(path):
            require_seal(attributes, _in_order([planes]))
    return images[0], images[1] if len(images) == 2 else None, attributes


def read_pixels(
    path: str | Path, full_size: tuple[int, int] | None = None, offset: tuple[int, int] = (0, 0), size: Any = None
) -> np.ndarray:
    """Return the pixels, (rows, columns[, 3]) in single precision, in the display window of another program's file.

    Shapes: `full_size`, `offset`, `size` (columns, rows): of a display window of the full size, a part is returned.
    """
    path = require_file(path)
    parts = read_parts(path)
    with _undamaged(path):
        part, names = _only_layer(parts)
        (left, top), (right, bottom) = (map(int, corner) for corner in part.header["displayWindow"])
        columns, rows = right - left + 1, bottom - top + 1
        if (columns, rows) == full_size:
            left, top, (columns, rows) = left + offset[0], top + offset[1], size
        left, top = left - part.origin[0], top - part.origin[1]
        refuse_if(
            min(left, top) < 0 or left + columns > part.columns or top + rows > part.rows,
            f"{path}: its data window of {part.columns} x {part.rows} pixels at {part.origin} does not cover the "
            f"{columns} x {rows} of the detector: write all, or give a camera with crop_offset and crop_size",
        )
        samples = sum(one.columns * one.rows * len(one.channels) for one in parts)
        require_memory(4 * samples + 12 * columns * rows, f"{path}: {samples} values")
        with _opened(path, parts) as file:
            found = file.parts[parts.index(part)].channels
            planes = [found[name].pixels for name in names]
            if any(plane.dtype.kind != "f" or plane.shape != (part.rows, part.columns) for plane in planes):
                raise ValueError("its channels must be of half or single precision, with a sample for each pixel")
            image = np.stack([plane[top : top + rows, left : left + columns] for plane in planes], -1, dtype=np.float32)
    return image if len(names) == 3 else image[..., 0]


def _only_layer(parts: list[ExrPart]) -> tuple[ExrPart, tuple[str, ...]]:
    """Return the part and the channels of a file's picture, grey or of the primaries of sRGB; refuse other files."""
    layers = []
    for part in parts:
        names = set(part.channels)
        for prefix in sorted({name[: name.rfind(".") + 1] for name in names}):
            if names.issuperset(prefix + name for name in "RGB"):
                layers.append((prefix, part, tuple(prefix + name for name in "RGB")))
            elif prefix + "Y" in names and not names.intersection(prefix + name for name in ("X", "Z", "RY", "BY")):
                layers.append((prefix, part, (prefix + "Y",)))
    chosen = [layer for layer in layers if not layer[0]] or layers
    if len(chosen) != 1 or len(chosen[0][1].header.get("multiView", ())) > 1:
        known = ", ".join(name for part in parts for name in part.channels)
        raise ValueError(f"its channels are {known}: they must be one picture, R, G and B or Y")
    _, part, names = chosen[0]
    header, primaries = part.header, np.ravel(part.header.get("chromaticities", _SRGB))
    if "deep" in str(header["type"]) or header.get("pixelAspectRatio", 1) != 1:
        raise ValueError("its pixels must be square, and not deep")
    if len(names) == 3 and (primaries.shape != (8,) or np.abs(primaries - _SRGB).max() > 2e-3):
        raise ValueError(f"its chromaticities are {short_repr(primaries.tolist())}: convert it to those of sRGB")
    return part, names


def read_exr_parts(path: str | Path) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, Any]]:
    """Return the float32 channels of each part, and the attributes, of a file of `write_exr_parts`."""
    path = require_file(path)
    parts = read_parts(path)
    with _undamaged(path):
        attributes = _attributes(parts[0])
        for part in parts:
            _require_lossless(part)
        samples = sum(one.columns * one.rows * len(one.channels) for one in parts)
        require_memory(8 * samples, f"{path}: {len(parts)} parts of {samples} values")
        with _opened(path, parts) as file:
            found = {}
            for part, read in zip(parts, file.parts, strict=True):
                shape = part.rows, part.columns
                planes = {name: np.asarray(one.pixels, np.float32).copy() for name, one in read.channels.items()}
                found[read.name()] = {name: plane.reshape(shape) for name, plane in planes.items()}
        with naming(path):
            require_seal(attributes, _in_order(found.values()))
    return found, attributes


def read_attributes(path: str | Path) -> dict[str, Any]:
    """Return the attributes of an OpenEXR file without its pixels; files of other programs have none."""
    path = require_file(path)
    parts = read_parts(path)
    with _undamaged(path):
        return _attributes(parts[0]) if ATTRIBUTE in parts[0].header else {}


def _attributes(part: ExrPart) -> dict[str, Any]:
    """Return the content of this package's attribute in an OpenEXR header."""
    attributes = json.loads(part.header.get(ATTRIBUTE, "null"))
    if not isinstance(attributes, dict):
        raise ValueError(f"attribute '{ATTRIBUTE}' is not a JSON object")
    return attributes


def read_parts(path: Path) -> list[ExrPart]:
    """Read the headers of an OpenEXR file, without pixels; refuse a file too large to be read whole."""
    with path.open("rb") as raw:

        def text() -> bytes:
            return b"".join(itertools.islice(iter(lambda: raw.read(1).strip(b"\0"), b""), _LONGEST_NAME))

        several = bool(int.from_bytes(raw.read(8)[4:], "little") & _SEVERAL_PARTS)
        # A name, a type, a size and a value each; no name ends a part, and no attribute at all the last one of several.
        # OpenEXR finds whether they are correct.
        attributes = 0
        while raw.tell() <= _LARGEST_HEADER:
            if text():
                text()
                raw.seek(int.from_bytes(raw.read(4), "little"), os.SEEK_CUR)
                attributes += 1
            elif several and attributes:
                attributes = 0
            else:
                break
        else:
            rule = "it may have at most as many"
            raise InputError(f"{path}: its header claims more than {_LARGEST_HEADER} bytes: {rule}")
    parts = []
    with (
        _undamaged(path),
        native_output_dropped(),
        OpenEXR.File(str(path), separate_channels=True, header_only=True) as file,
    ):
        for part in file.parts:
            (left, top), (right, bottom) = (map(int, corner) for corner in part.header["dataWindow"])
            names = tuple(channel.name for channel in part.header["channels"])
            # Closing the file empties its own dictionary.
            parts.append(ExrPart((left, top), right - left + 1, bottom - top + 1, names, dict(part.header)))
    return parts


@contextlib.contextmanager
def _undamaged(path: Path) -> Iterator[None]:
    """Refuse a damaged file with one message, whichever exception OpenEXR, JSON or NumPy raises."""
    with refusing(f"{path}: it cannot be read as an OpenEXR image, or is damaged:"):
        try:
            yield
        except RuntimeError as error:
            if not str(error).startswith("Unable to open"):
                raise
            # What OpenEXR says of all files that are there but that it cannot make out.
            with path.open("rb") as file:
                whole = file.read(len(_MAGIC)) == _MAGIC
            raise ValueError(
                "its header or the table of its lines is cut off or wrong" if whole else "it does not begin as one does"
            ) from None


@contextlib.contextmanager
def _opened(path: Path, parts: list[ExrPart]) -> Iterator[Any]:
    """Open the pixels of a file with given parts."""
    with native_output_dropped(), OpenEXR.File(str(path), separate_channels=True) as file:
        if len(file.parts) < len(parts):
            raise ValueError("its pixels are damaged or incomplete")
        yield file


def _require_lossless(part: ExrPart) -> None:
    if part.header["type"] != OpenEXR.scanlineimage or part.header["compression"] not in _LOSSLESS:
        raise ValueError("its pixels are tiled or deep, or their compression is lossy or unknown")
