r"""Refocusing as a function of the capture, differentiable by Dr.Jit and through it by PyTorch.

Deconvolution is a given number of Richardson and Lucy's steps. A step :math:`x' = x \, w \, A^T r` with :math:`r = (y +
\beta) / (A x + \beta)` has the transposed derivative

.. math::
    \bar r = A (x w \bar x'), \quad \bar y \mathrel{+}= \bar r / (A x + \beta), \quad
    \bar x = w \, A^T r \, \bar x' - A^T \frac{\bar r \, r}{A x + \beta} ,

so that the reverse pass of a step takes one product with A and one with its transpose, like the step itself.
:math:`\beta` and the radiance of the first bins are proportional to the light of the capture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import numpy as np

from ...camera import PlenopticCamera, Use, require_support
from ...errors import InputError, refuse_if, require_choice, require_count, require_number, require_wavelength
from ...fields import OpticalSystem
from ...linear import LinearMap, RichardsonLucy, solve
from ...optics import guards
from ...prescription import lens_data
from ...refocus import (
    BackwardFields,
    BinSums,
    LensSpread,
    ThinConjugates,
    WeakBins,
    divided_bins,
    fine_bins,
    lens_scale,
    planning,
    pupil_radius,
    ray_sums,
    ray_sums_vjp,
    signed_parts,
    straightened,
    straightened_image,
    white_pixels,
    white_sums,
)
from ...refocus_options import FOOTPRINTS
from ...runtime import (
    Array,
    Doubles,
    Floats,
    Sizes,
    active_backend,
    as_array,
    check_memory,
    drjit_array,
    fft,
    one_at_a_time,
    require_pixels,
)
from ..deconvolution.deconvolved import DEFAULT_ITERATIONS, LEAST_SEEN
from ..deconvolution.fourier import response_of


class RayRefocus:
    """Refocusing of one camera's captures to one distance by the ray model: a linear operator, with its transpose.

    Called with a Dr.Jit array it is differentiable, forward and in reverse; ``drjit.wrap("torch", "drjit")`` makes it a
    function of PyTorch tensors.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; lenses displaced by `mla_cra` count as those of the nearest regular array.
    distance : float
        Object distance in scene units, beyond the focal length; may be infinite.
    footprint : {"lens", "point"}
        As in `reconstruct`.
    oversample : int
        Bins per lens along each axis.
    """

    def __init__(self, camera: PlenopticCamera, distance: float, *, footprint: str = "lens", oversample: int = 1):
        require_support(camera, Use.RAY_REFOCUSING | Use.RECONSTRUCTION_DERIVATIVES | Use.RAY_DERIVATIVES)
        camera = camera.regular
        self.camera = camera
        distance = require_number("distance", distance, finite=False)
        lens_data.image_distance(camera.focal_length, distance)
        require_choice("footprint", footprint, FOOTPRINTS)
        # Where lenses are unequally bright, captures are evened; the array is straight.
        self._even = straightened(camera)
        self._numbers = distance, pupil_radius(self._even), footprint, require_count("oversample", oversample)
        white = self._sums(white_pixels(camera)[..., None])[..., 0].astype(np.float64)
        reached = divided_bins(white, white, distance)
        self._factor = np.where(reached, 1 / np.where(reached, white, 1), 0.0)

    @property
    def shape(self) -> Sizes:
        """Rows and columns of the bins."""
        return self._factor.shape

    def forward(self, capture: Any) -> Array:
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
        pixels = as_channels(capture, self.camera.shape, "capture")
        bins = (self._sums(pixels) * self._factor[..., None]).astype(np.float32)
        return bins[..., 0] if np.ndim(capture) == 2 else bins

    def adjoint(self, bins: Any) -> Array:
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
        channels = as_channels(bins, self._factor.shape, "bins") * self._factor[..., None]
        pixels = ray_sums_vjp(channels, self._even, *self._numbers)
        pixels = straightened_image(pixels, self.camera).astype(np.float32)
        return pixels[..., 0] if np.ndim(bins) == 2 else pixels

    def __call__(self, capture: Any) -> Any:
        """Refocus a tensor of Dr.Jit, (rows, columns) or (rows, columns, channels), differentiably."""
        return dr.custom(_RefocusOp, capture, lambda pixels: (self.forward(pixels), self.forward, self.adjoint))

    def _sums(self, pixels: Array) -> Array:
        """Return the sums of pixels (rows, columns, channels) over bins."""
        even = straightened_image(pixels, self.camera)
        return ray_sums(np.ascontiguousarray(even, np.float32), self._even, *self._numbers)


class _RefocusOp(dr.CustomOp):
    """One use of a refocus object as a Dr.Jit operation."""

    def eval(self, capture: Any, linearised: Callable[[Array], tuple[Any, Any, Any]]) -> Any:
        """Return the refocused capture, from a function that returns it with its jvp and its vjp."""
        image, self._jvp, self._vjp = linearised(capture.numpy())
        self._kind = type(capture)
        return drjit_array(self._kind, image)

    def forward(self) -> None:
        """Set the change of the image from the change of the capture."""
        self.set_grad_out(drjit_array(self._kind, self._jvp(self.grad_in("capture").numpy())))

    def backward(self) -> None:
        """Propagate the gradient of the image to the capture."""
        self.set_grad_in("capture", drjit_array(self._kind, self._vjp(self.grad_out().numpy())))

    def name(self) -> str:
        """Return the name of the operation for Dr.Jit."""
        return "refocusing"


def as_channels(values: Any, shape: Sizes, name: str) -> Array:
    """Return an array as (rows, columns, channels), or refuse another shape."""
    array = as_array(name, values, dtype=None)
    if array.ndim not in (2, 3) or array.shape[:2] != shape:
        raise InputError(f"{name} of shape {array.shape}: it must have {shape[0]} rows and {shape[1]} columns")
    return array if array.ndim == 3 else array[..., None]


class Channel(Protocol):
    """One refocused channel of a capture: bins (rows, columns), and their derivatives with respect to the pixels."""

    bins: Array

    def jvp(self, change: Array) -> Array:
        """Return the change of the bins for a change of the pixels."""

    def vjp(self, bins: Array) -> Array:
        """Return the gradient with respect to the pixels, from the gradient with respect to the bins."""


class RefocusedImage:
    """A refocused capture, `image`, with derivatives there; see `CoherentRefocus` and `DeconvolvedRefocus`."""

    def __init__(
        self, refocus: CoherentRefocus | DeconvolvedRefocus, capture: Any, channel: Callable[[Array], Channel]
    ):
        pixels = as_channels(capture, refocus.camera.shape, "capture")
        require_pixels("capture", pixels)
        self._pixels, self._bins, self._flat = refocus.camera.shape, refocus.shape, np.ndim(capture) == 2
        self._channels = [channel(np.ascontiguousarray(plane, np.float32)) for plane in np.moveaxis(pixels, -1, 0)]
        self.image = self._stacked([plane.bins for plane in self._channels])

    def jvp(self, change: Any) -> Floats:
        """Return the change of the image for a change of the capture, of the capture's shape."""
        return self._of_channels(change, self._pixels, "change", lambda channel, plane: channel.jvp(plane))

    def vjp(self, image_gradient: Any) -> Floats:
        """Return the gradient with respect to the capture, from the gradient with respect to the image."""
        return self._of_channels(
            image_gradient, self._bins, "image_gradient", lambda channel, plane: channel.vjp(plane)
        )

    def _of_channels(self, values: Any, shape: Sizes, name: str, derived: Callable[[Channel, Array], Array]) -> Floats:
        channels = as_channels(values, shape, name)
        if channels.shape[2] != len(self._channels):
            raise InputError(f"{name} of {channels.shape[2]} channels: the capture has {len(self._channels)}")
        return self._stacked(list(map(derived, self._channels, np.moveaxis(channels, -1, 0))))

    def _stacked(self, parts: list[Array]) -> Floats:
        stack = np.stack(parts, -1).astype(np.float32)
        return stack[..., 0] if self._flat else stack


