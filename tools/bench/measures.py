"""Measures of images that several cases take."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from cases import agreement

from mitsuba_plenoptic.report.images import write_png

from .registry import Row


def without_noise(difference: float, *noises: float) -> float:
    """Return a relative difference from which the noise of both sides is subtracted."""
    return math.sqrt(max(difference**2 - sum(noise**2 for noise in noises), 0))


def mean_of_seeds(make: Callable[[int], np.ndarray], seeds: int) -> tuple[np.ndarray, float]:
    """Return the mean of the images of some seeds, at least two, and the noise of that mean over its norm."""
    images = np.array([make(seed) for seed in range(seeds)], float)
    mean = images.mean(0)
    return mean, math.sqrt(float(images.var(0, ddof=1).sum()) / seeds) / float(np.linalg.norm(mean))


def scores(images: Sequence[np.ndarray], references: Sequence[np.ndarray]) -> tuple[float, list[Row]]:
    """Return the one scale that suits all images best, and how well each then agrees with its reference."""
    scale, found = agreement(images, references)
    return scale, [{"psnr_db": psnr, "correlation": correlation, "scale": scale} for psnr, correlation in found]


def write_comparison(path: Path, image: np.ndarray, reference: np.ndarray, gain: float = 1.0) -> None:
    """Write image, reference and their difference, on mid-grey, side by side."""
    peak = float(reference.max())
    write_png(path, np.concatenate([image, reference, 0.5 * peak + gain * (image - reference)], 1), peak=peak)
