"""Depth by a small trained network: the baseline ``network``.

A light field is compared with planes at fixed depths. For each depth, all views are shifted so that a point there lies
in the same bin of all of them; the variance over the views is small where the depth is right. Two layers of 3 x 3
convolutions take these variances from the bins around a bin, and a third one gives weights of the depths, whose mean
inverse is the answer. ``tools/train_network.py`` trained the network and wrote ``network.npz``; here NumPy applies it.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import scipy.ndimage
import xarray as xr

from ...camera import PlenopticCamera
from ...views import disparity
from .scenes import FAR, NEAR

DEPTHS = 1 / np.linspace(1 / (NEAR - 3), 1 / (FAR + 4), 24)
"""Depths of the planes in millimetres, evenly in their inverse, which all of the benchmark's objects lie between."""

WEIGHTS = Path(__file__).with_name("network.npz")

_PUPIL = 0.85
"""Part of the pupil's radius of which views are compared: others are dark in part."""

_SMOOTH = 0.7
"""Width in bins over which variances are averaged."""


def costs(light_field: xr.DataArray, camera: PlenopticCamera) -> np.ndarray:
    """Return what the network sees of a light field: (depths + 1, t, s), the logarithms of variances.

    The first are those of the views at each depth relative to the last, the variance of the picture around a bin.
    """
    v, u = (
        index - size // 2 for index, size in zip(np.indices(light_field.shape[:2]), light_field.shape, strict=False)
    )
    inside = np.hypot(v, u) * camera.pupil_step <= _PUPIL * camera.aperture_radius
    views, v, u = light_field.values[inside], v[inside], u[inside]
    central = views[(v == 0) & (u == 0)][0]
    spread = _blurred(central**2, 2.0) - _blurred(central, 2.0) ** 2
    floor = 1e-5 * float(np.mean(central)) ** 2
    texture = np.log(np.maximum(spread, 0) + floor)
    found = []
    for depth in DEPTHS:
        shift = disparity(light_field, float(depth))
        total, squares = np.zeros_like(central, np.float64), np.zeros_like(central, np.float64)
        for view, down, across in zip(views, v * shift, u * shift, strict=True):
            moved = scipy.ndimage.shift(view.astype(np.float64), (-down, -across), order=1, mode="nearest")
            total += moved
            squares += moved**2
        variance = squares / len(views) - (total / len(views)) ** 2
        found.append(np.log(_blurred(np.maximum(variance, 0), _SMOOTH) + floor) - texture)
    return np.stack([*found, texture - 2 * np.log(float(np.mean(central)))]).astype(np.float32)


def _blurred(image: np.ndarray, width: float) -> np.ndarray:
    return np.asarray(scipy.ndimage.gaussian_filter(image.astype(np.float64), width, mode="nearest"))


def depths(seen: np.ndarray) -> np.ndarray:
    """Return the depths (t, s) that the network finds in what it sees."""
    layers = _layers()
    for number, (kernel, bias) in enumerate(layers):
        seen = _convolved(seen, kernel) + bias[:, None, None]
        if number < len(layers) - 1:
            seen = np.maximum(seen, 0)
    weights = np.exp(seen - seen.max(axis=0))
    return np.asarray(1 / np.tensordot(1 / DEPTHS, weights / weights.sum(axis=0), 1))


def _convolved(seen: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Correlate channels (in, t, s) with a kernel (out, in, rows, columns); beyond the border, values repeat."""
    room = kernel.shape[-1] // 2
    padded = np.pad(seen, ((0, 0), (room, room), (room, room)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape[-2:], axis=(1, 2))
    return np.einsum("oiab,itsab->ots", kernel, windows, optimize=True)


@cache
def _layers() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the kernel and the bias of each layer."""
    with np.load(WEIGHTS) as stored:
        return [(stored[f"kernel_{k}"], stored[f"bias_{k}"]) for k in range(len(stored.files) // 2)]
