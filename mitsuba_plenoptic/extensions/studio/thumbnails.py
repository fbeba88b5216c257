"""Display of captures, reconstructions and cameras in notebooks: a small picture, or the design sheet."""

from __future__ import annotations

from html import escape

import numpy as np

from ...camera import PlenopticCamera
from ...io import Capture
from ...refocus import Reconstruction
from ...report import images, sheet_tables

# Longest side of a picture in pixels, and the size at which it is shown.
_LONGEST = 512
_SHOWN = 256


def show_capture(capture: Capture) -> str:
    """Return the HTML of a capture: its picture."""
    rows, columns = capture.camera.shape
    small = images.shrink(capture.image, _LONGEST)
    averaged = f", drawn at {small.shape[1]} x {small.shape[0]}" if small.shape != capture.image.shape else ""
    light = "" if capture.wavelength is None else f", {capture.wavelength} nm"
    return _figure(small, f"Capture, {capture.model} model{light}: {columns} x {rows} pixels{averaged}")


def show_reconstruction(result: Reconstruction) -> str:
    """Return the HTML of a reconstruction: its picture."""
    rows, columns = result.image.shape[:2]
    small = images.shrink(result.image, _LONGEST)
    facts = f"{columns} x {rows} bins of {result.bin_size:.4g} mm"
    return _figure(small, f"Reconstruction at {result.distance:g} mm, {result.method}: {facts}")


def show_camera(camera: PlenopticCamera) -> str:
    """Return the HTML of a camera: the design sheet as collapsible tables."""
    return f"<details open><summary>{escape(repr(camera))}</summary>{sheet_tables(camera)}</details>"


def _figure(image: np.ndarray, caption: str) -> str:
    """Return the HTML of a picture in its aspect ratio; NaN is transparent."""
    grey = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    white = images.Brightness().peak([grey])
    style = f"width: {_SHOWN}px; image-rendering: {'pixelated' if max(grey.shape[:2]) < _SHOWN else 'auto'}"
    picture = f'<img src="{images.encode(grey, 8, white)["source"]}" style="{style}" alt="{escape(caption)}">'
    return f"<figure>{picture}<figcaption>{escape(caption)}; white is {white:.3g}</figcaption></figure>"
