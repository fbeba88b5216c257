"""The linear operator of a detector, from the light that falls on pixels to what they record without noise."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import numpy as np
import scipy

from ..camera import PlenopticCamera, StrayLight

SHARP: dict[str, Any] = {"detector_blur": 0.0, "pixel_crosstalk": 0.0, "stray_light": 0.0, "stray_width": None}
"""Parameters of a camera whose pixels record the light that falls on them."""


@dataclass(frozen=True, eq=False)
class DetectorOperator:
    r"""The linear operator D = S B of a detector on images (rows, columns[, channels]), each channel by itself.

    B is a kernel of sum 1 that is nowhere negative: a Gaussian blur, then crosstalk, by which the four neighbours of a
    pixel receive a fraction of its light. Light that would leave across the edge stays, so that B keeps the sum and is
    its own adjoint. S adds stray light, :math:`S I = I + s\,(K_w * I)`, where s is a number or a map (rows, columns)
    and :math:`K_w` a Gaussian, or the mean over the image if its width is infinite. Lengths are in pixels.

    Images are NumPy arrays, or tensors of Dr.Jit, which carry derivatives. A map may be a tensor of (rows, columns, 1).
    """

    blur: float = 0.0
    crosstalk: float = 0.0
    stray_light: Any = 0.0
    stray_width: float = math.inf

    @classmethod
    def of(cls, camera: PlenopticCamera) -> DetectorOperator:
        """Return the operator of a camera's detector."""
        pixel = camera.pixel_size
        width = math.inf if camera.stray_width is None else camera.stray_width / pixel
        stray: Any = camera.stray_light
        if isinstance(stray, StrayLight):
            sides = camera.detector_width, camera.detector_height
            stray = stray.at(*(camera.pixel_coordinates(axis) / side + 0.5 for axis, side in enumerate(sides)))
        return cls(camera.detector_blur / pixel, camera.pixel_crosstalk, stray, width)

    @property
    def is_identity(self) -> bool:
        """Whether pixels record the light as it falls on them."""
        return not (self.blur or self.crosstalk or self._strays)

    @property
    def _strays(self) -> bool:
        """Whether there is stray light; a map counts as some."""
        return not isinstance(self.stray_light, float) or self.stray_light > 0

    def forward(self, image: Any) -> Any:
        """Return what pixels record of the light that falls on them."""
        mixed = self._mixed(image)
        return mixed + self._stray(mixed) * self._around(mixed) if self._strays else mixed

    def adjoint(self, signal: Any) -> Any:
        """Return the transpose of `forward` applied to an image."""
        if self._strays:
            signal = signal + self._around(self._stray(signal) * signal)
        return self._mixed(signal)

    def slope(self, image: Any) -> Any:
        """Return the derivative of `forward` of an image by the logarithm of the pixels' width.

        The light on each pixel is fixed, and so are the lengths of the detector in millimetres.
        """
        change = replace(self, blur=0.0).forward(_blurred_slope(image, self.blur)) if self.blur else 0 * image
        if self._strays and math.isfinite(self.stray_width):
            change = change + self._stray(image) * _blurred_slope(self._mixed(image), self.stray_width)
        return -change

    def transfer(self, fx: Any, fy: Any) -> Any:
        """Return the Fourier transform of B at frequencies in cycles per pixel."""
        blurred = np.exp(-2 * (math.pi * self.blur) ** 2 * (fx * fx + fy * fy))
        return blurred * (1 - 2 * self.crosstalk * (2 - np.cos(2 * math.pi * fx) - np.cos(2 * math.pi * fy)))

    def _mixed(self, image: Any) -> Any:
        """Return B of an image."""
        if self.blur:
            kernel = _gaussian(self.blur)
            image = _correlated(_correlated(image, kernel, 0), kernel, 1)
        if self.crosstalk:
            beside = _correlated(image, (1.0, 0.0, 1.0), 0) + _correlated(image, (1.0, 0.0, 1.0), 1)
            image = (1 - 4 * self.crosstalk) * image + self.crosstalk * beside
        return image

    def _around(self, image: Any) -> Any:
        """Return the light around each pixel, over which stray light is spread."""
        if math.isfinite(self.stray_width):
            kernel = _gaussian(self.stray_width)
            return _correlated(_correlated(image, kernel, 0), kernel, 1)
        if isinstance(image, np.ndarray):
            return image.mean((0, 1), dtype=np.float64).astype(image.dtype)
        return dr.mean(image, axis=(0, 1))

    def _stray(self, image: Any) -> Any:
        """Return the fraction or map of stray light in the type and shape that multiply an image."""
        if not isinstance(self.stray_light, np.ndarray):
            return self.stray_light
        fraction = self.stray_light.reshape(*self.stray_light.shape, *[1] * (len(image.shape) - 2))
        return type(image)(fraction) if dr.is_tensor_v(image) else fraction.astype(image.dtype)


def _blurred_slope(image: Any, deviation: float) -> Any:
    """Return the derivative of a blurred image by the logarithm of the deviation, in pixels, of its Gaussian."""
    kernel = _gaussian(deviation)
    squares = (np.arange(len(kernel)) - len(kernel) // 2) ** 2.0
    # Of exp(-k^2/2 w^2) over its sum, whose variance is the deviation's square, by w, and of w by the deviation.
    slope = 2 * (squares - deviation**2) * kernel / (kernel @ squares**2 / deviation**2 - deviation**2)
    along, across = (_correlated(_correlated(image, tuple(slope.tolist()), axis), kernel, 1 - axis) for axis in (0, 1))
    return along + across


def _correlated(image: Any, kernel: tuple[float, ...], axis: int) -> Any:
    """Return an image correlated with a symmetric kernel along an axis; it is continued in a mirror at its edges."""
    if isinstance(image, np.ndarray):
        return scipy.ndimage.correlate1d(image, kernel, axis, mode="reflect")
    # A sum of shifted images: `dr.convolve` keeps arrays that `dr.freeze` does not know.
    size = image.shape[axis]
    stride = math.prod(image.shape[axis + 1 :])
    index = dr.arange(dr.uint32_array_t(dr.array_t(image)), math.prod(image.shape))
    position = index // stride % size
    total = dr.zeros(dr.array_t(image), len(index))
    for step, weight in enumerate(kernel, start=-(len(kernel) // 2)):
        if weight:
            beside = (position + step % (2 * size)) % (2 * size)
            beside = dr.select(beside < size, beside, 2 * size - 1 - beside)
            total += weight * dr.gather(type(total), image.array, index + (beside - position) * stride)
    dr.eval(total)
    return type(image)(total, image.shape)


@functools.lru_cache
def _gaussian(deviation: float) -> tuple[float, ...]:
    """Return samples of a Gaussian, of sum 1, with a standard deviation in pixels.

    Below a pixel the Gaussian is wider than that, as samples of a narrow one deviate less than itself.
    """
    # A Gaussian kernel ends at six standard deviations.
    reach = math.ceil(6 * deviation) + 3
    steps = np.arange(-reach, reach + 1)

    def samples(width: float) -> Any:
        weights = np.exp(-0.5 * (steps / width) ** 2)
        return weights / weights.sum()

    def excess(width: float) -> float:
        return float(samples(width) @ steps**2) - deviation**2

    # 0.02: Width in pixels of a Gaussian whose samples are 1.
    return tuple(samples(scipy.optimize.brentq(excess, 0.02, deviation + 1)).tolist())
