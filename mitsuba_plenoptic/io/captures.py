"""A capture: what a plenoptic camera's detector recorded, with the camera, on disk as OpenEXR."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..bounds import require_wavelength
from ..camera import PlenopticCamera, require_camera
from ..errors import InputError, naming, refuse_if, require_choice, short_repr, suggest_keywords
from .exr import read_exr, write_exr

MODELS = ("ray", "wave")

_MOST_SATURATED = 0.01

BRIGHTEST = 1e30
"""Magnitude of a pixel at most: what is summed and squared of it stays within single precision's 3e38."""


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class Capture:
    """The image that the detector of a plenoptic camera recorded.

    Parameters
    ----------
    image : (rows, columns[, 1 or 3]) array
        Pixel values, mean radiance over the aperture of the pixel's lens; stored as float32. All are finite and at most
        1e30 in magnitude: a capture with NaN or infinity cannot be made.
    camera : PlenopticCamera
        The camera; its `shape` is the image's.
    wavelength : float or tuple of three floats, optional
        Wavelength in nanometres, 200 to 2500, one for all channels or one for each; None for a ray capture.
    model : {"ray", "wave"}
        How light was propagated.
    metadata : dict
        How it was made: scene, seed, samples, software versions. Plain JSON values.
    noise : array like the image, optional
        Standard deviation of each pixel from the samples of which it is made, as `render_capture` estimates it; stored
        as float32.

    Raises
    ------
    InputError
        If image or noise does not fit the camera or holds a pixel that is not allowed, or the model, a wavelength or
        the metadata is not a valid one.
    """

    image: np.ndarray
    camera: PlenopticCamera
    wavelength: float | tuple[float, ...] | None = None
    model: str = "ray"
    metadata: dict[str, Any] = field(default_factory=dict)
    noise: np.ndarray | None = None

    def __post_init__(self) -> None:
        require_camera(self.camera)
        image = as_array("image", self.image)
        refuse_if(
            image.ndim not in (2, 3) or image.shape[:2] != self.camera.shape,
            f"image of shape {image.shape}: the camera records {self.camera.shape[0]} rows and "
            f"{self.camera.shape[1]} columns",
        )
        channels = image.shape[2] if image.ndim == 3 else 1
        refuse_if(channels not in (1, 3), f"image of shape {image.shape}: a capture has 1 channel or 3")
        require_pixels("image", image)
        object.__setattr__(self, "image", np.asarray(image, dtype=np.float32))
        require_choice("model", self.model, MODELS)
        if isinstance(self.wavelength, (tuple, list)):
            refuse_if(
                len(self.wavelength) != channels,
                f"wavelength = {short_repr(self.wavelength)}: the image has {channels} channels",
            )
            object.__setattr__(self, "wavelength", tuple(require_wavelength(value) for value in self.wavelength))
        elif self.wavelength is not None:
            object.__setattr__(self, "wavelength", require_wavelength(self.wavelength))
        if not isinstance(self.metadata, dict):
            raise InputError(f"metadata = {short_repr(self.metadata)}: it must be a dictionary")
        if self.noise is not None:
            noise = as_array("noise", self.noise)
            refuse_if(
                noise.dtype.kind not in "fiu" or noise.shape != image.shape,
                f"noise of type {noise.dtype} and shape {noise.shape}: it must be as the image",
            )
            require_pixels("noise", noise)
            if noise.min(initial=0) < 0:
                raise InputError(f"noise: {np.count_nonzero(noise < 0)} of its pixels are negative")
            object.__setattr__(self, "noise", np.asarray(noise, dtype=np.float32))

    def __repr__(self) -> str:
        """Describe the capture in one line."""
        rows, columns = self.camera.shape
        colours = " x 3" if self.image.ndim == 3 else ""
        light = "" if self.wavelength is None else f", {short_repr(self.wavelength)} nm"
        noise = "" if self.noise is None else f", noise {self.relative_noise:.2%}"
        return (
            f"Capture({columns} x {rows}{colours} pixels by {self.model}s{light}, mean {self.image.mean():.4g}{noise})"
        )

    @property
    def relative_noise(self) -> float | None:
        """Root mean square of the noise over the mean of the pixels; None if the noise is not known."""
        if self.noise is None:
            return None
        mean = float(self.image.mean(dtype=np.float64))
        return float(np.sqrt(np.mean(np.square(self.noise, dtype=np.float64)))) / mean if mean else 0.0


