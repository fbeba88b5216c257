"""Captures and reconstructions as differentiable functions of JAX's arrays (extra ``jax``).

Arguments and results are those of the functions of the same names in `mitsuba_plenoptic.torch`. Leading axes beyond
those that a function names are a batch, of which derivatives of `refocus` keep the latest one. Results have the type of
the input, which must be floating point. The functions run on the CPU as host callbacks: they can be used inside
``jax.jit`` and ``jax.vmap``, and differentiated in reverse and in forward mode.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...camera import PlenopticCamera
from ...errors import InputError, refuse_if
from ...points import CaptureOperator
from ...runtime import Array, Facts, Pair, Sizes, one_at_a_time
from .array_functions import (
    ONCE,
    CameraCapture,
    Latest,
    LinearFunction,
    Refocus,
    SmoothFunction,
    points,
    refocusing,
    working_array,
)
from .scene_functions import Rendering

try:
    import jax
    from jax.extend.core import Primitive
    from jax.interpreters import ad, batching, mlir
except ImportError:
    raise InputError("mitsuba_plenoptic.jax needs the package jax: pip install 'mitsuba-plenoptic[jax]'") from None

__all__ = ["adjoint", "capture", "forward", "refocus", "render"]


def forward(operator: CaptureOperator, weights: Any) -> Any:
    """Return captures of weighted points, as `CaptureOperator.forward` does; differentiable any number of times."""
    return _linear.bind(_required("weights", weights), function=points(operator))


def adjoint(operator: CaptureOperator, images: Any) -> Any:
    """Return images correlated with point spreads, as `CaptureOperator.adjoint`; differentiable any number of times."""
    return _linear.bind(_required("images", images), function=points(operator).T)


def capture(
    make: Callable[[PlenopticCamera], CaptureOperator],
    camera: PlenopticCamera,
    parameters: Facts,
    weights: Any,
) -> Any:
    """Return captures of points by a camera, differentiable once with respect to given parameters and the weights.

    Parameters
    ----------
    make, camera, parameters, weights
        As for `torch.capture`.
    """
    function = _latest(CameraCapture(make, camera, tuple(parameters)))
    values = (_required(name, value) for name, value in parameters.items())
    return _smooth.bind(_required("weights", weights), *values, function=function)


def refocus(by: Refocus, captures: Any) -> Any:
    """Return refocused captures; differentiable any number of times with the ray model, once with other methods."""
    captures = _required("captures", captures)
    function = refocusing(by)
    if isinstance(function, LinearFunction):
        return _linear.bind(captures, function=function)
    return _smooth.bind(captures, function=_latest(function))


def render(scene: Any, values: Facts, *, integrator: Any = None, spp: int = 0, seed: int = 0) -> Any:
    """Return the image of a scene with given parameters, as ``mi.render`` does, with first derivatives by them.

    The image has the type of the first value.

    Parameters
    ----------
    scene, values, integrator, spp, seed
        As for `torch.render`.
    """
    required = [_required(name, value) for name, value in values.items()]
    shapes = {name: value.shape for name, value in zip(values, required, strict=True)}
    return _smooth.bind(
        *required, function=_latest(Rendering(scene, shapes, integrator=integrator, spp=spp, seed=seed))
    )


def _required(name: str, value: Any) -> Any:
    """Return a value as a floating-point array; other types, which would round results, are refused."""
    array = jax.numpy.asarray(value)
    refuse_if(
        not jax.numpy.issubdtype(array.dtype, jax.numpy.floating),
        f"{name}: its type is {array.dtype}: it must be of floating point",
    )
    return array


_VALUES = 16
"""Functions made last that keep their values: captures that one loss may hold without computing any of them twice."""

_latest_made: deque[Latest] = deque(maxlen=_VALUES)


def _latest(function: SmoothFunction) -> Latest:
    """Return a function that remembers its latest value; few such functions are kept."""
    latest = Latest(function, np.copy, np.array_equal, np.asarray)
    # JAX's caches keep thousands of functions that were called once, which must be empty then.
    if len(_latest_made) == _VALUES:
        _latest_made[0].forget()
    _latest_made.append(latest)
    return latest


# -- primitives of JAX -------------------------------------------------------------------------------
# Each calls NumPy on the host. The transposes of linear maps and of changes make them differentiable in both modes.


def _on_host(function: Callable, like: Any) -> Callable:
    """Return `function` of NumPy arrays as a function of JAX arrays on the host; `like` describes its results.

    JAX calls it from its own threads, and independent calls, such as a value and its derivatives, at the same time.
    """

    @one_at_a_time
    def called(*arrays: Any) -> Any:
        value = function([working_array(np.asarray(array)) for array in arrays])
        return jax.tree.map(lambda one, array: np.asarray(array, one.dtype).reshape(one.shape), like, value)

    return called


def _like(array: Any, shape: Sizes | None = None) -> Any:
    """Return JAX's description of an array of the same type as `array`, with a given shape."""
    return jax.ShapeDtypeStruct(array.shape if shape is None else shape, array.dtype)


