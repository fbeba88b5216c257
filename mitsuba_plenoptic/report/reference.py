"""Images by Mitsuba's own cameras, the independent reference of refocused images.

They are taken of a scene whose first sensor is the plenoptic camera, with `spp` samples per pixel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from .metrics import common_scale, image_metrics

_RAYS_PER_PASS = 2**24


def thin_lens_image(scene: Any, camera: PlenopticCamera, distance: float, spp: int, oversample: int = 1) -> np.ndarray:
    """Render what a thin lens of the camera's aperture sees when focused at `distance`, one pixel a bin.

    There are `oversample` bins per lens along each axis.
    """
    lens = {"type": "thinlens", "aperture_radius": camera.aperture_radius, "focus_distance": distance}
    columns, rows = camera.bin_count
    return _photograph(scene, camera, lens, (columns * oversample, rows * oversample), spp)


def pinhole_image(scene: Any, camera: PlenopticCamera, columns: int, spp: int) -> np.ndarray:
    """Render the camera's field of view from the centre of its main lens, so many columns wide, everything sharp."""
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
    """Return the `common_scale` of images, and then the PSNR in dB and the correlation of each with its reference."""
    scale = common_scale(images, references)
    scores = [
        (image_metrics(scale * image, reference).psnr, float(np.corrcoef(image.ravel(), reference.ravel())[0, 1]))
        for image, reference in zip(images, references, strict=True)
    ]
    return scale, scores
