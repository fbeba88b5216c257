"""Captures and reconstructions as differentiable functions of JAX's arrays (extra ``jax``).

Axes before those that a function names are a batch. Results have the type of the array given. The functions run on the
processor, as host callbacks: they can be used inside of ``jax.jit`` and ``jax.vmap``, and differentiated in reverse.
Scenes are rendered by Dr.Jit, which cannot yet be called from JAX.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .array_functions import CameraCapture, LinearFunction, Refocus, SmoothFunction, Value, points, refocusing
from .camera import PlenopticCamera
from .errors import InputError
from .operator.operator import CaptureOperator

try:
    import jax
except ImportError:
    raise InputError("mitsuba_plenoptic.jax needs the package jax: pip install 'mitsuba-plenoptic[jax]'") from None

__all__ = ["adjoint", "capture", "forward", "refocus"]


def forward(operator: CaptureOperator, weights: Any) -> Any:
    """Capture points with weights: `CaptureOperator.forward`, differentiable any number of times.

    A `StoredOperator` computes its spreads once; both directions then are products with its matrix. Other operators
    compute them in each direction.

    Parameters
    ----------
    operator : CaptureOperator
        The points before a camera.
    weights : Array (..., n)
        Weights of the points. With a spectrum (..., wavelengths, n).

    Returns
    -------
    Array (..., rows, columns)
        The images. With a spectrum (..., channels, rows, columns).

    Raises
    ------
    InputError
        If the weights have a wrong shape, or as `CaptureOperator.forward` does.
    """
    return _linear(points(operator), jax.numpy.asarray(weights))


def adjoint(operator: CaptureOperator, images: Any) -> Any:
    """Weigh images by the point spreads: `CaptureOperator.adjoint`, differentiable any number of times.

    Parameters
    ----------
    operator : CaptureOperator
        The points before a camera.
    images : Array (..., rows, columns)
        The images. With a spectrum (..., channels, rows, columns).

    Returns
    -------
    Array (..., n)
        Products with the spreads. With a spectrum (..., wavelengths, n).

    Raises
    ------
    InputError
        If the images have a wrong shape, or as `CaptureOperator.adjoint` does.
    """
    return _linear(points(operator).T, jax.numpy.asarray(images))


def capture(
    make: Callable[[PlenopticCamera], CaptureOperator],
    camera: PlenopticCamera,
    parameters: Mapping[str, Any],
    weights: Any,
) -> Any:
    """Capture points by a camera with some parameters: differentiable by these and by the weights, once.

    The derivatives are those of `CaptureOperator.gradient`: the points and the power through the pupil are fixed.

    Parameters
    ----------
    make : callable
        Returns the operator for a camera, such as ``lambda camera: CaptureOperator(camera, points, wavelength=633)``.
        Return a `StoredOperator` if the gradient by the weights is needed, which then computes no spread again.
    camera : PlenopticCamera
        The camera, of which `parameters` replace some.
    parameters : mapping of str to Array
        Values by name: one number, or as many as the camera has. All that `CaptureOperator.gradient` returns can be
        given, except for the wavelength.
    weights : Array
        As for `forward`.

    Returns
    -------
    Array
        As from `forward`, of the type of the weights.

    Raises
    ------
    InputError
        If a parameter has no derivative or is out of range, or as `CaptureOperator.forward` and `gradient` do.
    """
    function = _Latest(CameraCapture(make, camera, tuple(parameters)))
    return _smooth(function, *map(jax.numpy.asarray, (weights, *parameters.values())))


def refocus(by: Refocus, captures: Any) -> Any:
    """Refocus captures, differentiably: with the ray model any number of times, with others once.

    The fields of a coherent refocus, and the images of the steps of a deconvolution, are stored for the reverse pass,
    those of all captures of the latest batch.

    Parameters
    ----------
    by : RayRefocus, CoherentRefocus or DeconvolvedRefocus
        The camera, distance and method.
    captures : Array (..., rows, columns)
        The recorded pixels.

    Returns
    -------
    Array (..., rows, columns)
        The images, with 0 in bins that `reconstruct` leaves unknown.

    Raises
    ------
    InputError
        If the captures have a wrong shape.
    """
    captures = jax.numpy.asarray(captures)
    function = refocusing(by, captures.shape[-2:])
    return _linear(function, captures) if isinstance(function, LinearFunction) else _smooth(_Latest(function), captures)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _linear(function: LinearFunction, given: Any) -> Any:
    """Apply a linear map."""
    return _on_host(function.straight, given, shape=function.shape(given.shape), vectorized=True)


def _linear_forward(function: LinearFunction, given: Any) -> tuple[Any, None]:
    return _linear(function, given), None


def _linear_backward(function: LinearFunction, _: None, gradient: Any) -> tuple[Any]:
    return (_linear(function.T, gradient),)


_linear.defvjp(_linear_forward, _linear_backward)


class _Latest:
    """A function that remembers its latest value with what the derivatives need, for the reverse pass."""

    def __init__(self, function: SmoothFunction) -> None:
        self._function, self.shape = function, function.shape
        self._given: list[NDArray[Any]] = []
        self._value: Value | None = None

    def at(self, *given: NDArray[Any]) -> Value:
        """Return the value at some arrays."""
        if self._value is None or not all(map(np.array_equal, given, self._given)):
            # JAX may use the memory of the arrays for others.
            self._given = [each.copy() for each in given]
            self._value = self._function.at(*self._given)
        return self._value


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _smooth(function: _Latest, *given: Any) -> Any:
    """Apply a function with derivatives."""
    return _on_host(lambda *arrays: function.at(*arrays).value, *given, shape=function.shape(given[0].shape))


def _smooth_forward(function: _Latest, *given: Any) -> tuple[Any, tuple[Any, ...]]:
    return _smooth(function, *given), given


def _smooth_backward(function: _Latest, given: tuple[Any, ...], gradient: Any) -> tuple[Any, ...]:
    def found(gradient: NDArray[Any], *arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
        made = function.at(*arrays).vjp(gradient, [True] * len(arrays))
        return tuple(np.asarray(each, array.dtype) for each, array in zip(made, arrays, strict=True))

    like = tuple(jax.ShapeDtypeStruct(each.shape, each.dtype) for each in given)
    return jax.pure_callback(
        lambda *each: found(*map(np.asarray, each)), like, gradient, *given, vmap_method="sequential"
    )


_smooth.defvjp(_smooth_forward, _smooth_backward)


def _on_host(function: Callable[..., Any], *given: Any, shape: tuple[int, ...], vectorized: bool = False) -> Any:
    """Apply a function of NumPy's arrays; the result has the type of the first."""
    kind = given[0].dtype

    def called(*arrays: Any) -> NDArray[Any]:
        return np.asarray(function(*map(np.asarray, arrays)), kind)

    method = "expand_dims" if vectorized else "sequential"
    return jax.pure_callback(called, jax.ShapeDtypeStruct(shape, kind), *given, vmap_method=method)
