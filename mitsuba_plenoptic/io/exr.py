"""Float32 OpenEXR images with one JSON attribute, written completely or not at all, and those of other programs."""

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenEXR

from ..camera import PlenopticCamera
from ..errors import advice, content_of, naming, refuse_if, refusing, short_repr
from ..runtime import (
    Array,
    Named,
    Pair,
    Shape,
    atomic_output,
    native_output_dropped,
    of_one_file,
    require_file,
    require_memory,
)
from .versions import require_seal, sealed

ATTRIBUTE = "mitsuba_plenoptic"

_NOISE = "noise."

_MAGIC = bytes((0x76, 0x2F, 0x31, 0x01))
"""Bytes that every OpenEXR file begins with."""

_SRGB = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""Chromaticities of the primaries and of white (ITU-R BT.709), which files without any mean."""


class ExrPart(NamedTuple):
    """The header of one part of an OpenEXR file: its data window, its channels, and all attributes."""

    origin: Shape  # column and row
    columns: int
    rows: int
    channels: tuple[str, ...]
    header: Named


def write_exr(
    path: str | Path,
    image: Array,
    attributes: Named,
    *,
    noise: Array | None = None,
    offset: Shape = (0, 0),
    full_size: Shape | None = None,
) -> None:
    """Write an image (rows, columns) as channel Y, or (rows, columns, 3) as channels R, G and B, of an OpenEXR file.

    Shapes: `image` (rows, columns[, 3]), `offset`, `full_size` (columns, rows).
    """
    channels = image_channels(image)
    if noise is not None:
        channels |= {_NOISE + name: values for name, values in image_channels(noise).items()}
    write_exr_parts(path, {"": channels}, attributes, offset=offset, full_size=full_size)


def write_exr_parts(
    path: str | Path,
    parts: Mapping[str, Mapping[str, Array]],
    attributes: Named,
    *,
    offset: Shape = (0, 0),
    full_size: Shape | None = None,
) -> None:
    """Write the parts of an OpenEXR file, each of channels (rows, columns) by name; the first has attributes."""
    floats = [
        {key: np.ascontiguousarray(plane, np.float32) for key, plane in channels.items()} for channels in parts.values()
    ]
    shapes = [next(iter(planes.values())).shape for planes in floats]
    # All parts of a file must share one display window.
    display = _window(0, 0, *(full_size or (max(columns for _, columns in shapes), max(rows for rows, _ in shapes))))
    with refusing(f"{path}: its attributes must be plain data for JSON:", TypeError, ValueError):
        record = {ATTRIBUTE: json.dumps(sealed(attributes, floats), sort_keys=True)}
    written: list[OpenEXR.Part] = []
    for name, planes, (rows, columns) in zip(parts, floats, shapes, strict=True):
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "dataWindow": _window(*offset, columns, rows),
            "displayWindow": display,
        }
        written.append(OpenEXR.Part(header if written else header | record, planes, name))
    with refusing(f"{path}: it cannot be written:", RuntimeError, OSError), atomic_output(path, ".exr") as temporary:
        OpenEXR.File(written).write(str(temporary))


def _window(x: int, y: int, columns: int, rows: int) -> Pair:
    return np.array([x, y], dtype=np.int32), np.array([x + columns - 1, y + rows - 1], dtype=np.int32)


def image_channels(image: Array) -> dict[str, Array]:
    """Return an image's channels by name: Y of (rows, columns), or R, G and B of (rows, columns, 3)."""
    if image.ndim == 2:
        return {"Y": image}
    return {name: image[..., i] for i, name in enumerate("RGB")}


