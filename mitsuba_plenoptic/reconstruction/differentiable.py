"""Refocusing by rays as a function of the capture that Dr.Jit differentiates, and through it PyTorch."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..errors import InputError, require_choice, require_count, require_number
from ..io.captures import as_array, require_pixels
from ..lenses.wave_cameras import require_ideal
from ..runtime.backend import one_at_a_time
from ..system.optical_system import OpticalSystem
from ..thin_lens import image_distance
from .arguments import FOOTPRINTS
from .bins import BinSums
from .coherent_chain import AmplitudeFields, Linearised
from .radiance import LensSpread, divisors, is_reached
from .ray import pupil_radius
from .ray_sums import ray_sums, ray_sums_back, white_sums
from .waves import fine_bins
from .white import white_light


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


class CoherentRefocus:
    """Refocus captures of one camera to one distance by waves, with derivatives by the pixels.

    The wave's amplitude is the square root of a pixel, so that the image is no linear function of the capture:
    `derivative` and `gradient` hold at one capture. Called with an array of Dr.Jit it is differentiable, forward and in
    reverse; ``drjit.wrap("torch", "drjit")`` makes it a function of PyTorch's tensors.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance in scene units, beyond the focal length; may be infinite.
    wavelength : float
        In nanometres, of all channels.
    interleave : int
        1: one coherent wave, as by ``method="coherent"``; else the period of the subsets of ``method="partial"``.
    oversample : int
        Bins per lens along each axis.

    Raises
    ------
    InputError
        If a parameter is out of range, waves do not refocus captures of such a camera, or the fields take too much
        memory.
    """

    def __init__(
        self, camera: PlenopticCamera, distance: float, wavelength: float, *, interleave: int = 1, oversample: int = 1
    ) -> None:
        camera.require_thin("captures are reconstructed")
        require_ideal(camera)
        camera.require_resolved()
        # Images are formed by the lens as it should be.
        camera = camera.replace(wavefront=())
        distance = require_number("distance", distance, finite=False)
        image_distance(camera.focal_length, distance)
        wavelength, oversample = require_wavelength(wavelength), require_count("oversample", oversample)
        fine = fine_bins(OpticalSystem(camera, wavelength), oversample)
        self._camera, self._spread = camera, LensSpread(camera, distance, oversample, fine)
        self._fields = AmplitudeFields(
            camera, distance, wavelength, require_count("interleave", interleave), oversample * fine
        )
        self._fine = oversample * fine
        rays = white_sums(camera, distance, camera.lit_radius, "lens", oversample)
        white = white_light(camera, wavelength, distance, oversample, fine=fine, relay=True)
        divisor, reached = divisors(white, rays, distance, computed=True)
        self._factor = np.divide(1.0, divisor, out=np.zeros(divisor.shape), where=reached)[..., 0]

    @one_at_a_time
    def forward(self, capture: Any) -> NDArray[np.float32]:
        """Refocus a capture.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            What the detector has recorded. Pixels below zero are refocused by their magnitude and subtracted.

        Returns
        -------
        float32 array (rows, columns) or (rows, columns, channels)
            Radiance of the bins, as by `reconstruct`, but 0 where that has NaN.
        """
        return self.at(capture).image

    @one_at_a_time
    def derivative(self, capture: Any, change: Any) -> NDArray[np.float32]:
        """Differentiate `forward` at a capture, in the direction of a change of it.

        Parameters
        ----------
        capture, change : array (rows, columns) or (rows, columns, channels)
            Where a pixel is zero the image has no derivative by it, and 0 is taken.

        Returns
        -------
        float32 array
            Of the shape of the image.
        """
        return self.at(capture).tangent(change)

    @one_at_a_time
    def gradient(self, capture: Any, image_gradient: Any) -> NDArray[np.float32]:
        """Apply the transpose of `derivative`: take the gradient of a figure back from the image to the capture.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            Where the image is differentiated.
        image_gradient : array
            Derivatives of the figure with respect to the bins, of the shape of the image.

        Returns
        -------
        float32 array
            Of the shape of the capture.
        """
        return self.at(capture).back(image_gradient)

    def at(self, capture: Any) -> CoherentImage:
        """Refocus a capture, and keep what its derivatives need."""
        return CoherentImage(self, capture)

    def __call__(self, capture: Any) -> Any:
        """Refocus a tensor of Dr.Jit, (rows, columns) or (rows, columns, channels), differentiably."""
        return dr.custom(_CoherentOp, capture, self)

    def _linearise(self, image: NDArray[np.float32], judged: bool) -> Linearised:
        return Linearised(self._fields, BinSums(self._fields.step, self._camera, self._fine), image, judged)


class CoherentImage:
    """A refocused capture, and its derivatives there; see `CoherentRefocus`.

    Attributes
    ----------
    image : float32 array
        What `CoherentRefocus.forward` returns.
    """

    def __init__(self, refocus: CoherentRefocus, capture: Any) -> None:
        pixels = as_channels(as_array("capture", capture), refocus._camera.shape, "capture")
        require_pixels("capture", pixels)
        self._refocus, self._flat, self._shape = refocus, np.ndim(capture) == 2, pixels.shape
        pixels = np.asarray(pixels, np.float32)
        # Of every channel, what is refocused with which sign, and its masks of derivatives.
        self._parts: list[list[tuple[float, Linearised, Any]]] = []
        bins = np.zeros((*refocus._factor.shape, pixels.shape[2]))
        for channel, image in enumerate(np.moveaxis(pixels, -1, 0)):
            signs = (1.0, -1.0) if image.min() < 0 else (1.0,)
            parts = [(sign, refocus._linearise(np.maximum(sign * image, 0), judged=sign > 0)) for sign in signs]
            spread = [(sign, part, refocus._spread.at(part.power)) for sign, part in parts]
            self._parts.append(spread)
            bins[..., channel] = refocus._factor * sum(sign * made.bins for sign, _, made in spread)
        self.image = self._returned(bins)

    def tangent(self, change: Any) -> NDArray[np.float32]:
        """Return the change of the image; see `CoherentRefocus.derivative`."""
        given = as_channels(as_array("change", change), self._shape[:2], "change")
        self._require_channels(given, "change")
        columns = [
            self._refocus._factor * sum(made.tangent(part.tangent(given[..., channel])) for _, part, made in parts)
            for channel, parts in enumerate(self._parts)
        ]
        return self._returned(np.stack(columns, -1))

    def back(self, image_gradient: Any) -> NDArray[np.float32]:
        """Return the gradient by the capture; see `CoherentRefocus.gradient`."""
        shape = self._refocus._factor.shape
        given = as_channels(as_array("image_gradient", image_gradient), shape, "image_gradient")
        self._require_channels(given, "image_gradient")
        columns = [
            sum(part.back(made.back(self._refocus._factor * given[..., channel])) for _, part, made in parts)
            for channel, parts in enumerate(self._parts)
        ]
        return self._returned(np.stack(columns, -1))

    def _require_channels(self, given: NDArray[Any], name: str) -> None:
        if given.shape[2] != self._shape[2]:
            raise InputError(f"{name} of {given.shape[2]} channels: the capture has {self._shape[2]}")

    def _returned(self, values: NDArray[np.float64]) -> NDArray[np.float32]:
        single = values.astype(np.float32)
        return single[..., 0] if self._flat else single


class _CoherentOp(dr.CustomOp):
    """One use of a `CoherentRefocus`."""

    def eval(self, capture: Any, refocus: CoherentRefocus) -> Any:
        """Refocus."""
        self._kind, self._at = type(capture), refocus.at(capture.numpy())
        return self._kind(self._at.image)

    def forward(self) -> None:
        """Refocus the change of the capture."""
        self.set_grad_out(self._kind(self._at.tangent(self.grad_in("capture").numpy())))

    def backward(self) -> None:
        """Take the gradient back to the capture."""
        self.set_grad_in("capture", self._kind(self._at.back(self.grad_out().numpy())))

    def name(self) -> str:
        """Return what Dr.Jit calls it."""
        return "refocusing by waves"
