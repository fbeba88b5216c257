"""Films that take captures by waves, and the gradients of what they make of them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray


def put(film: Any, image: NDArray[np.float32], channels: int) -> None:
    """Fill a film with an image (rows, columns, channels), of which those beyond some are extra ones, of noise."""
    extra = image.shape[2] - channels
    film.prepare([f"noise.{channel}" for channel in range(extra)])
    film.put_block(mi.ImageBlock(mi.TensorXf(_block(image, channels)), film.crop_offset()))


def develop(film: Any, image: NDArray[np.float32]) -> Any:
    """Return what a film makes of an image (rows, columns, channels): it is linear in it."""
    put(film, image, image.shape[2])
    return film.develop()


def develop_back(film: Any, gradient: Any, shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """Apply the transpose of `develop`.

    Parameters
    ----------
    film : mitsuba.Film
        The film.
    gradient : TensorXf
        With respect to the developed image.
    shape : (int, int, int)
        Rows, columns and channels of the image.
    """
    block = mi.TensorXf(_block(np.zeros(shape, np.float32), shape[2]))
    dr.enable_grad(block)
    film.prepare([])
    film.put_block(mi.ImageBlock(block, film.crop_offset()))
    developed = film.develop()
    dr.backward(dr.sum(developed * gradient, axis=None))
    colours = np.array(dr.grad(block))[..., :3]
    return np.asarray(colours if shape[2] == 3 else colours.sum(axis=2, keepdims=True), np.float32)


def _block(image: NDArray[np.float32], channels: int) -> NDArray[np.float32]:
    """Return red, green, blue, a weight of 1, and what else there is."""
    block = np.ones((*image.shape[:2], 4 + image.shape[2] - channels), dtype=np.float32)
    block[..., :3] = image[..., :channels]
    block[..., 4:] = image[..., channels:]
    return block
