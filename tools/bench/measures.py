"""Measures of images that several cases take."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mitsuba_plenoptic import PlenopticCamera, design
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.report.metrics import common_scale, image_metrics

from .registry import Row


def relative(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the relative difference in the L2 norm."""
    return float(np.linalg.norm(image - reference) / np.linalg.norm(reference))


def without_noise(difference: float, *noises: float) -> float:
    """Return a relative difference from which the noise of both sides is subtracted."""
    return math.sqrt(max(difference**2 - sum(noise**2 for noise in noises), 0))


def mean_of_seeds(make: Callable[[int], np.ndarray], seeds: int) -> tuple[np.ndarray, float]:
    """Return the mean of the images of some seeds, at least two, and the noise of that mean over its norm."""
    images = np.array([make(seed) for seed in range(seeds)], float)
    mean = images.mean(0)
    return mean, math.sqrt(float(images.var(0, ddof=1).sum()) / seeds) / float(np.linalg.norm(mean))


def best_shift(image: np.ndarray, reference: np.ndarray) -> tuple[int, int]:
    """Whole-bin shift (rows, columns) of `image` at which it correlates best with the reference."""
    spectrum = np.fft.fft2(image - image.mean()) * np.conj(np.fft.fft2(reference - reference.mean()))
    peak = np.unravel_index(np.argmax(np.fft.ifft2(spectrum).real), image.shape)
    row, column = ((int(p) + n // 2) % n - n // 2 for p, n in zip(peak, image.shape, strict=True))
    return row, column


def agreement(
    images: Sequence[np.ndarray], references: Sequence[np.ndarray]
) -> tuple[float, list[tuple[float, float]]]:
    """Return the `common_scale` of images, and then the PSNR in dB and the correlation of each with its reference."""
    scale = common_scale(images, references)
    scores = [
        (image_metrics(scale * image, reference).psnr, float(np.corrcoef(image.ravel(), reference.ravel())[0, 1]))
        for image, reference in zip(images, references, strict=True)
    ]
    return scale, scores


def scores(images: Sequence[np.ndarray], references: Sequence[np.ndarray]) -> tuple[float, list[Row]]:
    """Return the one scale that suits all images best, and how well each then agrees with its reference."""
    scale, found = agreement(images, references)
    return scale, [{"psnr_db": psnr, "correlation": correlation, "scale": scale} for psnr, correlation in found]


def write_comparison(path: Path, image: np.ndarray, reference: np.ndarray, gain: float = 1.0) -> None:
    """Write image, reference and their difference, on mid-grey, side by side."""
    peak = float(reference.max())
    write_png(path, np.concatenate([image, reference, 0.5 * peak + gain * (image - reference)], 1), peak=peak)


def spot_filtered(image: np.ndarray, camera: PlenopticCamera, wavelength: float = 633.0) -> np.ndarray:
    """Convolve a capture with the spot of a square lens, whose transfer function is a triangle along each axis."""
    size = 2 * image.shape[0]
    frequency = np.fft.fftfreq(size, camera.pixel_size)
    triangle = (1 - np.abs(frequency) * design.spot_radius(camera, wavelength)).clip(min=0)
    spectrum = np.fft.rfft2(image, (size, size))
    spectrum *= triangle[:, None] * triangle[: size // 2 + 1]
    return np.fft.irfft2(spectrum, (size, size))[: image.shape[0], : image.shape[1]]
