"""Raw captures as 16-bit pictures: the digital numbers of a detector, and all about them in the file's description.

TIFF (Adobe, "TIFF", revision 6.0) keeps the description in the tag ImageDescription, PNG (W3C, "Portable Network
Graphics", third edition) in a text chunk; other programs show the numbers and skip it.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ..camera import PlenopticCamera
from ..errors import InputError, naming, refuse_if, require_number
from ..runtime.limits import require_memory
from .captures import Capture
from .files import atomic_output, reading_as, require_file, require_writable

RAW_SUFFIXES = (".png", ".tif", ".tiff")

_KEY = "mitsuba_plenoptic"
"""Name of the PNG chunk, and of the object in a TIFF's description."""

_PIXEL_BYTES = 16.0


def write_raw(path: str | Path, capture: Capture) -> None:
    """Write what a detector has recorded as the digital numbers that it gave, in 16 bits.

    Parameters
    ----------
    path : path
        File to write; the name ends in ``.png``, ``.tif`` or ``.tiff``.
    capture : Capture
        What `expose` returned; a mosaic, or grey, or in TIFF files of three channels.

    Raises
    ------
    InputError
        If the capture was not exposed, its values are no digital numbers of its detector, a PNG would have three
        channels, or the file cannot be written.
    """
    path = require_writable(path, *RAW_SUFFIXES)
    numbers = digital_numbers(capture)
    about = {
        "kind": "raw",
        "camera": capture.camera.to_dict(),
        "wavelength": capture.wavelength,
        "model": capture.model,
        "metadata": capture.metadata,
    }
    text = json.dumps({_KEY: about})
    if path.suffix.lower() == ".png":
        refuse_if(numbers.ndim == 3, f"{path}: raw pictures of three channels are written as .tiff")
        information = PngInfo()
        information.add_text(_KEY, text)
        with atomic_output(path) as temporary:
            Image.fromarray(numbers).save(temporary, format="PNG", pnginfo=information)
        return
    with atomic_output(path) as temporary:
        photometric = "rgb" if numbers.ndim == 3 else "minisblack"
        tifffile.imwrite(temporary, numbers, photometric=photometric, description=text, metadata=None)


def read_raw(path: str | Path) -> Capture:
    """Read a capture that `write_raw` wrote: digital numbers, in the units of the capture that was exposed.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        If the file does not exist, is damaged, or states no detector and camera, as those of other programs.
    """
    path = require_file(path)
    numbers, text = _read(path)
    try:
        about = json.loads(text)[_KEY]
        given = about["camera"], about["metadata"]["exposure"]
        if not all(isinstance(part, dict) for part in given):
            raise TypeError("camera and exposure are no objects")
    except (ValueError, TypeError, KeyError, RecursionError):
        raise InputError(f"{path}: it states no camera and detector; a raw picture needs its camera") from None
    with naming(path):
        return Capture(
            image=_values(numbers, about["metadata"]["exposure"]),
            camera=PlenopticCamera.from_dict(about["camera"]),
            wavelength=about.get("wavelength"),
            model=about.get("model", ""),
            metadata=about["metadata"],
        )


def states_detector(path: str | Path) -> bool:
    """Return whether a picture states its camera and detector, so that `read_raw` reads it."""
    return f'"{_KEY}"' in _read(require_file(path))[1]


def digital_numbers(capture: Capture) -> NDArray[np.uint16]:
    """Return the digital numbers that a detector gave for an exposed capture."""
    exposure = capture.metadata.get("exposure")
    if not isinstance(exposure, dict):
        raise InputError("capture: no detector has recorded it; expose it first")
    gain, black, dark, unit = response_of(exposure)
    exact = (capture.image.astype(np.float64) * unit + dark) * gain + black
    numbers = np.rint(exact)
    # Single precision separates a number of 16 bits from its neighbours.
    refuse_if(
        np.abs(exact - numbers).max(initial=0) > 0.1 or numbers.min(initial=0) < 0 or numbers.max(initial=0) > 65535,
        "capture: its values are no digital numbers of its detector; write it as .exr",
    )
    return numbers.astype(np.uint16)


def _values(numbers: NDArray[Any], exposure: dict[str, Any]) -> NDArray[np.float32]:
    gain, black, dark, unit = response_of(exposure)
    return (((numbers.astype(np.float64) - black) / gain - dark) / unit).astype(np.float32)


def response_of(exposure: dict[str, Any]) -> tuple[float, float, float, float]:
    """Return gain, black level, dark electrons, and electrons in a pixel of value 1, from the record of `expose`."""
    for name in ("gain", "black_level", "dark_electrons", "quantum_efficiency", "photons"):
        refuse_if(name not in exposure, f"exposure: {name}: it is missing")
    gain, efficiency, photons = (
        require_number(name, exposure[name], positive=True) for name in ("gain", "quantum_efficiency", "photons")
    )
    black, dark = (require_number(name, exposure[name], minimum=0) for name in ("black_level", "dark_electrons"))
    return gain, black, dark, efficiency * photons


def _read(path: Path) -> tuple[NDArray[Any], str]:
    """Return the pixels of a picture and its description."""
    require_memory(2 * path.stat().st_size, f"{path}: {path.stat().st_size} bytes")
    with reading_as(path, "a picture"):
        if path.suffix.lower() == ".png":
            with Image.open(path, formats=["PNG"]) as picture:
                require_memory(_PIXEL_BYTES * picture.width * picture.height, f"{path}: its pixels")
                text = str(picture.info.get(_KEY, ""))
                return np.asarray(picture), text
        with tifffile.TiffFile(path) as file:
            page = file.pages[0]
            require_memory(_PIXEL_BYTES * page.size, f"{path}: its pixels")
            return page.asarray(), str(page.description)


def scaled_from(capture: Capture, black_level: float) -> Capture:
    """Return a capture of values from 0 to 1, of 65535 digital numbers, with another number as black."""
    black = require_number("black_level", black_level, minimum=0, maximum=65534) / 65535
    return replace(capture, image=(capture.image - np.float32(black)) / np.float32(1 - black))
