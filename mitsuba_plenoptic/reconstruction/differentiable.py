"""Refocusing by rays as a function of the capture that Dr.Jit differentiates, and through it PyTorch."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError, require_choice, require_count, require_number
from ..io.captures import as_array
from ..thin_lens import image_distance
from .arguments import FOOTPRINTS
from .radiance import is_reached
from .ray import pupil_radius
from .ray_adjoint import ray_sums_back
from .ray_sums import ray_sums, white_sums


class RayRefocus:
    """Refocus captures of one camera to one distance by rays: linear in the capture, with its transpose.

    Called with an array of Dr.Jit it is differentiable, forward and in reverse; ``drjit.wrap("torch", "drjit")`` makes
    it a function of PyTorch's tensors.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance in scene units, beyond the focal length; may be infinite.
    footprint : {"lens", "point"}
        As of `reconstruct`.
    oversample : int
        Bins per lens along each axis.

    Raises
    ------
    InputError
        If a parameter is out of range.
    """

    def __init__(
        self, camera: PlenopticCamera, distance: float, *, footprint: str = "lens", oversample: int = 1
    ) -> None:
        self._camera, self._distance = camera, require_number("distance", distance, finite=False)
        image_distance(camera.focal_length, self._distance)
        require_choice("footprint", footprint, FOOTPRINTS)
        numbers = camera, self._distance, pupil_radius(camera), footprint, require_count("oversample", oversample)
        self._numbers = numbers[1:]
        white = white_sums(*numbers)
        reached = is_reached(white)
        if not reached.any():
            raise InputError(f"distance = {distance:g}: no light comes from any of the {white.size} bins there")
        self._factor = np.where(reached, 1 / np.where(reached, white, 1), 0.0)

    def forward(self, capture: Any) -> np.ndarray:
        """Refocus a capture.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            What the detector has recorded.

        Returns
        -------
        float32 array (rows, columns) or (rows, columns, channels)
            Radiance of the bins, as by `reconstruct`, but 0 where that has NaN.
        """
        pixels = as_channels(as_array("capture", capture), self._camera.shape, "capture")
        sums = ray_sums(np.ascontiguousarray(pixels, np.float32), self._camera, *self._numbers)
        made = (sums * self._factor[..., None]).astype(np.float32)
        return made[..., 0] if np.ndim(capture) == 2 else made

    def adjoint(self, bins: Any) -> np.ndarray:
        """Apply the transpose of `forward`.

        Parameters
        ----------
        bins : array (rows, columns) or (rows, columns, channels)
            One value for each bin.

        Returns
        -------
        float32 array (rows, columns) or (rows, columns, channels)
            One value for each pixel.
        """
        given = as_channels(as_array("bins", bins), self._factor.shape, "bins") * self._factor[..., None]
        pixels = ray_sums_back(given, self._camera, *self._numbers).astype(np.float32)
        return pixels[..., 0] if np.ndim(bins) == 2 else pixels

    def __call__(self, capture: Any) -> Any:
        """Refocus a tensor of Dr.Jit, (rows, columns) or (rows, columns, channels), differentiably."""
        return dr.custom(_RayOp, capture, self)


class _RayOp(dr.CustomOp):
    """One use of a `RayRefocus`."""

    def eval(self, capture: Any, refocus: RayRefocus) -> Any:
        """Refocus."""
        self._refocus, self._kind = refocus, type(capture)
        return self._kind(refocus.forward(capture.numpy()))

    def forward(self) -> None:
        """Refocus the change of the capture."""
        self.set_grad_out(self._kind(self._refocus.forward(self.grad_in("capture").numpy())))

    def backward(self) -> None:
        """Take the gradient back to the capture."""
        self.set_grad_in("capture", self._kind(self._refocus.adjoint(self.grad_out().numpy())))

    def name(self) -> str:
        """Return what Dr.Jit calls it."""
        return "refocusing by rays"


def as_channels(values: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return (rows, columns, channels), or refuse another shape."""
    if values.ndim not in (2, 3) or values.shape[:2] != shape:
        raise InputError(f"{name} of shape {values.shape}: it must have {shape[0]} rows and {shape[1]} columns")
    return values if values.ndim == 3 else values[..., None]
