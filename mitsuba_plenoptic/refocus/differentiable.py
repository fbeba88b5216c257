"""Refocusing as a function of the capture that Dr.Jit, and through it PyTorch, can differentiate."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..camera.plenoptic_camera import require_ideal, require_no_shape
from ..errors import InputError, refuse_if, require_choice, require_count, require_number, require_wavelength
from ..io.captures import as_array, require_pixels
from ..light.lens_kinds import regular_array
from ..light.optical_system import OpticalSystem
from ..optics import guards
from ..prescription.lens_data import image_distance
from ..refocus_options import FOOTPRINTS
from ..runtime.backend import backend, drjit_array, one_at_a_time
from ..runtime.fft import resting_drjit
from .conjugates import ThinConjugates
from .full_fields import BackwardFields
from .lens_tiles import fine_bins
from .passages import BinSums
from .planning import plan, require_feasible
from .radiance import LensSpread, divisors, is_reached, lens_scale
from .ray import pupil_radius, ray_sums, ray_sums_vjp, white_sums
from .wave_methods import signed_parts, white_light


class RayRefocus:
    """Refocus captures of one camera to one distance with the ray model: a linear operator, with its transpose.

    Called with an array of Dr.Jit it is differentiable, forward and in reverse; ``drjit.wrap("torch", "drjit")`` makes
    it a function of PyTorch's tensors.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance in scene units, beyond the focal length; may be infinite.
    footprint : {"lens", "point"}
        As in `reconstruct`.
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
        camera = regular_array(camera)
        camera.require_no_objective("captures are refocused by rays")
        self.camera, self._distance = camera, require_number("distance", distance, finite=False)
        image_distance(camera.focal_length, self._distance)
        require_choice("footprint", footprint, FOOTPRINTS)
        numbers = camera, self._distance, pupil_radius(camera), footprint, require_count("oversample", oversample)
        self._numbers = numbers[1:]
        white = white_sums(*numbers)
        reached = is_reached(white)
        refuse_if(not reached.any(), f"distance = {distance:g}: no light comes from any of the {white.size} bins there")
        self._factor = np.where(reached, 1 / np.where(reached, white, 1), 0.0)

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the bins."""
        return self._factor.shape

    def forward(self, capture: Any) -> np.ndarray:
        """Return the refocused capture.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            The recorded pixels.

        Returns
        -------
        float32 array (rows, columns) or (rows, columns, channels)
            Radiance of the bins, as by `reconstruct`, but 0 where that has NaN.
        """
        pixels = as_channels(as_array("capture", capture), self.camera.shape, "capture")
        sums = ray_sums(np.ascontiguousarray(pixels, np.float32), self.camera, *self._numbers)
        made = (sums * self._factor[..., None]).astype(np.float32)
        return made[..., 0] if np.ndim(capture) == 2 else made

    def adjoint(self, bins: Any) -> np.ndarray:
        """Return the transpose of `forward`, applied to bins.

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
        pixels = ray_sums_vjp(given, self.camera, *self._numbers).astype(np.float32)
        return pixels[..., 0] if np.ndim(bins) == 2 else pixels

    def __call__(self, capture: Any) -> Any:
        """Refocus a tensor of Dr.Jit, (rows, columns) or (rows, columns, channels), differentiably."""
        return dr.custom(_RefocusOp, capture, self)

    def _linearised(self, capture: NDArray[Any]) -> tuple[Any, Any, Any]:
        return self.forward(capture), self.forward, self.adjoint


class _RefocusOp(dr.CustomOp):
    """One use of a refocus as an operation of Dr.Jit."""

    def eval(self, capture: Any, refocus: RayRefocus | CoherentRefocus) -> Any:
        """Return the refocused capture."""
        image, self._jvp, self._vjp = refocus._linearised(capture.numpy())
        self._kind = type(capture)
        return drjit_array(self._kind, image)

    def forward(self) -> None:
        """Set the change of the image from the change of the capture."""
        self.set_grad_out(drjit_array(self._kind, self._jvp(self.grad_in("capture").numpy())))

    def backward(self) -> None:
        """Take the gradient back to the capture."""
        self.set_grad_in("capture", drjit_array(self._kind, self._vjp(self.grad_out().numpy())))

    def name(self) -> str:
        """Return the name of the operation for Dr.Jit."""
        return "refocusing"


