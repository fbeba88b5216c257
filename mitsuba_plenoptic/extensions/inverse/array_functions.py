"""Captures and reconstructions as functions of NumPy arrays with derivatives, shared by the PyTorch and JAX modules.

Leading axes beyond those that a function names are a batch. There are two kinds of functions: linear maps with their
transposes, and others, which return their value together with the derivatives at the given arrays, so that the reverse
pass computes nothing again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Protocol

import numpy as np

from ...camera import PlenopticCamera
from ...errors import refuse_if, require_known
from ...points import CaptureOperator, derivatives
from ...runtime import Array, Named, Sizes
from .differentiable import CoherentRefocus, DeconvolvedRefocus, RayRefocus

Refocus = RayRefocus | CoherentRefocus | DeconvolvedRefocus


@dataclass(frozen=True, eq=False)
class LinearFunction:
    """A linear map between arrays, with its transpose."""

    straight: Callable[[Array], Array]
    transposed: Callable[[Array], Array]
    # What it takes and its results, for messages, and their last axes.
    takes: str
    gives: str
    before: Sizes
    after: Sizes

    @property
    def T(self) -> LinearFunction:
        """Transpose of this linear map."""
        return LinearFunction(self.transposed, self.straight, self.gives, self.takes, self.after, self.before)

    def shape(self, shape_of_input: Sizes) -> Sizes:
        """Return the shape of the result for an array of a given shape; refuse wrong shapes before computing."""
        return *_batch(self.takes, shape_of_input, self.before), *self.after


class Value(Protocol):
    """Value of a function at given arrays, with its derivatives at these arrays."""

    value: Array

    def jvp(self, changes: Sequence[Array | None]) -> Array:
        """Return the change of the value for changes of the arrays; None stands for no change of an array."""

    def vjp(self, gradient: Array, needed: Sequence[bool]) -> list[Array | None]:
        """Return the gradient with respect to each array that needs one, in the array's shape."""


class SmoothFunction(Protocol):
    """A differentiable function of arrays."""

    def at(self, *arrays: Array) -> Value:
        """Return the value of the function at given arrays, with the data for its derivatives."""

    def shape(self, shape_of_input: Sizes) -> Sizes:
        """Return the shape of the result for a first array of a given shape; refuse wrong shapes before computing."""


@dataclass(eq=False)
class Latest:
    """A function that keeps its latest value, with the data that derivatives need.

    Parameters
    ----------
    function : SmoothFunction
        The function.
    copied : callable
        Function that copies an array of the library that calls.
    equal : callable
        Whether two arrays of this library are equal.
    taken : callable
        Function that converts an array of this library into an argument of `function`.
    """

    function: SmoothFunction
    copied: Callable[[Any], Any]
    equal: Callable[[Any, Any], bool]
    taken: Callable[[Any], Any]

    def __post_init__(self) -> None:
        self.shape = self.function.shape
        self.forget()

    def forget(self) -> None:
        """Free the latest value; a later request computes it again."""
        self._given: list = []
        self._value: Value | None = None

    def at(self, arrays: Sequence) -> Value:
        """Return the value of the function at given arrays, computed only if they differ from the latest arrays."""
        # Another thread may have this function forget its value meanwhile.
        last = self._given
        value = self._value
        if value is None or len(last) != len(arrays) or not all(map(self.equal, arrays, last)):
            # Their owners may use the memory of the arrays for others.
            last = [self.copied(array) for array in arrays]
            value = self.function.at(*map(self.taken, last))
            self._given = last
            self._value = value
        return value


def _batch(name: str, stated: Sizes, last: Sizes) -> Sizes:
    """Return the batch axes of a shape; refuse arrays whose last axes are wrong."""
    refuse_if(
        stated[-len(last) :] != last or not math.prod(stated),
        f"{name} of shape {stated}: it must not be empty, and its last axes must be {last}",
    )
    return stated[: len(stated) - len(last)]


ONCE = "derivatives of derivatives: captures by a camera's parameters, refocusing and rendering have none"
"""What is told who differentiates twice."""


