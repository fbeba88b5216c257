"""Captures and reconstructions as differentiable functions of PyTorch's tensors (extra ``torch``).

Axes before those that a function names are a batch. Results have the type and the device of the tensor given. Tensors
on the processor share their memory with NumPy; others are copied to it and back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .camera import PlenopticCamera
from .errors import InputError, refuse_if, require_known, short_repr
from .operator.derivatives import DIFFERENTIABLE, WAVELENGTH
from .operator.operator import CaptureOperator
from .reconstruction import CoherentRefocus, RayRefocus

try:
    import torch
except ImportError:
    raise InputError(
        "mitsuba_plenoptic.torch needs the package torch: pip install 'mitsuba-plenoptic[torch]'"
    ) from None

__all__ = ["adjoint", "capture", "forward", "refocus", "render"]

_Map = Callable[[NDArray[Any]], NDArray[Any]]


def forward(operator: CaptureOperator, weights: torch.Tensor) -> torch.Tensor:
    """Capture points with weights: `CaptureOperator.forward`, differentiable any number of times.

    A `StoredOperator` computes its spreads once; both directions then are products with its matrix. Other operators
    compute them in each direction.

    Parameters
    ----------
    operator : CaptureOperator
        The points before a camera.
    weights : Tensor (..., n)
        Weights of the points. With a spectrum (..., wavelengths, n).

    Returns
    -------
    Tensor (..., rows, columns)
        The images. With a spectrum (..., channels, rows, columns).

    Raises
    ------
    InputError
        If the weights have a wrong shape, or as `CaptureOperator.forward` does.
    """
    return _Linear.apply(weights, partial(_images, operator), partial(_products, operator))


def adjoint(operator: CaptureOperator, images: torch.Tensor) -> torch.Tensor:
    """Weigh images by the point spreads: `CaptureOperator.adjoint`, differentiable any number of times.

    Parameters
    ----------
    operator : CaptureOperator
        The points before a camera.
    images : Tensor (..., rows, columns)
        The images. With a spectrum (..., channels, rows, columns).

    Returns
    -------
    Tensor (..., n)
        Products with the spreads. With a spectrum (..., wavelengths, n).

    Raises
    ------
    InputError
        If the images have a wrong shape, or as `CaptureOperator.adjoint` does.
    """
    return _Linear.apply(images, partial(_products, operator), partial(_images, operator))


def capture(
    make: Callable[[PlenopticCamera], CaptureOperator],
    camera: PlenopticCamera,
    parameters: Mapping[str, torch.Tensor],
    weights: torch.Tensor,
) -> torch.Tensor:
    """Capture points by a camera with some parameters: differentiable by these and by the weights, once.

    The derivatives are those of `CaptureOperator.gradient`: the points and the power through the pupil are fixed.

    Parameters
    ----------
    make : callable
        Returns the operator for a camera, such as ``lambda camera: CaptureOperator(camera, points, wavelength=633)``.
        Return a `StoredOperator` if the gradient by the weights is needed, which then computes no spread again.
    camera : PlenopticCamera
        The camera, of which `parameters` replace some.
    parameters : mapping of str to Tensor
        Values by name: one number, or as many as the camera has. All that `CaptureOperator.gradient` returns can be
        given, except for the wavelength.
    weights : Tensor
        As for `forward`.

    Returns
    -------
    Tensor
        As from `forward`, of the type of the weights.

    Raises
    ------
    InputError
        If a parameter has no derivative or is out of range, or as `CaptureOperator.forward` and `gradient` do.
    """
    require_known("parameters: ", parameters, [name for name in DIFFERENTIABLE if name != WAVELENGTH])
    values = {name: _array(value).tolist() for name, value in parameters.items()}
    operator = make(camera.replace(**values))
    return _Capture.apply(operator, tuple(parameters), weights, *parameters.values())


def refocus(by: RayRefocus | CoherentRefocus, captures: torch.Tensor) -> torch.Tensor:
    """Refocus captures, differentiably: by rays any number of times, by waves once.

    The fields of a refocus by waves are stored for the reverse pass, those of all captures of a batch.

    Parameters
    ----------
    by : RayRefocus or CoherentRefocus
        The camera, distance and method.
    captures : Tensor (..., rows, columns)
        The recorded pixels.

    Returns
    -------
    Tensor (..., rows, columns)
        The images, with 0 in bins that `reconstruct` leaves unknown.

    Raises
    ------
    InputError
        If the captures have a wrong shape.
    """
    if isinstance(by, RayRefocus):
        return _Linear.apply(captures, partial(_together, by.forward), partial(_together, by.adjoint))
    return _Refocus.apply(captures, by)


def render(
    scene: Any, values: Mapping[str, torch.Tensor], *, integrator: Any = None, spp: int = 0, seed: int = 0
) -> torch.Tensor:
    """Render a scene with some parameters: ``mi.render``, differentiable by these in reverse, once.

    Captures by ``plenoptic_wave`` have the derivatives by the scene and by the camera that its documentation lists.
    The parameters of the scene change.

    Parameters
    ----------
    scene : mitsuba.Scene
        The scene, loaded in a variant with derivatives (such as ``llvm_ad_mono``).
    values : mapping of str to Tensor
        Values by the names of ``mi.traverse(scene)``, of the shape that NumPy shows them in.
    integrator : mitsuba.Integrator, optional
        Default: that of the scene.
    spp : int
        Samples per pixel. 0: those of the scene's sampler.
    seed : int
        Seed of the random numbers. The reverse pass draws others.

    Returns
    -------
    Tensor (rows, columns, channels)
        The film's image, in single precision.

    Raises
    ------
    InputError
        If a name is unknown.
    """
    parameters = mi.traverse(scene)
    require_known("values: ", values, list(parameters.keys()))

    def image(*tensors: Any) -> Any:
        for name, tensor in zip(values, tensors, strict=True):
            kind = type(parameters[name])
            parameters[name] = kind(tensor) if dr.is_tensor_v(kind) else dr.unravel(kind, tensor.array, order="C")
        parameters.update()
        return mi.render(scene, parameters, integrator=integrator, spp=spp, seed=seed)

    return dr.wrap(source="torch", target="drjit")(image)(*(_required(value).float() for value in values.values()))


class _Linear(torch.autograd.Function):
    """A linear map between arrays, with its transpose."""

    @staticmethod
    def forward(ctx: Any, given: torch.Tensor, straight: _Map, transposed: _Map) -> torch.Tensor:
        ctx.maps = straight, transposed
        return _tensor(straight(_array(given)), given)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        straight, transposed = ctx.maps
        return _Linear.apply(gradient, transposed, straight), None, None

    @staticmethod
    def jvp(ctx: Any, change: torch.Tensor, *_: None) -> torch.Tensor:
        return _Linear.apply(change, *ctx.maps)


class _Capture(torch.autograd.Function):
    """A capture as a function of weights and camera parameters."""

    @staticmethod
    def forward(
        ctx: Any, operator: CaptureOperator, names: tuple[str, ...], weights: torch.Tensor, *values: torch.Tensor
    ) -> torch.Tensor:
        ctx.operator, ctx.names = operator, names
        ctx.save_for_backward(weights, *values)
        return _tensor(_images(operator, _array(weights)), weights)

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (weights, *values), given, needed = ctx.saved_tensors, _array(gradient), ctx.needs_input_grad[2:]
        by_weights = _tensor(_products(ctx.operator, given), weights) if needed[0] else None
        names = [name for name, one in zip(ctx.names, needed[1:], strict=True) if one]
        total: dict[str, Any] = dict.fromkeys(names, 0.0)
        if names:
            columns = zip(_columns(ctx.operator, _array(weights)), _channels(ctx.operator, given), strict=True)
            for factors, image in columns:
                found = ctx.operator.gradient(factors, image, names)
                total = {name: total[name] + found[name] for name in names}
        by_values = (
            _tensor(_shaped(total[name], value), value) if name in total else None
            for name, value in zip(ctx.names, values, strict=True)
        )
        return None, None, by_weights, *by_values


class _Refocus(torch.autograd.Function):
    """Refocusing with waves, which is not linear."""

    @staticmethod
    def forward(ctx: Any, captures: torch.Tensor, by: CoherentRefocus) -> torch.Tensor:
        def image(given: NDArray[Any]) -> NDArray[Any]:
            ctx.at = by.at(given)
            return ctx.at.image

        return _tensor(_together(image, _array(captures)), captures)

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        return _tensor(_together(ctx.at.vjp, _array(gradient)), gradient), None

    @staticmethod
    def jvp(ctx: Any, change: torch.Tensor, _: None) -> torch.Tensor:
        return _tensor(_together(ctx.at.jvp, _array(change)), change)


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    """Return the memory of a tensor, or a copy of it on the processor."""
    return _required(tensor).detach().cpu().numpy()


def _required(value: Any) -> torch.Tensor:
    """Return a tensor, or refuse anything else."""
    refuse_if(not isinstance(value, torch.Tensor), f"{short_repr(value)}: it must be a tensor of PyTorch")
    return value


def _tensor(array: Any, like: torch.Tensor) -> torch.Tensor:
    """Return an array as a tensor of the type and device of another."""
    return torch.from_numpy(np.asarray(array)).to(like)


def _images(operator: CaptureOperator, weights: NDArray[Any]) -> NDArray[Any]:
    """Apply the operator to weights."""
    made = [np.moveaxis(operator.forward(columns), -1, 0) for columns in _columns(operator, weights)]
    before, after = _axes(operator)
    # In the order of memory that PyTorch's layers are fast with.
    return np.ascontiguousarray(np.concatenate(made)).reshape(*weights.shape[: -len(before)], *after)


def _products(operator: CaptureOperator, images: NDArray[Any]) -> NDArray[Any]:
    """Apply the operator's transpose to images."""
    made = [operator.adjoint(channels).T for channels in _channels(operator, images)]
    after, before = _axes(operator)
    return np.concatenate(made).reshape(*images.shape[: -len(before)], *after)