def read_exr(path: str | Path) -> tuple[Array, Array | None, Named]:
    """Return the image, the noise if any, and the attributes of a file of `write_exr`."""
    parts, attributes = read_exr_parts(path)
    planes = next(iter(parts.values()))
    names = ("Y",) if planes.keys().isdisjoint("RGB") else ("R", "G", "B")
    hint = ", as ground truth has: name the capture that it belongs to" if "depth.Z" in planes else ""
    refuse_if(
        planes.keys() & set("YRGB") != set(names),
        f"{path}: it cannot be read as an OpenEXR image: it has the channels {', '.join(planes)} instead of Y or R, G, "
        f"B{hint}",
    )
    if len(names) == 1:
        return planes["Y"], planes.get(_NOISE + "Y"), attributes
    noisy = all(_NOISE + name in planes for name in names)
    image, noise = (np.stack([planes[layer + name] for name in names], -1) for layer in ("", _NOISE * noisy))
    return image, noise if noisy else None, attributes


@of_one_file
def read_exr_parts(path: str | Path) -> tuple[dict[str, dict[str, Array]], Named]:
    """Return the float32 channels of each part, and the attributes, of a file of `write_exr_parts`."""
    path = require_file(path)
    parts = read_parts(path)
    with _undamaged(path):
        attributes = _attributes(path, parts[0])
        # The others lose precision, which is not for captures.
        if any(
            part.header["type"] != OpenEXR.scanlineimage
            or part.header["compression"]
            not in (
                OpenEXR.NO_COMPRESSION,
                OpenEXR.RLE_COMPRESSION,
                OpenEXR.ZIPS_COMPRESSION,
                OpenEXR.ZIP_COMPRESSION,
                OpenEXR.PIZ_COMPRESSION,
            )
            for part in parts
        ):
            raise ValueError("its pixels are tiled or deep, or their compression is lossy or unknown")
        with _opened(path, parts) as file:
            planes_of_parts = {}
            for part, read in zip(parts, file.parts, strict=True):
                shape = part.rows, part.columns
                planes = {name: np.array(channel.pixels, np.float32) for name, channel in read.channels.items()}
                planes_of_parts[read.name()] = {name: plane.reshape(shape) for name, plane in planes.items()}
        with naming(path):
            require_seal(attributes, [*planes_of_parts.values()])
    return planes_of_parts, attributes


@of_one_file
def read_pixels(path: str | Path, camera: PlenopticCamera | None = None) -> Array:
    """Return the pixels, (rows, columns[, 3]) in single precision, in the display window of another program's file.

    Of a display window as large as the camera's whole detector, the part that the camera records is returned.
    """
    path = require_file(path)
    parts = read_parts(path)
    with _undamaged(path):
        layer, names = _only_layer(parts)
        (left, top), (right, bottom) = (map(int, corner) for corner in layer.header["displayWindow"])
        size = (right - left + 1, bottom - top + 1)
        top = top - layer.origin[1]
        left = left - layer.origin[0]
        if camera is not None and size == camera.resolution:
            left = left + camera.crop_offset[0]
            top = top + camera.crop_offset[1]
            size = camera.crop_size
        refuse_if(
            min(left, top) < 0 or left + size[0] > layer.columns or top + size[1] > layer.rows,
            f"{path}: its data window of {layer.columns} x {layer.rows} pixels at {layer.origin} does not cover the "
            f"{size[0]} x {size[1]} of the detector: write all, or give a camera with crop_offset and crop_size",
        )
        with _opened(path, parts) as file:
            channels = file.parts[parts.index(layer)].channels
            planes = [channels[name].pixels for name in names]
            if any(plane.dtype.kind != "f" or plane.shape != (layer.rows, layer.columns) for plane in planes):
                raise ValueError("its channels must be of half or single precision, with a sample for each pixel")
            cut = np.s_[top : top + size[1], left : left + size[0]]
            image = np.stack([plane[cut] for plane in planes], -1, dtype=np.float32)
    return image if len(names) == 3 else image[..., 0]


