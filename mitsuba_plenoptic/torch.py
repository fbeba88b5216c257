"""Captures and reconstructions as differentiable functions of PyTorch's tensors (extra ``torch``).

Axes before those that a function names are a batch. Results have the type, which must be of floating point, and the
device of the tensor given. Tensors in the processor's memory share it with NumPy; others are copied to it and back,
except by `render`, whose tensors go to the device of Dr.Jit by DLPack.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from .array_functions import (
    CameraCapture,
    LinearFunction,
    Refocus,
    SmoothFunction,
    points,
    refocusing,
    rendering,
    working_array,
)
from .camera import PlenopticCamera
from .errors import InputError, refuse_if, short_repr
from .operator.operator import CaptureOperator

try:
    import torch
except ImportError:
    raise InputError(
        "mitsuba_plenoptic.torch needs the package torch: pip install 'mitsuba-plenoptic[torch]'"
    ) from None

__all__ = ["adjoint", "capture", "forward", "refocus", "render"]


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
    return _Linear.apply(weights, points(operator))


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
    return _Linear.apply(images, points(operator).T)


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
    return _Smooth.apply(CameraCapture(make, camera, tuple(parameters)), weights, *parameters.values())


def refocus(by: Refocus, captures: torch.Tensor) -> torch.Tensor:
    """Refocus captures, differentiably: with the ray model any number of times, with others once.

    The fields of a coherent refocus, and the images of the steps of a deconvolution, are stored for the reverse pass,
    those of all captures of a batch.

    Parameters
    ----------
    by : RayRefocus, CoherentRefocus or DeconvolvedRefocus
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
    function = refocusing(by, _required(captures).shape[-2:])
    return (
        _Linear.apply(captures, function) if isinstance(function, LinearFunction) else _Smooth.apply(function, captures)
    )


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
        If no value is given, a name is unknown, or a value has another shape.
    """
    shapes = {name: tuple(_required(value).shape) for name, value in values.items()}
    image = rendering(scene, shapes, integrator=integrator, spp=spp, seed=seed)
    return dr.wrap(source="torch", target="drjit")(image)(*(value.float() for value in values.values()))


class _Linear(torch.autograd.Function):
    """A linear map between arrays, with its transpose."""

    @staticmethod
    def forward(ctx: Any, given: torch.Tensor, function: LinearFunction) -> torch.Tensor:
        ctx.function = function
        return _tensor(function.straight(_array(given)), given)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        return _Linear.apply(gradient, ctx.function.T), None

    @staticmethod
    def jvp(ctx: Any, change: torch.Tensor, _: None) -> torch.Tensor:
        return _Linear.apply(change, ctx.function)


class _Smooth(torch.autograd.Function):
    """A function of arrays with derivatives, which are those at the arrays of the forward pass."""

    @staticmethod
    def forward(ctx: Any, function: SmoothFunction, *given: torch.Tensor) -> torch.Tensor:
        ctx.at = function.at(*map(_array, given))
        # Derivatives are taken at the memory of these tensors: PyTorch refuses them once it has been overwritten.
        ctx.save_for_backward(*given)
        ctx.save_for_forward(*given)
        return _tensor(ctx.at.value, given[0])

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        given = ctx.saved_tensors
        found = ctx.at.vjp(_array(gradient), ctx.needs_input_grad[1:])
        pairs = zip(found, given, strict=True)
        return None, *(None if each is None else _tensor(each, like) for each, like in pairs)

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: torch.Tensor | None) -> torch.Tensor:
        made = ctx.at.jvp([None if each is None else _array(each) for each in changes])
        return _tensor(made, ctx.saved_tensors[0])


def _array(tensor: torch.Tensor) -> NDArray[Any]:
    """Return the memory of a tensor, or a copy of it on the processor."""
    given = _required(tensor).detach().cpu()
    # NumPy has no type for bfloat16.
    return working_array((given.float() if given.dtype == torch.bfloat16 else given).resolve_neg().numpy())


def _required(value: Any) -> torch.Tensor:
    """Return a tensor with values in memory, of floating point, which others would round results to; else refuse."""
    refuse_if(not isinstance(value, torch.Tensor), f"{short_repr(value)}: it must be a tensor of PyTorch")
    refuse_if(
        not value.is_floating_point() or value.layout != torch.strided or value.is_meta,
        f"tensor of shape {tuple(value.shape)}, {value.dtype}, {value.layout}, device {value.device}: it must be a "
        "dense tensor of floating point with values",
    )
    return value


def _tensor(array: Any, like: torch.Tensor) -> torch.Tensor:
    """Return an array as a tensor of the type and device of another."""
    return torch.from_numpy(np.asarray(array)).to(like)
