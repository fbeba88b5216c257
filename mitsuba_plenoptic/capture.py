"""A capture: what a plenoptic camera's detector recorded, with the camera, on disk as OpenEXR."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ._exr import read_exr, write_exr
from .camera import PlenopticCamera
from .errors import InputError, require_number

MODELS = ("ray", "wave")


@dataclass(frozen=True, eq=False)
class Capture:
    """What the detector of a plenoptic camera recorded.

    Parameters
    ----------
    image : (rows, columns[, channels]) array
        Pixel values, mean radiance over the aperture of the pixel's lens; kept as float32.
    camera : PlenopticCamera
        The camera; its `shape` is the image's.
    wavelength : float or tuple of three floats, optional
        Wavelength in nanometres, one a channel where there are three; None for a ray capture.
    model : {"ray", "wave"}
        How light was propagated.
    metadata : dict
        How it was made: scene, seed, samples, software versions. Plain JSON values.

    Raises
    ------
    InputError
        If the image does not fit the camera, or the model or wavelength is not a valid one.
    """

    image: np.ndarray
    camera: PlenopticCamera
    wavelength: float | tuple[float, ...] | None = None
    model: str = "ray"
    metadata: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.camera, PlenopticCamera):
            raise InputError(f"camera = {self.camera!r}: it must be a PlenopticCamera")
        image = np.asarray(self.image)
        if image.dtype.kind not in "fiu":
            raise InputError(f"image of type {image.dtype}: it must hold real numbers")
        if image.ndim not in (2, 3) or image.shape[:2] != self.camera.shape:
            raise InputError(
                f"image of shape {image.shape}: the camera records {self.camera.shape[0]} rows and "
                f"{self.camera.shape[1]} columns"
            )
        object.__setattr__(self, "image", np.asarray(image, dtype=np.float32))
        if self.model not in MODELS:
            raise InputError(f"model = {self.model!r}: it must be one of {', '.join(MODELS)}")
        if isinstance(self.wavelength, (tuple, list)):
            wavelengths = tuple(require_number("wavelength", value, positive=True) for value in self.wavelength)
            object.__setattr__(self, "wavelength", wavelengths)
        elif self.wavelength is not None:
            object.__setattr__(self, "wavelength", require_number("wavelength", self.wavelength, positive=True))


def write_capture(path: str | Path, capture: Capture) -> None:
    """Write a capture as float32 OpenEXR: channel Y, or R, G and B, with all about it in the header.

    The header attribute ``mitsuba_plenoptic`` is a JSON object with ``camera``, ``wavelength``, ``model`` and
    ``metadata``. Any EXR viewer shows the image. An existing file is replaced only by a complete one.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    camera = capture.camera
    attributes = {
        "kind": "capture",
        "camera": camera.to_dict(),
        "wavelength": capture.wavelength,
        "model": capture.model,
        "metadata": capture.metadata,
    }
    write_exr(path, capture.image, attributes, offset=camera.crop_offset, full_size=camera.resolution)


def read_capture(path: str | Path) -> Capture:
    """Read a capture that `write_capture` wrote.

    Raises
    ------
    InputError
        If the file does not exist, is damaged, or is not a capture.
    """
    image, attributes = read_exr(path)
    try:
        if attributes.get("kind") != "capture":
            raise InputError(f"it holds a {attributes.get('kind')!r}, not a capture")
        if not isinstance(attributes.get("camera"), dict):
            raise InputError("its header has no camera")
        return Capture(
            image=image,
            camera=PlenopticCamera.from_dict(attributes["camera"]),
            wavelength=attributes.get("wavelength"),
            model=attributes.get("model", ""),
            metadata=attributes.get("metadata") or {},
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