def _only_layer(parts: list[ExrPart]) -> tuple[ExrPart, tuple[str, ...]]:
    """Return the part and the channels of a file's picture, grey or of the primaries of sRGB; refuse other files."""
    layers = []
    for part in parts:
        for prefix in sorted({name[: name.rfind(".") + 1] for name in part.channels}):
            names_in_layer = {name.removeprefix(prefix) for name in part.channels if name.rfind(".") + 1 == len(prefix)}
            names = tuple("RGB") if names_in_layer.issuperset("RGB") else ("Y",)
            if names_in_layer.issuperset(names) and (
                len(names) == 3 or names_in_layer.isdisjoint(("X", "Z", "RY", "BY"))
            ):
                layers.append((prefix, part, tuple(prefix + name for name in names)))
    chosen = [layer for layer in layers if not layer[0]] or layers
    if len(chosen) != 1 or len(chosen[0][1].header.get("multiView", ())) > 1:
        all_names = ", ".join(name for part in parts for name in part.channels)
        raise ValueError(f"its channels are {all_names}: they must be one picture, R, G and B or Y")
    _, part, names = chosen[0]
    primaries = tuple(part.header.get("chromaticities", _SRGB)) if len(names) == 3 else _SRGB
    if part.header.get("pixelAspectRatio", 1) != 1 or not np.allclose(primaries, _SRGB, atol=2e-3):
        raise ValueError(f"its pixels must be square, and its chromaticities, {short_repr(primaries)}, those of sRGB")
    return part, names


@of_one_file
def read_attributes(path: str | Path) -> Named:
    """Return the attributes of an OpenEXR file without its pixels; files of other programs have none."""
    path = require_file(path)
    parts = read_parts(path)
    with _undamaged(path):
        return _attributes(path, parts[0]) if ATTRIBUTE in parts[0].header else {}


def _attributes(path: Path, layer: ExrPart) -> Named:
    """Return the content of this package's attribute in an OpenEXR header."""
    refuse_if(
        ATTRIBUTE not in layer.header,
        f"{path}: it has no attribute '{ATTRIBUTE}' in its header, so its camera is unknown; give "
        + advice(python="camera", shell="--camera, where a command has it"),
    )
    attributes = json.loads(layer.header[ATTRIBUTE])
    if not isinstance(attributes, dict):
        raise ValueError(f"attribute '{ATTRIBUTE}' is not a JSON object")
    return attributes


def read_parts(path: Path) -> list[ExrPart]:
    """Return the headers of the parts of an OpenEXR file."""
    with path.open("rb") as file:
        refuse_if(
            file.read(len(_MAGIC)) != _MAGIC,
            f"{path}: it is {content_of(path)}; give OpenEXR of this package or a raw picture, as .png or .tiff",
        )
    parts = []
    with (
        _undamaged(path),
        native_output_dropped(),
        OpenEXR.File(str(path), separate_channels=True, header_only=True) as opened,
    ):
        for layer in opened.parts:
            (left, top), (right, bottom) = (map(int, corner) for corner in layer.header["dataWindow"])
            names = tuple(channel.name for channel in layer.header["channels"])
            # Closing the file empties its own dictionary.
            parts.append(ExrPart((left, top), right - left + 1, bottom - top + 1, names, dict(layer.header)))
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
            # What OpenEXR says of all files that it cannot make out.
            raise ValueError("its header or the table of its lines is cut off or wrong") from None


@contextlib.contextmanager
def _opened(path: Path, parts: list[ExrPart]) -> Iterator:
    """Open the pixels of a file with given parts."""
    # The library's arrays of all parts, of at most four bytes a pixel and channel, and ours.
    samples = sum(
        header_of_part.columns * header_of_part.rows * len(header_of_part.channels) for header_of_part in parts
    )
    first = parts[0]
    size = f"{first.columns} x {first.rows} pixels of {len(first.channels)} channels"
    require_memory(8 * samples, f"{path}: {size}")
    with native_output_dropped(), OpenEXR.File(str(path), separate_channels=True) as file:
        if len(file.parts) < len(parts):
            raise ValueError("its pixels are damaged or incomplete")
        yield file