def _columns(operator: CaptureOperator, weights: NDArray[Any]) -> list[NDArray[Any]]:
    """Return weights as the operator takes them."""
    return _split("weights", weights, _axes(operator)[0], operator)


def _channels(operator: CaptureOperator, images: NDArray[Any]) -> list[NDArray[Any]]:
    """Return images as the operator takes them."""
    return _split("images", images, _axes(operator)[1], operator)


def _axes(operator: CaptureOperator) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the last axes of weights, and those of images."""
    count, shape, spectrum = len(operator.points), operator.camera.shape, operator.spectrum
    if spectrum is None:
        return (count,), shape
    return (len(spectrum.wavelengths), count), (spectrum.channels, *shape)


def _split(name: str, given: NDArray[Any], last: tuple[int, ...], operator: CaptureOperator) -> list[NDArray[Any]]:
    """Return a batch as columns or channels: together if they have one wavelength, one by one with a spectrum."""
    refuse_if(
        given.shape[-len(last) :] != last or not given.size,
        f"{name} of shape {given.shape}: it must not be empty, and its last axes must be {last}",
    )
    flat = given.reshape(-1, *last)
    return [np.moveaxis(one, 0, -1) for one in ([flat] if operator.spectrum is None else flat)]


def _together(function: _Map, captures: NDArray[Any]) -> NDArray[Any]:
    """Apply a function of an image with channels to a batch of images."""
    refuse_if(captures.ndim < 2 or not captures.size, f"captures of shape {captures.shape}: give (..., rows, columns)")
    made = function(np.moveaxis(captures.reshape(-1, *captures.shape[-2:]), 0, -1))
    return np.ascontiguousarray(np.moveaxis(made, -1, 0)).reshape(*captures.shape[:-2], *made.shape[:2])


def _shaped(gradient: NDArray[np.float64], value: torch.Tensor) -> NDArray[np.float64]:
    """Return the gradient by the parts of a parameter as one by its value, which may be one number for all parts."""
    if value.ndim == 0:
        return gradient.sum()
    return gradient[: math.prod(value.shape)].reshape(tuple(value.shape))