class CoherentRefocus:
    """Refocusing of one camera's captures to one distance by the wave model, differentiable in the pixels.

    The wave's amplitude is the square root of a pixel, so that the image is not linear in the capture: `derivative` and
    `gradient` hold at one capture. Called with a Dr.Jit array it is differentiable, forward and in reverse;
    ``drjit.wrap("torch", "drjit")`` makes it a function of PyTorch tensors.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; lenses displaced by `mla_cra` count as those of the nearest regular array.
    distance : float
        Object distance in scene units, beyond the focal length; may be infinite.
    wavelength : float
        Wavelength in nanometres, of all channels.
    interleave : int
        1: one coherent wave, as by ``method="coherent"``; else the period of the subsets of ``method="partial"``.
    oversample : int
        Bins per lens along each axis.
    """

    def __init__(
        self, camera: PlenopticCamera, distance: float, wavelength: float, *, interleave: int = 1, oversample: int = 1
    ):
        require_support(camera, Use.FIELDS | Use.FIELD_DERIVATIVES | Use.RECONSTRUCTION_DERIVATIVES)
        wavelength = require_wavelength(wavelength)
        camera = camera.regular
        white = white_pixels(camera)
        camera = camera.at_wavelength(wavelength)
        camera.require_resolved()
        # Images are formed by the ideal lens, without aberrations.
        camera = camera.replace(wavefront=())
        distance = require_number("distance", distance, finite=False)
        lens_data.image_distance(camera.focal_length, distance)
        oversample = require_count("oversample", oversample)
        system = OpticalSystem(camera, wavelength)
        fine = fine_bins(system, oversample)
        self.camera = camera
        self._wavelength = wavelength
        self._oversample = oversample * fine
        self._spread = LensSpread(camera, oversample, fine, lens_scale(camera, distance)) if fine > 1 else None
        left, top = camera.crop_offset
        columns, rows = camera.crop_size
        window = (left, left + columns), (top, top + rows)
        grids = planning.plan(camera, wavelength, [distance], window, self._oversample)
        planning.require_feasible(grids)
        interleave = require_count("interleave", interleave)
        self._fields = BackwardFields(camera, wavelength, grids, interleave=interleave, with_vjp=True)
        (self._step,) = grids.to_objects
        (self._zone,) = ThinConjugates(system).zones(distance)
        rays = white_sums(camera, distance, camera.lit_radius, "lens", oversample)
        light = _BinnedPower(self, white.astype(np.float32), checked=True).bins
        self._weak = WeakBins(light, rays, oversample)
        divisor = self._weak.shared(light)
        reached = divided_bins(divisor, rays, distance)
        self._factor = np.divide(1.0, divisor, out=np.zeros(divisor.shape), where=reached)

    @property
    def shape(self) -> Sizes:
        """Rows and columns of the bins."""
        return self._factor.shape

    @one_at_a_time
    def forward(self, capture: Any) -> Floats:
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
    def derivative(self, capture: Any, change: Any) -> Floats:
        """Return the derivative of `forward` at a capture, in the direction of a change of the capture.

        Parameters
        ----------
        capture, change : array (rows, columns) or (rows, columns, channels)
            Capture, and direction of the change. With respect to zero pixels the image has no derivative; 0 is taken.

        Returns
        -------
        float32 array
            Change of the image, of the image's shape.
        """
        return self.at(capture).jvp(change)

    @one_at_a_time
    def gradient(self, capture: Any, image_gradient: Any) -> Floats:
        """Return the gradient with respect to the capture, given the image's gradient: the transpose of `derivative`.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            Capture at which the image is differentiated.
        image_gradient : array
            Gradient with respect to the bins, with the shape of the image.

        Returns
        -------
        float32 array
            Gradient, of the shape of the capture.
        """
        return self.at(capture).vjp(image_gradient)

    def at(self, capture: Any) -> RefocusedImage:
        """Return the refocused capture with the data for its derivatives."""
        return RefocusedImage(self, capture, lambda image: _CoherentChannel(self, image))

    def __call__(self, capture: Any) -> Any:
        """Refocus a tensor of Dr.Jit, (rows, columns) or (rows, columns, channels), differentiably."""
        return dr.custom(_RefocusOp, capture, lambda pixels: ((at := self.at(pixels)).image, at.jvp, at.vjp))


