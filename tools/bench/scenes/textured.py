"""Radiating surfaces whose depth and texture are given over the picture that the camera takes of them."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from mitsuba_plenoptic import PlenopticCamera

_OCTAVES = (1.0, 2.0, 4.0)
"""Standard deviations in lenses of the Gaussians that filter the noise of a texture."""

_FINER = 4
"""Samples of a texture per lens."""


def picture_axes(camera: PlenopticCamera, margin: float, per_lens: float) -> tuple[NDArray[np.float64], ...]:
    """Return x and y on the array, `per_lens` samples per lens, with a margin in lenses around the detector."""
    sizes = camera.detector_width, camera.detector_height
    halves = [size / 2 + margin * camera.mla_pitch for size in sizes]
    return tuple(np.linspace(-half, half, round(2 * half / camera.mla_pitch * per_lens) + 1) for half in halves)


def texture(camera: PlenopticCamera, margin: float, seed: int) -> NDArray[np.float32]:
    """Return noise of several octaves, (rows, columns), between 0.05 and 2."""
    shape = tuple(len(axis) for axis in reversed(picture_axes(camera, margin, _FINER)))
    noise, random = np.zeros(shape), np.random.default_rng(seed)
    for width in _OCTAVES:
        octave = scipy.ndimage.gaussian_filter(random.standard_normal(shape), width * _FINER)
        noise += octave / octave.std()
    return np.clip(1 + 0.3 * noise, 0.05, 2).astype(np.float32)


def relief(camera: PlenopticCamera, inverse_depth: Any, margin: float, seed: int) -> dict[str, Any]:
    """Return the objects of a scene whose reciprocal depth is a function of x and y on the array."""
    x, y = picture_axes(camera, margin, 1.0)
    across, up = np.meshgrid(x, y)
    depth = 1 / inverse_depth(across, up)
    scale = -depth / camera.mla_distance
    points = np.stack([across * scale, up * scale, depth], -1).reshape(-1, 3)
    corner = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    faces = np.concatenate(
        [np.stack(three, 1) for three in ((corner, corner + len(x), corner + 1),
                                          (corner + 1, corner + len(x), corner + len(x) + 1))]
    )  # fmt: skip
    picture = mi.load_dict(
        {"type": "bitmap", "bitmap": mi.Bitmap(texture(camera, margin, seed)), "raw": True, "wrap_mode": "clamp"}
    )
    properties = mi.Properties()
    properties["emitter"] = mi.load_dict({"type": "area", "radiance": picture})
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": 0.0})
    mesh = mi.Mesh("relief", len(points), len(faces), has_vertex_texcoords=True, props=properties)
    values = mi.traverse(mesh)
    values["vertex_positions"] = points.astype(np.float32).ravel()
    values["faces"] = faces.astype(np.uint32).ravel()
    u, v = np.meshgrid(np.linspace(0, 1, len(x)), np.linspace(0, 1, len(y)))
    values["vertex_texcoords"] = np.stack([u, v], -1).astype(np.float32).ravel()
    values.update()
    return {"relief": mesh}
