"""Float32 OpenEXR images with one JSON attribute, written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from ..errors import InputError
from ..runtime.limits import require_memory
from .exr_header import DamageError, Part, check_exr
from .files import atomic_output, require_file

ATTRIBUTE = "mitsuba_plenoptic"


def write_exr(
    path: str | Path,
    image: np.ndarray,
    attributes: dict[str, Any],
    *,
    offset: tuple[int, int] = (0, 0),
    full_size: tuple[int, int] | None = None,
) -> None:
    """Write (rows, columns) as channel Y or (rows, columns, 3) as R, G, B.

    Parameters
    ----------
    path : path
        File to write.
    image : (rows, columns[, 3]) array
        Written as float32.
    attributes : dict
        Written as JSON into the header attribute ``mitsuba_plenoptic``.
    offset, full_size : (columns, rows)
        Place of the image in a larger one: the file's data window within its display window.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    rows, columns = image.shape[:2]
    width, height = full_size or (columns, rows)
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "dataWindow": _window(offset[0], offset[1], columns, rows),
        "displayWindow": _window(0, 0, width, height),
        ATTRIBUTE: json.dumps(attributes, sort_keys=True),
    }
    try:
        with atomic_output(path) as temporary:
            OpenEXR.File(header, _channels(image)).write(str(temporary))
    except (RuntimeError, OSError) as error:
        raise InputError(f"{path}: it cannot be written: {error}") from None


def write_exr_parts(path: str | Path, parts: Mapping[str, np.ndarray], attributes: dict[str, Any]) -> None:
    """Write several images as the parts of one OpenEXR file.

    Parameters
    ----------
    path : path
        File to write.
    parts : mapping of names to (rows, columns[, 3]) arrays
        Written as float32, as channel Y or R, G, B.
    attributes : dict
        Written as JSON into the header attribute ``mitsuba_plenoptic`` of the first part.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    text = json.dumps(attributes, sort_keys=True)
    written = []
    for index, (name, image) in enumerate(parts.items()):
        rows, columns = image.shape[:2]
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "dataWindow": _window(0, 0, columns, rows),
            # All parts of a file must share one display window.
            "displayWindow": _window(0, 0, *_largest(parts)),
            **({ATTRIBUTE: text} if index == 0 else {}),
        }
        written.append(OpenEXR.Part(header, _channels(image), name))
    try:
        with atomic_output(path) as temporary:
            OpenEXR.File(written).write(str(temporary))
    except (RuntimeError, OSError) as error:
        raise InputError(f"{path}: it cannot be written: {error}") from None


def _largest(parts: Mapping[str, np.ndarray]) -> tuple[int, int]:
    return max(image.shape[1] for image in parts.values()), max(image.shape[0] for image in parts.values())


def _channels(image: np.ndarray) -> dict[str, np.ndarray]:
    image = np.asarray(image, dtype=np.float32)
    if image.ndim == 2:
        return {"Y": np.ascontiguousarray(image)}
    return {name: np.ascontiguousarray(image[..., i]) for i, name in enumerate("RGB")}


def read_exr(path: str | Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Read what `write_exr` wrote: the image and the attributes.

    Raises
    ------
    InputError
        If the file does not exist, is no whole OpenEXR file, was not written by this package, or its pixels would take
        more memory than is allowed.
    """
    path = require_file(path)
    try:
        (part, *_) = check_exr(path, lambda parts: _allow(path, parts))
        attributes = json.loads(part.text[ATTRIBUTE])
        if not isinstance(attributes, dict):
            raise ValueError(f"attribute '{ATTRIBUTE}' is not a JSON object")
        found = OpenEXR.File(str(path), separate_channels=True).channels()
        names = _image_channels(part)
        image = np.empty((part.rows, part.columns, len(names)), dtype=np.float32)
        for index, name in enumerate(names):
            image[..., index] = found.pop(name).pixels
    except InputError:
        raise
    except Exception as error:
        # OpenEXR tells of damage by several exception types; all mean the same to the user.
        raise InputError(f"{path}: it cannot be read as an OpenEXR image, or is damaged: {error}") from None
    return image if len(names) == 3 else image[..., 0], attributes


def _allow(path: Path, parts: list[Part]) -> None:
    """Refuse what is not of this package or takes too much memory, before pixels are read."""
    part = parts[0]
    if ATTRIBUTE not in part.text:
        raise InputError(
            f"{path}: it has no attribute '{ATTRIBUTE}' in its header, so its camera is unknown; "
            "read the pixels yourself and give reconstruct(..., camera=...)"
        )
    pixels = part.rows * part.columns
    # The library's arrays, and ours.
    needed = sum(part.size for part in parts) + 4 * pixels * len(_image_channels(part))
    require_memory(needed, f"{path}: {part.columns} x {part.rows} pixels of {len(part.channels)} channels")


def _image_channels(part: Part) -> tuple[str, ...]:
    for names in (("Y",), ("R", "G", "B")):
        if set(names) <= set(part.channels) and len(set("YRGB") & set(part.channels)) == len(names):
            return names
    raise DamageError(f"it has the channels {', '.join(part.channels)} instead of Y or R, G, B")


def _window(x: int, y: int, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y], dtype=np.int32), np.array([x + columns - 1, y + rows - 1], dtype=np.int32)
