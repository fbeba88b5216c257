"""Mitsuba's own `thinlens` as the outside referee of refocused images."""

from __future__ import annotations

import math

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import PlenopticCamera


def thin_lens_image(scene: object, camera: PlenopticCamera, distance: float, spp: int) -> np.ndarray:
    """Render what a thin lens of the camera's aperture sees when focused at `distance`, one pixel a bin.

    Parameters
    ----------
    scene : mitsuba.Scene
        A scene whose first sensor is the plenoptic camera.
    camera : PlenopticCamera
        That camera.
    distance : float
        Distance in focus.
    spp : int
        Samples per pixel.

    Returns
    -------
    (rows, columns) float64 array
    """
    columns, rows = camera.lens_count
    sensor = mi.load_dict(
        {
            "type": "thinlens",
            "aperture_radius": camera.aperture_radius,
            "focus_distance": distance,
            "fov": math.degrees(2 * math.atan(columns * camera.mla_pitch / (2 * camera.mla_distance))),
            "to_world": mi.ScalarTransform4f(scene.sensors()[0].world_transform().matrix.numpy()[..., 0]),
            "film": {
                "type": "hdrfilm",
                "width": columns,
                "height": rows,
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
                "component_format": "float32",
            },
        }
    )
    return np.array(mi.render(scene, sensor=sensor, spp=spp), dtype=np.float64)[..., 0]


def best_shift(image: np.ndarray, reference: np.ndarray) -> tuple[int, int]:
    """Whole-bin shift (rows, columns) of `image` at which it correlates best with the reference."""
    spectrum = np.fft.fft2(image - image.mean()) * np.conj(np.fft.fft2(reference - reference.mean()))
    peak = np.unravel_index(np.argmax(np.fft.ifft2(spectrum).real), image.shape)
    row, column = ((int(p) + n // 2) % n - n // 2 for p, n in zip(peak, image.shape, strict=True))
    return row, column


def agreement(images: list[np.ndarray], references: list[np.ndarray]) -> tuple[float, list[tuple[float, float]]]:
    """One least-squares scale for all images, then PSNR (peak: the reference's maximum) and correlation of each.

    Returns
    -------
    scale : float
    scores : list of (PSNR in dB, correlation)
    """
    pairs = list(zip(images, references, strict=True))
    scale = sum((a * b).sum() for a, b in pairs) / sum((a * a).sum() for a, _ in pairs)
    scores = []
    for image, reference in pairs:
        mean_square = np.mean((scale * image - reference) ** 2)
        psnr = 10 * math.log10(reference.max() ** 2 / mean_square)
        scores.append((psnr, float(np.corrcoef(image.ravel(), reference.ravel())[0, 1])))
    return float(scale), scores
