"""A picture of the first samples of a data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..report.images import shrink, write_png
from .reader import DataSet

_ROWS, _WIDTH = 8, 256


def write_preview(path: Path, samples: DataSet) -> None:
    """Write a PNG with a row for each of the first eight samples: its captures, and depth, near in white."""
    rows = []
    for index in range(min(_ROWS, len(samples))):
        arrays = samples[index].arrays
        captures = [array for name, array in arrays.items() if name.startswith(("ray", "wave"))]
        peak = max(float(np.percentile(capture, 99.5)) for capture in captures) or 1.0
        pictures = [_grey(capture) / peak for capture in captures]
        if "depth" in arrays:
            pictures.append(_nearness(arrays["depth"]))
        rows.append(np.concatenate([shrink(picture, _WIDTH) for picture in pictures], axis=1))
    width = min(row.shape[1] for row in rows)
    write_png(path, np.concatenate([row[:, :width] for row in rows]), peak=1.0)


def _grey(image: np.ndarray) -> np.ndarray:
    return image.mean(axis=2) if image.ndim == 3 else image


def _nearness(depth: np.ndarray) -> np.ndarray:
    """Return the inverse of depths from 0, as far as any, to 1."""
    known = np.isfinite(depth)
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=known & (depth > 0))
    if not known.any():
        return inverse
    low, high = inverse[known].min(), inverse[known].max()
    return np.asarray(np.where(known, 0.1 + 0.9 * (inverse - low) / max(high - low, 1e-12), 0), np.float32)