def as_array(name: str, values: Any) -> np.ndarray:
    """Return the array of something that should be one, of regular shape and of real numbers."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: it must be an array: {error}") from None
    refuse_if(array.dtype.kind not in "fiu", f"{name} of type {array.dtype}: it must hold real numbers")
    return array


def require_pixels(name: str, image: np.ndarray) -> None:
    """Refuse an image with pixels that are not finite or of a magnitude above `BRIGHTEST`: how many, and the first."""
    # The largest and the smallest value show every NaN too, and cost far less than a test of each.
    if image.size == 0 or max(float(image.max()), -float(image.min())) <= BRIGHTEST:
        return
    bad = ~np.isfinite(image)
    what, rule = "NaN or infinite", "finite"
    if not bad.any():
        bad, what, rule = (
            np.abs(image.astype(np.float64)) > BRIGHTEST,
            "too large",
            f"{BRIGHTEST:g} at most in magnitude",
        )
    first = ", ".join(str(index) for index in np.argwhere(bad)[0])
    raise InputError(f"{name}: {bad.sum()} of its pixels are {what}, the first at ({first}): all must be {rule}")


def require_suitable_white(white: Capture, cameras: Sequence[PlenopticCamera]) -> None:
    """Refuse a white capture by another camera than a capture's, or with many saturated pixels."""
    exposure = white.metadata.get("exposure")
    saturated = exposure.get("saturated_pixels", 0) if isinstance(exposure, dict) else 0
    pixels = math.prod(white.camera.shape)
    refuse_if(
        isinstance(saturated, (int, float)) and saturated > _MOST_SATURATED * pixels,
        f"white: {saturated} of its {pixels} pixels are saturated: they must be at most {_MOST_SATURATED:.0%}",
    )
    if not cameras or white.camera in cameras:
        return
    theirs, ours = white.camera.to_dict(), cameras[-1].to_dict()
    name = next(name for name in {**ours, **theirs} if theirs.get(name) != ours.get(name))
    raise InputError(
        f"white: its camera has {name} = {short_repr(theirs.get(name))}, that of the capture "
        f"{short_repr(ours.get(name))}: it must be by the camera of the capture"
    )


def write_capture(path: str | Path, capture: Capture) -> None:
    """Write a capture as float32 OpenEXR: channel Y, or R, G and B, with all about it in the header.

    The noise, if it has any, is a layer of the same file: noise.Y, or noise.R, noise.G and noise.B.

    The header attribute ``mitsuba_plenoptic`` is a JSON object with ``camera``, ``wavelength``, ``model`` and
    ``metadata``. Any EXR viewer shows the image. An existing file is replaced only by a complete one.

    Parameters
    ----------
    path : path
        File to write.
    capture : Capture
        What to write.

    Raises
    ------
    InputError
        If it is not a capture, its metadata are not plain data, or the file cannot be written.
    """
    refuse_if(not isinstance(capture, Capture), f"capture of type {type(capture).__name__}: it must be a Capture")
    camera = capture.camera
    attributes = {
        "kind": "capture",
        "camera": camera.to_dict(),
        "wavelength": capture.wavelength,
        "model": capture.model,
        "metadata": capture.metadata,
    }
    window = {"offset": camera.crop_offset, "full_size": camera.resolution}
    write_exr(path, capture.image, attributes, noise=capture.noise, **window)


def read_capture(path: str | Path) -> Capture:
    """Read a capture that `write_capture` wrote.

    Parameters
    ----------
    path : path
        The file.

    Raises
    ------
    InputError
        If the file does not exist, is damaged, or is not a capture.
    """
    image, noise, attributes = read_exr(path)
    with naming(path):
        refuse_if(
            attributes.get("kind") != "capture", f"it holds a {short_repr(attributes.get('kind'))}, not a capture"
        )
        refuse_if(not isinstance(attributes.get("camera"), dict), "its header has no camera")
        return Capture(
            image=image,
            camera=PlenopticCamera.from_dict(attributes["camera"]),
            wavelength=attributes.get("wavelength"),
            model=attributes.get("model", ""),
            metadata=attributes.get("metadata", {}),
            noise=noise,
        )
