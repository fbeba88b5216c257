"""Image metrics: how far images are from each other, in numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import skimage.metrics

from ..camera import PlenopticCamera

_WINDOW = 7
"""Pixels across the window of the structural similarity."""


@dataclass(frozen=True)
class ImageMetrics:
    """How close an image is to its reference."""

    # Peak signal-to-noise ratio in dB; the peak is the reference's maximum.
    psnr: float
    # Structural similarity over windows of 7 x 7 pixels; None for smaller images, which have no such window.
    ssim: float | None
    # Sum over the reference's sum.
    energy: float

    def to_dict(self) -> dict[str, float | None]:
        """Return the numbers by name, rounded to what they mean."""
        return {name: None if value is None else round(value, 5) for name, value in asdict(self).items()}


def ssim_text(ssim: float | None) -> str:
    """Return a structural similarity as text: images too small for it have none."""
    return "not defined" if ssim is None else f"{ssim:.3f}"


def common_scale(images: Sequence[np.ndarray], references: Sequence[np.ndarray]) -> float:
    """Find the one factor on all images that brings them closest to their references (least squares)."""
    products = sum(float(np.nansum(a * b)) for a, b in zip(images, references, strict=True))
    squares = sum(float(np.nansum(np.square(a))) for a in images)
    return products / squares if squares > 0 else 1.0


def image_metrics(image: np.ndarray, reference: np.ndarray) -> ImageMetrics:
    """Compare an image with a reference of the same shape, brightness and all.

    Pixels that are NaN in the image are not compared.
    """
    image, reference = np.asarray(image, np.float32), np.asarray(reference, np.float32)
    unknown = np.isnan(image)
    image, reference = np.where(unknown, 0, image), np.where(unknown, 0, reference)
    peak = float(reference.max())
    mean_square = float(np.mean((image - reference) ** 2, dtype=np.float64))
    total = float(reference.sum(dtype=np.float64))
    return ImageMetrics(
        psnr=10 * math.log10(peak**2 / mean_square) if mean_square > 0 and peak > 0 else math.inf,
        ssim=_similarity(image, reference, peak),
        energy=float(image.sum(dtype=np.float64)) / total if total > 0 else 1.0,
    )


def _similarity(image: np.ndarray, reference: np.ndarray, peak: float) -> float | None:
    """Return the structural similarity of two images, None if they are smaller than its window."""
    if min(image.shape) < _WINDOW:
        return None
    if peak <= 0:
        return 1.0
    return float(skimage.metrics.structural_similarity(image, reference, win_size=_WINDOW, data_range=peak))


def relative_error(image: np.ndarray, reference: np.ndarray) -> float:
    """Root of the summed squared differences over that of the reference."""
    difference = np.asarray(image, np.float64) - reference
    return float(np.linalg.norm(difference) / np.linalg.norm(reference))


def interference(image: np.ndarray, limit: np.ndarray, region: np.ndarray | tuple[slice, slice]) -> float:
    """Return how far a reconstruction is from the limit in which no two lenses interfere.

    The root mean square of their difference over the limit's mean, within a region of bins. A high-pass filter would
    not do as a measure, because it sees detail where there is any.
    """
    difference = np.asarray(image, np.float64)[region] - limit[region]
    mean = float(np.nanmean(limit[region], dtype=np.float64))
    return float(np.sqrt(np.nanmean(difference**2)) / mean) if mean > 0 else 0.0


def lit_region(limit: np.ndarray, fraction: float = 0.1) -> np.ndarray:
    """Mark the bins that are brighter than a fraction of the brightest."""
    return limit > fraction * np.nanmax(limit)


def shape_window(camera: PlenopticCamera, low: np.ndarray, high: np.ndarray) -> tuple[slice, slice] | None:
    """Find the bins (rows, columns) that hold a box in the scene, seen from the centre of the main lens; None if none.

    Its corners (x, y, z) are given in the camera's frame, and its depth is taken as that of its middle.
    """
    z = (low[2] + high[2]) / 2
    spans = []
    for axis in (1, 0):
        count = camera.bin_count[axis]
        # Image coordinates grow against the scene's.
        ends = [-value * camera.mla_distance / (z * camera.mla_pitch) + count / 2 for value in (high[axis], low[axis])]
        span = slice(max(0, math.floor(ends[0])), min(count, math.ceil(ends[1])))
        if span.start >= span.stop:
            return None
        spans.append(span)
    return spans[0], spans[1]
