r"""Deconvolution as a function of the capture with derivatives: a given count of Richardson's and Lucy's steps.

A step :math:`x' = x \, w \, A^T r` with :math:`r = (y + \beta) / (A x + \beta)` has the transposed derivative

.. math::
    \bar r = A (x w \bar x'), \quad \bar y \mathrel{+}= \bar r / (A x + \beta), \quad
    \bar x = w \, A^T r \, \bar x' - A^T \frac{\bar r \, r}{A x + \beta} ,

so that the reverse pass of a step takes one product with A and one with its transpose, like the step itself.
:math:`\beta` and the radiance of the first bins are proportional to the light of the capture.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import refuse_if, require_count, require_number, require_wavelength
from ..io.captures import as_array, require_pixels
from ..light.lens_kinds import regular_array
from ..light.sampling import check_memory
from ..runtime.backend import one_at_a_time
from .deconvolution.solver import RichardsonLucyStep, Values
from .deconvolved import DEFAULT_ITERATIONS, LEAST_SEEN, response_of
from .differentiable import as_channels


class DeconvolvedRefocus:
    """Deconvolution of captures of one camera and distance by a fixed number of steps, with derivatives by pixels.

    The steps are those of ``reconstruct(method="deconvolved", accelerate=False, iterations=...)``. The response of the
    camera is computed once. The image is no linear function of the capture.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    distance : float
        Object distance in scene units, beyond the focal length; may be infinite.
    wavelength : float, optional
        In nanometres, of all channels. Default: the response of the ray model.
    iterations : int
        Steps.
    oversample : int
        Bins per lens along each axis.

    Raises
    ------
    InputError
        If a parameter is out of range, or the response takes too much memory.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        distance: float,
        wavelength: float | None = None,
        *,
        iterations: int = DEFAULT_ITERATIONS,
        oversample: int = 1,
    ) -> None:
        camera = regular_array(camera)
        self.camera, self.iterations = camera, require_count("iterations", iterations)
        distance, oversample = (
            require_number("distance", distance, finite=False),
            require_count("oversample", oversample),
        )
        wavelength = None if wavelength is None else require_wavelength(wavelength)
        self.response = response_of(camera)(camera, [distance], wavelength=wavelength, oversample=oversample)
        (light,) = self.response.adjoint(np.ones(camera.shape, np.float32))
        seen = self.response.to_image(light / light.max(), 0)
        # Bins that `reconstruct` leaves unknown are 0.
        self.visible = seen >= LEAST_SEEN

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the bins."""
        return self.visible.shape

    @one_at_a_time
    def forward(self, capture: Any) -> NDArray[np.float32]:
        """Return the deconvolved capture.

        Parameters
        ----------
        capture : array (rows, columns) or (rows, columns, channels)
            The recorded pixels.

        Returns
        -------
        float32 array (rows, columns) or (rows, columns, channels)
            Radiance of the bins, as by `reconstruct`, but 0 where that has NaN.

        Raises
        ------
        InputError
            If a channel of the capture has no light.
        """
        return self.at(capture).image

    def at(self, capture: Any) -> DeconvolvedImage:
        """Return the deconvolved capture with the data for its derivatives."""
        return DeconvolvedImage(self, capture)


@dataclass(frozen=True, eq=False)
class _Made:
    """A finished step: its bins, the image of these bins, and the adjoint of the ratio."""

    point: NDArray[np.float32]
    model: NDArray[np.float32]
    back: NDArray[np.float32]


class _Channel:
    """The steps of one channel, and their derivatives."""

    def __init__(self, refocus: DeconvolvedRefocus, image: NDArray[np.float32]) -> None:
        response = self._response = refocus.response
        self._step, self._image = RichardsonLucyStep(response, image), image
        refuse_if(not self._step.total, "capture: none of its pixels is lit: there is nothing to deconvolve")
        values: Values = self._step.start()
        self._made: list[_Made] = []
        for _ in range(refocus.iterations):
            model = response.forward(values)
            back = response.adjoint(self._step.ratio(model))
            self._made.append(_Made(values[0], model, back[0]))
            values = self._step.scaled(values, back)
        self.bins = values[0]

    def jvp(self, change: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the change of the bins for a change of the capture."""
        step, (inside,), (weight,) = self._step, self._step.inside, self._step.weight
        lit, known = self._image > 0, self._image + self._step.shift > 0
        light = float(change[lit].sum(dtype=np.float64))
        moved, shift = np.where(inside, np.float32(light / step.sent), 0), np.float32(light * step.shift_slope)
        for made in self._made:
            below, ratio = self._of(made)
            of_model = np.where(made.model > 0, self._response.forward([moved]), 0)
            of_ratio = (np.where(known, change + shift, 0) - ratio * (of_model + shift)) / below
            (of_back,) = self._response.adjoint(of_ratio.astype(np.float32))
            of_back = np.where(made.back > 0, of_back, 0)
            moved = weight * (moved * np.maximum(made.back, 0) + made.point * of_back)
        return moved

    def vjp(self, felt: NDArray[np.float32]) -> NDArray[np.float64]:
        """Take the gradient by the bins back to the capture."""
        step, (inside,), (weight,) = self._step, self._step.inside, self._step.weight
        lit, known = self._image > 0, self._image + self._step.shift > 0
        total, by_shift = np.zeros(self._image.shape), 0.0
        for made in reversed(self._made):
            below, ratio = self._of(made)
            of_back = np.where(made.back > 0, felt * made.point * weight, 0)
            of_ratio = self._response.forward([of_back]) / below
            total += np.where(known, of_ratio, 0)
            by_shift += float((of_ratio * (known - ratio)).sum(dtype=np.float64))
            (of_model,) = self._response.adjoint(np.where(made.model > 0, of_ratio * ratio, np.float32(0)))
            felt = felt * np.maximum(made.back, 0) * weight - of_model
        return total + lit * (float(felt[inside].sum(dtype=np.float64)) / step.sent + by_shift * step.shift_slope)

    def _of(self, made: _Made) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the denominator of the ratio, and the ratio."""
        return np.maximum(made.model, 0) + self._step.shift, self._step.ratio(made.model)


class DeconvolvedImage:
    """A deconvolved capture, with its derivatives; see `DeconvolvedRefocus`."""

    def __init__(self, refocus: DeconvolvedRefocus, capture: Any) -> None:
        pixels = as_channels(as_array("capture", capture), refocus.camera.shape, "capture")
        require_pixels("capture", pixels)
        self._refocus, self._flat, channels = refocus, np.ndim(capture) == 2, pixels.shape[2]
        numbers = 4.0 * (pixels.size + 2 * channels * math.prod(refocus.response.shapes[0]))
        check_memory(numbers * refocus.iterations, f"derivatives of {refocus.iterations} steps in {channels} channels")
        self._channels = [
            _Channel(refocus, np.ascontiguousarray(each, np.float32)) for each in np.moveaxis(pixels, -1, 0)
        ]
        self.image = self._visible([each.bins for each in self._channels])

    def jvp(self, change: Any) -> NDArray[np.float32]:
        """Return the change of the image for a change of the capture."""
        given = np.asarray(as_channels(as_array("change", change), self._refocus.camera.shape, "change"), np.float32)
        return self._visible([made.jvp(given[..., k]) for k, made in enumerate(self._channels)])

    def vjp(self, image_gradient: Any) -> NDArray[np.float32]:
        """Return the gradient by the capture."""
        given = as_channels(as_array("image_gradient", image_gradient), self._refocus.shape, "image_gradient")
        given = given * self._refocus.visible[..., None]
        response = self._refocus.response
        found = [made.vjp(response.from_image(given[..., k], 0)) for k, made in enumerate(self._channels)]
        return self._stacked(found)

    def _visible(self, bins: list[NDArray[np.float32]]) -> NDArray[np.float32]:
        return self._stacked([self._refocus.response.to_image(each, 0) * self._refocus.visible for each in bins])

    def _stacked(self, parts: list[NDArray[Any]]) -> NDArray[np.float32]:
        made = np.stack(parts, axis=-1).astype(np.float32)
        return made[..., 0] if self._flat else made