def as_channels(values: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Return (rows, columns, channels), or refuse another shape."""
    if values.ndim not in (2, 3) or values.shape[:2] != shape:
        raise InputError(f"{name} of shape {values.shape}: it must have {shape[0]} rows and {shape[1]} columns")
    return values if values.ndim == 3 else values[..., None]


class CoherentRefocus:
    """Refocus captures of one camera to one distance with the wave model, with derivatives by the pixels.

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
        camera = regular_array(camera)
        require_ideal(camera)
        require_no_shape(camera, "captures are reconstructed by waves")
        camera.require_resolved()
        # Images are formed by the ideal lens, without aberrations.
        camera = camera.replace(wavefront=())
        distance = require_number("distance", distance, finite=False)
        image_distance(camera.focal_length, distance)
        wavelength, oversample = require_wavelength(wavelength), require_count("oversample", oversample)
        system = OpticalSystem(camera, wavelength)
        fine = fine_bins(system, oversample)
        self.camera, self._wavelength, self._oversample = camera, wavelength, oversample * fine
        self._spread = LensSpread(camera, oversample, fine, lens_scale(camera, distance)) if fine > 1 else None
        (left, top), (columns, rows) = camera.crop_offset, camera.crop_size
        window = (left, left + columns), (top, top + rows)
        grids = plan(camera, wavelength, [distance], window, self._oversample)
        require_feasible(grids)
        interleave = require_count("interleave", interleave)
        self._fields = BackwardFields(camera, wavelength, grids, interleave=interleave, with_vjp=True)
        (self._step,) = grids.to_objects
        (self._zone,) = ThinConjugates(system).zones(distance)
        rays = white_sums(camera, distance, camera.lit_radius, "lens", oversample)
        white = white_light(camera, wavelength, distance, oversample, True)
        divisor, reached = divisors(white, rays, distance, computed=True)
        self._factor = np.divide(1.0, divisor, out=np.zeros(divisor.shape), where=reached)[..., 0]

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the bins."""
        return self._factor.shape

    @one_at_a_time
    def forward(self, capture: Any) -> NDArray[np.float32]:
        """Return the refocused capture.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            The recorded pixels. Pixels below zero are refocused by their magnitude and subtracted.

        Returns
        -------
        float32 array (rows, columns) or (rows, columns, channels)
            Radiance of the bins, as by `reconstruct`, but 0 where that has NaN.
        """
        return self.at(capture).image

    @one_at_a_time
    def derivative(self, capture: Any, change: Any) -> NDArray[np.float32]:
        """Return the derivative of `forward` at a capture, in the direction of a change of the capture.

        Parameters
        ----------
        capture, change : array (rows, columns) or (rows, columns, channels)
            Where a pixel is zero the image has no derivative by it, and 0 is taken.

        Returns
        -------
        float32 array
            Of the shape of the image.
        """
        return self.at(capture).jvp(change)

    @one_at_a_time
    def gradient(self, capture: Any, image_gradient: Any) -> NDArray[np.float32]:
        """Return the gradient by the capture from a gradient by the image, the transpose of `derivative`.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            Where the image is differentiated.
        image_gradient : array
            Gradient with respect to the bins, with the shape of the image.

        Returns
        -------
        float32 array
            Of the shape of the capture.
        """
        return self.at(capture).vjp(image_gradient)

    def at(self, capture: Any) -> CoherentImage:
        """Return the refocused capture with the data for its derivatives."""
        return CoherentImage(self, capture)

    def __call__(self, capture: Any) -> Any:
        """Refocus a tensor of Dr.Jit, (rows, columns) or (rows, columns, channels), differentiably."""
        return dr.custom(_RefocusOp, capture, self)

    def _linearised(self, capture: NDArray[Any]) -> tuple[Any, Any, Any]:
        at = self.at(capture)
        return at.image, at.jvp, at.vjp


class _BinnedPower:
    """Power in bins from a capture without negative pixels, with its derivatives at this capture.

    With the field u at the directions of the object plane, and its change du, a bin changes by the sum of 2 Re(u* du)
    over it. Where a pixel is zero the square root has no derivative, and 0 is taken.
    """

    def __init__(self, refocus: CoherentRefocus, image: NDArray[np.float32], *, checked: bool) -> None:
        self._refocus, amplitude = refocus, np.sqrt(image)
        self._slope = np.divide(0.5, amplitude, out=np.zeros_like(amplitude), where=amplitude > 0)
        self._sums = BinSums(refocus._step, refocus.camera, refocus._wavelength, refocus._oversample)
        self._at, passed = self._fields(amplitude)
        sent = float(image.sum(dtype=np.float64))
        if checked and sent:
            guards.check(guards.PUPIL, 1 - passed / sent)
        power: Any = sum(field.real**2 + field.imag**2 for field in self._at)
        bins = backend().to_host(self._sums.forward([(slice(None), power)]))
        spread = bins if refocus._spread is None else refocus._spread.forward(bins)
        self._lit = spread > 0
        self.bins = np.where(self._lit, spread, 0)

    def _fields(self, amplitude: NDArray[np.float32]) -> tuple[list[Any], float]:
        """Return the fields at the object plane's directions of all subsets, and the power that passed the pupil."""
        chain, step, found, passed = self._refocus._fields, self._refocus._step, [], 0.0
        with resting_drjit():
            for field in chain.at_pupil(amplitude):
                passed += chain.power(field)
                found.append(backend().arrays.empty((step.x.new_padded, step.y.new_padded), np.complex64))
                for lines, part in chain.to_object(field, self._refocus._zone, step):
                    found[-1][lines] = part
        return found, passed

    def jvp(self, change: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the change of the bins for a change of the capture."""
        moved, _ = self._fields((self._slope * change).astype(np.float32))
        power: Any = sum(2 * (field.conj() * other).real for field, other in zip(self._at, moved, strict=True))
        bins = backend().to_host(self._sums.jvp(power))
        return np.where(self._lit, bins if self._refocus._spread is None else self._refocus._spread.forward(bins), 0)

    def vjp(self, bins: NDArray[np.float64]) -> NDArray[np.float64]:
        """Take the gradient by the bins back to the capture."""
        arrays, given, refocus = backend().arrays, np.where(self._lit, bins, 0), self._refocus
        power = self._sums.vjp(arrays.asarray(given if refocus._spread is None else refocus._spread.vjp(given)))
        with resting_drjit():
            gradients = ((2 * power * field).astype(np.complex64) for field in self._at)
            return self._slope * refocus._fields.vjp(gradients, refocus._zone, refocus._step)


class CoherentImage:
    """A refocused capture, with its derivatives; see `CoherentRefocus`."""

    def __init__(self, refocus: CoherentRefocus, capture: Any) -> None:
        pixels = as_channels(as_array("capture", capture), refocus.camera.shape, "capture")
        require_pixels("capture", pixels)
        self._refocus, self._flat, self._shape = refocus, np.ndim(capture) == 2, pixels.shape
        self._channels = [
            [(sign, _BinnedPower(refocus, part, checked=sign > 0)) for sign, part in signed_parts(channel)]
            for channel in np.moveaxis(np.asarray(pixels, np.float32), -1, 0)
        ]
        self.image = self._stacked([sum(sign * part.bins for sign, part in parts) for parts in self._channels])

    def jvp(self, change: Any) -> NDArray[np.float32]:
        """Return the change of the image; see `CoherentRefocus.derivative`."""
        given = zip(self._as_channels(change, self._shape[:2], "change"), self._channels, strict=True)
        # A bin of a part below zero is subtracted, and its capture is minus the pixels: the signs cancel.
        return self._stacked([sum(part.jvp(channel) for _, part in parts) for channel, parts in given])

    def vjp(self, image_gradient: Any) -> NDArray[np.float32]:
        """Return the gradient by the capture; see `CoherentRefocus.gradient`."""
        shape, factor = self._refocus._factor.shape, self._refocus._factor
        given = zip(self._as_channels(image_gradient, shape, "image_gradient"), self._channels, strict=True)
        return self._returned([sum(part.vjp(factor * channel) for _, part in parts) for channel, parts in given])

    def _as_channels(self, values: Any, shape: tuple[int, ...], name: str) -> NDArray[Any]:
        given = as_channels(as_array(name, values), shape, name)
        if given.shape[2] != self._shape[2]:
            raise InputError(f"{name} of {given.shape[2]} channels: the capture has {self._shape[2]}")
        return np.moveaxis(given, -1, 0)

    def _stacked(self, bins: list[Any]) -> NDArray[np.float32]:
        return self._returned([self._refocus._factor * channel for channel in bins])

    def _returned(self, channels: list[Any]) -> NDArray[np.float32]:
        single = np.stack(channels, -1).astype(np.float32)
        return single[..., 0] if self._flat else single
