"""Images by Mitsuba's own cameras, the independent reference of refocused images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera

_RAYS_PER_PASS = 2**24


def thin_lens_image(scene: Any, camera: PlenopticCamera, distance: float, spp: int, oversample: int = 1) -> np.ndarray:
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
    oversample : int
        Bins per lens along each axis.

    Returns
    -------
    (rows, columns) float64 array
    """
    lens = {"type": "thinlens", "aperture_radius": camera.aperture_radius, "focus_distance": distance}
    columns, rows = camera.bin_count
    return _photograph(scene, camera, lens, (columns * oversample, rows * oversample), spp)


def pinhole_image(scene: Any, camera: PlenopticCamera, columns: int, spp: int) -> np.ndarray:
    """Render the camera's field of view from the centre of its main lens, everything sharp.

    Parameters
    ----------
    scene : mitsuba.Scene
        A scene whose first sensor is the plenoptic camera.
    camera : PlenopticCamera
        That camera.
    columns : int
        Width of the picture.
    spp : int
        Samples per pixel.

    Returns
    -------
    (rows, columns) float64 array
    """
    rows = round(columns * camera.bin_count[1] / camera.bin_count[0])
    return _photograph(scene, camera, {"type": "perspective"}, (columns, rows), spp)


def _photograph(
    scene: Any, camera: PlenopticCamera, lens: dict[str, Any], size: tuple[int, int], spp: int
) -> np.ndarray:
    width = camera.bin_count[0] * camera.mla_pitch
    sensor = mi.load_dict(
        {
            **lens,
            "fov": math.degrees(2 * math.atan(width / (2 * camera.mla_distance))),
            "to_world": mi.ScalarTransform4f(scene.sensors()[0].world_transform().matrix.numpy()[..., 0]),
            "film": {
                "type": "hdrfilm",
                "width": size[0],
                "height": size[1],
                "rfilter": {"type": "box"},
                "pixel_format": "luminance",
                "component_format": "float32",
            },
        }
    )
    integrator = scene.integrator()
    # A wave integrator's child sees the scene by rays.
    integrator = getattr(integrator, "child", integrator)
    total = np.zeros((size[1], size[0]))
    per_pass = min(spp, max(1, _RAYS_PER_PASS // (size[0] * size[1])))
    for index in range(-(-spp // per_pass)):
        count = min(per_pass, spp - index * per_pass)
        part = mi.render(scene, sensor=sensor, integrator=integrator, spp=count, seed=index)
        total += count / spp * np.array(part, dtype=np.float64)[..., 0]
    return total


def best_shift(image: np.ndarray, reference: np.ndarray) -> tuple[int, int]:
    """Whole-bin shift (rows, columns) of `image` at which it correlates best with the reference."""
    spectrum = np.fft.fft2(image - image.mean()) * np.conj(np.fft.fft2(reference - reference.mean()))
    peak = np.unravel_index(np.argmax(np.fft.ifft2(spectrum).real), image.shape)
    row, column = ((int(p) + n // 2) % n - n // 2 for p, n in zip(peak, image.shape, strict=True))
    return row, column


def agreement(
    images: Sequence[np.ndarray], references: Sequence[np.ndarray]
) -> tuple[float, list[tuple[float, float]]]:
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