def working_array(array: Array) -> Array:
    """Return an array in single or double precision; half precision becomes single."""
    return array if array.dtype in (np.float32, np.float64) else array.astype(np.float32)


# -- points ------------------------------------------------------------------------------------------


_WEIGHTS = "weights", "images"


def points(operator: CaptureOperator) -> LinearFunction:
    """Return the linear map from weights of points to images of an operator."""
    return LinearFunction(partial(_images, operator), partial(_products, operator), *_WEIGHTS, *_axes(operator))


def _images(operator: CaptureOperator, weights: Array) -> Array:
    """Return images, the operator applied to weights."""
    return _applied(operator.forward, _columns(operator, weights), weights, *_axes(operator))


def _products(operator: CaptureOperator, images: Array) -> Array:
    """Return weights, the operator's transpose applied to images."""
    return _applied(operator.adjoint, _columns(operator, images, 1), images, *_axes(operator)[::-1])


def _axes(operator: CaptureOperator) -> tuple[Sizes, Sizes]:
    """Return the last axes of weights and of images of an operator, without the batch."""
    count = len(operator.points)
    shape = operator.camera.shape
    spectrum = operator.spectrum
    if spectrum is None:
        return (count,), shape
    return (len(spectrum.wavelengths), count), (spectrum.channels, *shape)


def _columns(operator: CaptureOperator, values: Array, side: int = 0) -> list[Array]:
    """Return a batch of weights (side 0) or images (1) as the operator takes them: at once, or by one of a spectrum."""
    last = _axes(operator)[side]
    _batch(_WEIGHTS[side], values.shape, last)
    flat = values.reshape(-1, *last)
    return [np.moveaxis(channel, 0, -1) for channel in ([flat] if operator.spectrum is None else flat)]


def _applied(
    function: Callable[[Array], Array], columns: Sequence[Array], values: Array, before: Sizes, after: Sizes
) -> Array:
    """Return the results of a function of columns of values as a batch like the values."""
    results = np.concatenate([np.moveaxis(function(column), -1, 0) for column in columns])
    # In the order of memory that the layers of networks are fast with.
    return np.ascontiguousarray(results).reshape(*values.shape[: -len(before)], *after)


# -- cameras -----------------------------------------------------------------------------------------


class CameraCapture:
    """Captures of points as a function of the points' weights and of camera parameters.

    Parameters
    ----------
    make : callable
        Function of a camera that returns the operator of the points.
    camera : PlenopticCamera
        The camera, whose other parameters stay as they are.
    names : sequence of str
        The parameters that are given after the weights.
    """

    def __init__(
        self, make: Callable[[PlenopticCamera], CaptureOperator], camera: PlenopticCamera, names: Sequence[str]
    ):
        require_known(
            "parameters: ", names, [name for name in derivatives.DIFFERENTIABLE if name != derivatives.WAVELENGTH]
        )
        self._make, self._camera, self._names = make, camera.regular, tuple(names)

    @cached_property
    def _last_axes(self) -> tuple[Sizes, Sizes]:
        """The last axes of weights and of images; the operator itself is not kept, since it may be large."""
        return _axes(self._make(self._camera))

    def at(self, *arrays: Array) -> CameraValue:
        """Return the captures of weighted points by the camera with given parameter values."""
        weights, *values = arrays
        changed = {name: value.tolist() for name, value in zip(self._names, values, strict=True)}
        # Derivatives by the focal length are those of a fixed aperture.
        camera = self._camera.replace(**{"aperture_radius": self._camera.aperture_radius} | changed)
        return CameraValue(self._make(camera), camera, self._names, weights, values)

    def shape(self, shape_of_input: Sizes) -> Sizes:
        """Return the shape of images for weights of a given shape."""
        before, after = self._last_axes
        return *_batch("weights", shape_of_input, before), *after