class _CoherentChannel:
    """The bins of one channel: from positive pixels, minus those from negative ones, divided by the light of white."""

    def __init__(self, refocus: CoherentRefocus, image: Floats):
        self._factor, self._weak = refocus._factor, refocus._weak
        self._parts = [(sign, _BinnedPower(refocus, signed, checked=sign > 0)) for sign, signed in signed_parts(image)]
        self.bins = self._factor * self._weak.shared(np.asarray(sum(sign * part.bins for sign, part in self._parts)))

    def jvp(self, change: Array) -> Array:
        """Return the change of the bins for a change of the pixels."""
        # A bin of a part below zero is subtracted, and its capture is minus the pixels: the signs cancel.
        return self._factor * self._weak.shared(np.asarray(sum(plane.jvp(change) for _, plane in self._parts)))

    def vjp(self, bins: Array) -> Array:
        """Return the gradient with respect to the pixels, from the gradient with respect to the bins."""
        bins = self._weak.shared_vjp(self._factor * bins)
        return np.asarray(sum(plane.vjp(bins) for _, plane in self._parts))


class _BinnedPower:
    """Power in bins from a capture without negative pixels, with derivatives at this capture.

    With the field u at the directions of the object plane, and its change du, a bin changes by the sum of 2 Re(u* du)
    over the bin. The square root has no derivative at zero pixels; 0 is used.
    """

    def __init__(self, refocus: CoherentRefocus, image: Floats, *, checked: bool):
        self._refocus, amplitude = refocus, np.sqrt(image)
        self._slope = np.divide(0.5, amplitude, out=np.zeros_like(amplitude), where=amplitude > 0)
        self._sums = BinSums(refocus._step, refocus.camera, refocus._wavelength, refocus._oversample)
        self._at, passed = self._fields(amplitude)
        sent = float(image.sum(dtype=np.float64))
        if checked and sent:
            guards.check(guards.PUPIL, 1 - passed / sent)
        power = sum(field.real**2 + field.imag**2 for field in self._at)
        bins = active_backend().to_host(self._sums.forward([(slice(None), power)]))
        spread = bins if refocus._spread is None else refocus._spread.forward(bins)
        self._lit = spread > 0
        self.bins = np.where(self._lit, spread, 0)

    def _fields(self, amplitude: Floats) -> tuple[list, float]:
        """Return all subsets' fields at the object plane's directions, and the power that passed the pupil."""
        chain = self._refocus._fields
        step = self._refocus._step
        fields = []
        passed = 0.0
        with fft.resting_drjit():
            for field in chain.at_pupil(amplitude):
                passed += chain.power(field)
                fields.append(active_backend().arrays.empty((step.x.new_padded, step.y.new_padded), np.complex64))
                for lines, rows in chain.to_object(field, self._refocus._zone, step):
                    fields[-1][lines] = rows
        return fields, passed

    def jvp(self, change: Doubles) -> Doubles:
        """Return the change of the bins for a change of the capture."""
        moved, _ = self._fields((self._slope * change).astype(np.float32))
        power = sum(2 * (field.conj() * field_change).real for field, field_change in zip(self._at, moved, strict=True))
        bins = active_backend().to_host(self._sums.jvp(power))
        return np.where(self._lit, bins if self._refocus._spread is None else self._refocus._spread.forward(bins), 0)

    def vjp(self, bins: Doubles) -> Doubles:
        """Return the gradient with respect to the capture, from the gradient with respect to the bins."""
        channels = np.where(self._lit, bins, 0)
        refocus = self._refocus
        spread = channels if refocus._spread is None else refocus._spread.vjp(channels)
        power = self._sums.vjp(active_backend().arrays.asarray(spread))
        with fft.resting_drjit():
            gradients = ((2 * power * field).astype(np.complex64) for field in self._at)
            return self._slope * refocus._fields.vjp(gradients, refocus._zone, refocus._step)


