"""Display of captures, reconstructions and cameras in notebooks: a small picture, or the design sheet."""

import base64
from collections.abc import Sequence
from html import escape

from ...camera import PlenopticCamera
from ...io import Capture
from ...refocus import Reconstruction
from ...report import camera_figure, design_sheet, images, sheet_tables
from ...runtime import Array

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


def show_reconstructions(results: Sequence[Reconstruction]) -> str:
    """Return the HTML of reconstructions: their pictures side by side, on one scale."""
    white = images.Brightness().peak([result.image for result in results])
    figures = "".join(show_reconstruction(result, white) for result in results)
    return f'<div style="display: flex; flex-wrap: wrap">{figures}</div>'


def show_reconstruction(result: Reconstruction, white: float | None = None) -> str:
    """Return the HTML of a reconstruction: its picture."""
    rows, columns = result.image.shape[:2]
    small = images.shrink(result.image, _LONGEST)
    facts = f"{columns} x {rows} bins of {result.bin_size:.4g} mm"
    return _figure(small, f"Reconstruction at {result.distance:g} mm, {result.method}: {facts}", white)


def show_camera(camera: PlenopticCamera) -> str:
    """Return the HTML of a camera: a drawing, ten lines of the design sheet, and the sheet in collapsed tables."""
    picture = ""
    if camera.lens_data.converges:
        encoded = base64.b64encode(camera_figure(camera).png()).decode()
        picture = f'<img src="data:image/png;base64,{encoded}" alt="The camera from the side">'
    lines = "".join(
        f"<tr><td>{row.group}</td><td>{row.quantity}</td><td>{escape(row.value)} {row.unit}</td></tr>"
        for row in design_sheet(camera)[:10]
    )
    return f"{picture}<table>{lines}</table><details><summary>All of it</summary>{sheet_tables(camera)}</details>"


def _figure(image: Array, caption: str, white: float | None = None) -> str:
    """Return the HTML of a picture in its aspect ratio, with a radiance shown white; NaN is transparent."""
    grey = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    white = white or images.Brightness().peak([grey])
    style = f"width: {_SHOWN}px; image-rendering: {'pixelated' if max(grey.shape[:2]) < _SHOWN else 'auto'}"
    picture = f'<img src="{images.encode(grey, 8, white)["source"]}" style="{style}" alt="{escape(caption)}">'
    return f"<figure>{picture}<figcaption>{escape(caption)}; white is {white:.3g}</figcaption></figure>"