def _primitive(name: str, apply: Callable, like: Callable, several: bool = False) -> Primitive:
    """Return a JAX primitive that applies a function; `like` returns the descriptions of its results."""
    primitive = Primitive(f"plenoptic_{name}")
    primitive.multiple_results = several

    def evaluate(*given: Any, **options: Any) -> Any:
        # Not as a callback, for which JAX compiles a program per function and keeps thousands with what they hold. The
        # arrays are waited for first: what computes them may need its turn on the host.
        arrays = [np.asarray(value) for value in given]
        called = _on_host(partial(apply, **options), like(*given, **options))
        return jax.tree.map(jax.numpy.asarray, called(*arrays))

    def compiled(*given: Any, **options: Any) -> Any:
        shapes = like(*given, **options)
        return jax.pure_callback(_on_host(partial(apply, **options), shapes), shapes, *given)

    def abstract(*given: Any, **options: Any) -> Any:
        return jax.tree.map(lambda one: jax.core.ShapedArray(one.shape, one.dtype), like(*given, **options))

    primitive.def_impl(evaluate)
    primitive.def_abstract_eval(abstract)
    mlir.register_lowering(primitive, mlir.lower_fun(compiled, multiple_results=several))
    return primitive


def _one_by_one(primitive: Primitive) -> None:
    """Register the rule by which ``jax.vmap`` applies a primitive row by row."""

    def batched(given: Sequence, axes: Sequence, **options: Any) -> Any:
        mapped = [k for k, axis in enumerate(axes) if axis is not None]

        def row(parts: Sequence) -> Any:
            all_given = list(given)
            for k, value in zip(mapped, parts, strict=True):
                all_given[k] = value
            return primitive.bind(*all_given, **options)

        rows = jax.lax.map(row, [jax.numpy.moveaxis(given[k], axes[k], 0) for k in mapped])
        return rows, [0] * len(rows) if primitive.multiple_results else 0

    batching.primitive_batchers[primitive] = batched


# A linear map.
_linear = _primitive(
    "linear",
    lambda given, function: function.straight(*given),
    lambda given, function: _like(given, function.shape(given.shape)),
)


ad.deflinear2(_linear, lambda gradient, _, function: [_linear.bind(gradient, function=function.T)])
batching.primitive_batchers[_linear] = lambda given, axes, function: (
    _linear.bind(jax.numpy.moveaxis(given[0], axes[0], 0), function=function),
    0,
)

# A function with derivatives.
_smooth = _primitive(
    "smooth",
    lambda given, function: function.at(given).value,
    lambda *given, function: _like(given[0], function.shape(given[0].shape)),
)


def _changed(given: Sequence, *, function: Latest, which: tuple[bool, ...]) -> Array:
    # The arrays at which the derivative is taken come first, then the changes of those that change.
    changes = iter(given[len(which) :])
    return function.at(given[: len(which)]).jvp([next(changes) if one else None for one in which])


# Its change with those of some of the arrays, in which it is linear.
_change = _primitive(
    "change", _changed, lambda *given, function, which: _like(given[0], function.shape(given[0].shape))
)


def _gradients(given: Sequence, *, function: Latest, which: tuple[bool, ...]) -> list:
    return [each for each in function.at(given[:-1]).vjp(given[-1], which) if each is not None]


# The gradients by these arrays.
_gradient = _primitive(
    "gradient",
    _gradients,
    lambda *given, function, which: [_like(each) for each, one in zip(given, which, strict=False) if one],
    several=True,
)


def _smooth_jvp(given: Sequence, changes: Sequence, *, function: Latest) -> Pair:
    which = tuple(type(each) is not ad.Zero for each in changes)
    known = [each for each, one in zip(changes, which, strict=True) if one]
    value = _smooth.bind(*given, function=function)
    return value, _change.bind(*given, *known, function=function, which=which)


def _change_transpose(gradient: Any, *given: Any, function: Latest, which: tuple[bool, ...]) -> list:
    arrays = given[: len(which)]
    if type(gradient) is ad.Zero:
        return [None] * len(given)
    return [None] * len(arrays) + _gradient.bind(*arrays, gradient, function=function, which=which)


def _once(*_: Any, **__: Any) -> Any:
    raise InputError(ONCE)


for _each in (_smooth, _change, _gradient):
    _one_by_one(_each)
ad.primitive_jvps.update({_smooth: _smooth_jvp, _change: _once, _gradient: _once})
ad.primitive_transposes[_change] = _change_transpose