class DeconvolvedRefocus:
    """Deconvolution of one camera's captures at one distance by fixed steps, differentiable in the pixels.

    The steps are those of ``reconstruct(method="deconvolved", accelerate=False, iterations=...)``. The camera's
    response is computed once. The image is not linear in the capture.

    Parameters
    ----------
    distance : float
        Object distance in scene units, beyond the focal length; may be infinite.
    wavelength : float, optional
        Wavelength in nanometres, of all channels. Default: the response of the ray model.
    iterations : int
        Number of steps.
    oversample : int
        Bins per lens along each axis.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        distance: float,
        wavelength: float | None = None,
        *,
        iterations: int = DEFAULT_ITERATIONS,
        oversample: int = 1,
    ):
        require_support(camera, Use.RESPONSES | Use.RECONSTRUCTION_DERIVATIVES)
        self.camera, self.iterations = camera, require_count("iterations", iterations)
        distance = require_number("distance", distance, finite=False)
        oversample = require_count("oversample", oversample)
        wavelength = None if wavelength is None else require_wavelength(wavelength)
        refuse_if(
            wavelength is None and not camera.lens_data.is_thin,
            "wavelength = None: behind a main_lens other than a thin one it must be stated, for a response by waves",
        )
        self.response = response_of(camera)(camera, [distance], wavelength=wavelength, oversample=oversample)
        light = self.response.adjoint(np.ones(camera.shape, np.float32))
        visible = self.response.to_image(light / light.max(), 0)
        # Bins that `reconstruct` leaves unknown are 0.
        self.visible = visible >= LEAST_SEEN

    @property
    def shape(self) -> Sizes:
        """Rows and columns of the bins."""
        return self.visible.shape

    @one_at_a_time
    def forward(self, capture: Any) -> Floats:
        """Return the deconvolved capture.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            The recorded pixels.

        Returns
        -------
        float32 array (rows, columns) or (rows, columns, channels)
            Radiance of the bins, as by `reconstruct`, but 0 where that has NaN.
        """
        return self.at(capture).image

    def at(self, capture: Any) -> RefocusedImage:
        """Return the deconvolved capture with the data for its derivatives."""
        pixels = as_channels(capture, self.camera.shape, "capture")
        numbers = 4.0 * (pixels.size + 2 * pixels.shape[2] * self.response.shape[1])
        label = f"derivatives of {self.iterations} steps in {pixels.shape[2]} channels"
        check_memory(numbers * self.iterations, label)
        return RefocusedImage(self, capture, lambda image: _DeconvolvedChannel(self, image))


@dataclass(frozen=True, eq=False)
class _Made:
    """A finished step: its bins, the image of these bins, and the adjoint of the ratio."""

    point: Floats
    model: Floats
    back: Floats


class _RecordedSteps(RichardsonLucy):
    """The steps of Richardson and Lucy, which keep what their derivatives need."""

    def __init__(self, response: LinearMap, image: Floats):
        super().__init__(response, image)
        self.made: list[_Made] = []

    def step(self, point: Floats, model: Floats) -> Floats:
        """Return the bins after a step from a point whose image is `model`."""
        self.made.append(_Made(point, model, self.operator.adjoint(self.ratio(model))))
        return self.scaled(point, self.made[-1].back)


class _DeconvolvedChannel:
    """The steps of deconvolving one channel, and their derivatives."""

    def __init__(self, refocus: DeconvolvedRefocus, image: Floats):
        self._response = refocus.response
        self._visible = refocus.visible
        self._image = image
        self._step = _RecordedSteps(refocus.response, image)
        refuse_if(not self._step.total, "capture: none of its pixels is lit: there is nothing to deconvolve")
        self.bins = self._to_image(solve(self._step, iterations=refocus.iterations).values)

    def _to_image(self, values: Floats) -> Floats:
        return self._response.to_image(values, 0) * self._visible

    def jvp(self, change: Array) -> Floats:
        """Return the change of the bins for a change of the pixels."""
        change = np.asarray(change, np.float32)
        step = self._step
        lit = self._image > 0
        above = self._image + step.shift > 0
        light = float(change[lit].sum(dtype=np.float64))
        moved = np.where(step.inside, np.float32(light / step.sent), 0)
        shift = np.float32(np.vdot(change, step.shift_slope))
        for made in step.made:
            below, ratio = self._of(made)
            of_model = np.where(made.model > 0, self._response.forward(moved), 0)
            of_ratio = (np.where(above, change + shift, 0) - ratio * (of_model + shift)) / below
            of_back = self._response.adjoint(of_ratio.astype(np.float32))
            of_back = np.where(made.back > 0, of_back, 0)
            moved = step.weight * (moved * np.maximum(made.back, 0) + made.point * of_back)
        return self._to_image(moved)

    def vjp(self, bins: Array) -> Doubles:
        """Return the gradient with respect to the pixels, from the gradient with respect to the bins."""
        adjoint_image = self._response.from_image(bins * self._visible, 0)
        step = self._step
        lit = self._image > 0
        above = self._image + step.shift > 0
        total = np.zeros(self._image.shape)
        by_shift = 0.0
        for made in reversed(step.made):
            below, ratio = self._of(made)
            of_back = np.where(made.back > 0, adjoint_image * made.point * step.weight, 0)
            of_ratio = self._response.forward(of_back) / below
            total += np.where(above, of_ratio, 0)
            by_shift += float((of_ratio * (above - ratio)).sum(dtype=np.float64))
            of_model = self._response.adjoint(np.where(made.model > 0, of_ratio * ratio, np.float32(0)))
            adjoint_image = adjoint_image * np.maximum(made.back, 0) * step.weight - of_model
        start = float(adjoint_image[step.inside].sum(dtype=np.float64)) / step.sent
        return total + lit * start + by_shift * step.shift_slope

    def _of(self, made: _Made) -> tuple[Floats, Floats]:
        """Return the denominator of the ratio of images, and the ratio."""
        divisor = np.where(self._step.lit, np.maximum(made.model, 0) + self._step.shift, np.float32(np.inf))
        return divisor, self._step.ratio(made.model)
