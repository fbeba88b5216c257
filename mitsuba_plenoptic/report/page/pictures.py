"""What the report's page shows and its script moves: pictures as data URLs, and their geometry."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ..experiment import SLIDER_METHODS, Experiment
from ..framing import Window, Zoom, common_peak, lit_window
from ..images import to_bytes
from ..metrics import ssim_text

# Bytes for one capture, so that the file stays below 12 MB; each WebP quality is tried until one fits.
_CAPTURE_BYTES = 3_500_000
_QUALITIES = (85, 70, 50, 30)


def report_window(experiment: Experiment) -> Window:
    """Return the part of the field that the page shows."""
    return lit_window([*experiment.truths.values(), experiment.pinhole], fraction=0.02, margin=0.03)


def captures(experiment: Experiment, window: Window) -> dict[str, str]:
    """Encode the captures, of one scale, as pictures of bounded size."""
    ray, wave = (window.of(capture.image) for capture in (experiment.ray, experiment.wave))
    peak = float(np.quantile(ray[ray > 0.05 * ray.max()], 0.98)) if ray.max() > 0 else 1.0
    return {"ray": _webp(ray, peak), "wave": _webp(wave, peak)}


def geometry(experiment: Experiment, zooms: Sequence[Zoom], window: Window) -> dict[str, Any]:
    """Return the size of the capture's cut-out, and the places to zoom to in fractions of it."""
    rows, columns = experiment.wave.image.shape
    height, width = window.of(experiment.wave.image).shape
    top, left = round(window.top * rows), round(window.left * columns)
    return {
        "width": width,
        "height": height,
        "pixel": experiment.camera.pixel_size,
        "regions": [
            {
                "x": ((zoom.columns.start + zoom.columns.stop) / 2 - left) / width,
                "y": ((zoom.rows.start + zoom.rows.stop) / 2 - top) / height,
                "size": (zoom.columns.stop - zoom.columns.start) / width,
            }
            for zoom in zooms
        ],
    }


def shown_distances(experiment: Experiment) -> list[float]:
    """List the distances of the slider."""
    return sorted({*experiment.settings.slider, *experiment.settings.distances})


def reconstructions(experiment: Experiment, numbers: dict[str, Any], window: Window) -> dict[str, Any]:
    """Return pictures by method and distance, with the metrics of those that have some."""
    distances = shown_distances(experiment)
    peak = common_peak([experiment.truths[distance] for distance in distances], window)
    facts: dict[str, dict[str, list[list[str]]]] = {}
    for row in numbers["reconstructions"]:
        told = [["PSNR", f"{row['psnr']:.1f} dB"], ["SSIM", ssim_text(row["ssim"])], ["Energy", f"{row['energy']:.3f}"]]
        if "interference" in row:
            told.append(["Interference", f"{row['interference']:.1%}"])
        facts.setdefault(row["method"], {})[f"{row['distance']:g}"] = told
    return {
        "distances": [float(f"{distance:g}") for distance in distances],
        "images": {
            name: {f"{distance:g}": _png(window.of(experiment.image(name, distance)), peak) for distance in distances}
            for name in ("truth", *SLIDER_METHODS)
        },
        "facts": facts,
    }


def plate(path: Path, caption: str) -> dict[str, Any]:
    """Take a figure into the page."""
    content = path.read_bytes()
    width, height = Image.open(io.BytesIO(content)).size
    return {"source": _data_url("png", content), "width": width, "height": height, "caption": caption}


def _webp(image: np.ndarray, peak: float) -> str:
    picture = Image.fromarray(to_bytes(image, peak))
    content = b""
    for quality in _QUALITIES:
        content = _encoded(picture, format="WEBP", quality=quality, method=4)
        if len(content) <= _CAPTURE_BYTES:
            break
    return _data_url("webp", content)


def _png(image: np.ndarray, peak: float) -> str:
    return _data_url("png", _encoded(Image.fromarray(to_bytes(image, peak)), format="PNG", optimize=True))


def _encoded(picture: Image.Image, **options: Any) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, **options)
    return buffer.getvalue()


def _data_url(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