@dataclass(eq=False)
class CameraValue:
    """Captures of points, and their derivatives with respect to the weights and to camera parameters."""

    operator: CaptureOperator
    camera: PlenopticCamera
    names: tuple[str, ...]
    weights: Array
    values: Sequence[Array]

    def __post_init__(self) -> None:
        self.value = _images(self.operator, self.weights)

    def jvp(self, changes: Sequence[Array | None]) -> Array:
        """Return the change of the images for changes of weights and parameters; see `Value`."""
        of_weights, *of_values = changes
        total = np.zeros(self.value.shape) if of_weights is None else _images(self.operator, of_weights)
        named = {name: value for name, value in zip(self.names, of_values, strict=True) if value is not None}
        if not named:
            return total
        columns = _columns(self.operator, self.weights)
        derivative = partial(self.operator.derivative, changes=named)
        return total + _applied(derivative, columns, self.weights, *_axes(self.operator))

    def vjp(self, gradient: Array, needed: Sequence[bool]) -> list[Array | None]:
        """Return the gradients with respect to weights and parameters; see `Value`."""
        names = [name for name, is_needed in zip(self.names, needed[1:], strict=True) if is_needed]
        total: Named = dict.fromkeys(names, 0.0)
        if names:
            columns = _columns(self.operator, self.weights)
            channels = _columns(self.operator, gradient, 1)
            for factors, image in zip(columns, channels, strict=True):
                gradients = self.operator.gradient(factors, image, names)
                total = {name: total[name] + gradients[name] for name in names}
        by_values: list[Array | None] = [None] * len(self.names)
        for index, (name, value) in enumerate(zip(self.names, self.values, strict=True)):
            if name in total:
                # A list of one number may stand for all parts, too.
                for_all = value.size == 1 and np.ndim(getattr(self.camera, name)) == 0
                by_values[index] = np.reshape(total[name].sum() if for_all else total[name][: value.size], value.shape)
        return [_products(self.operator, gradient) if needed[0] else None, *by_values]


# -- reconstructions ---------------------------------------------------------------------------------


def refocusing(by: Refocus) -> LinearFunction | Refocused:
    """Return the function from captures to refocused images."""
    if isinstance(by, RayRefocus):
        both = partial(_together, by, by.forward), partial(_together, by, by.adjoint, side=1)
        return LinearFunction(*both, *_NAMES, by.camera.shape, by.shape)
    return Refocused(by)


_NAMES = "captures", "images"


@dataclass(frozen=True, eq=False)
class Refocused:
    """Refocusing by waves or by deconvolution, as a nonlinear function of captures."""

    by: CoherentRefocus | DeconvolvedRefocus

    def at(self, *arrays: Array) -> RefocusedValue:
        """Return refocused captures together with their derivatives."""
        return RefocusedValue(self.by, *arrays)

    def shape(self, shape_of_input: Sizes) -> Sizes:
        """Return the shape of refocused images for captures of a given shape; refuse a wrong shape."""
        return *_batch(_NAMES[0], shape_of_input, self.by.camera.shape), *self.by.shape


class RefocusedValue:
    """Refocused captures, with their derivatives with respect to the captures."""

    def __init__(self, by: CoherentRefocus | DeconvolvedRefocus, captures: Array):
        def image(pixels: Array) -> Array:
            self._at = by.at(pixels)
            return self._at.image

        self._by = by
        self.value = _together(by, image, captures)

    def jvp(self, changes: Sequence[Array | None]) -> Array:
        """Return the change of the refocused images for a change of the captures; see `Value`."""
        (change,) = changes
        if change is None:
            return np.zeros(self.value.shape)
        return _together(self._by, self._at.jvp, change)

    def vjp(self, gradient: Array, needed: Sequence[bool]) -> list[Array | None]:
        """Return the gradient with respect to the captures; see `Value`."""
        return [_together(self._by, self._at.vjp, gradient, 1) if needed[0] else None]


def _together(by: Refocus, function: Callable[[Array], Array], values: Array, side: int = 0) -> Array:
    """Return a batch of captures (side 0) or images (1) to which a function of one with channels was applied."""
    axes = by.camera.shape, by.shape
    _batch(_NAMES[side], values.shape, axes[side])
    columns = [np.moveaxis(values.reshape(-1, *axes[side]), 0, -1)]
    return _applied(function, columns, values, axes[side], axes[1 - side])
