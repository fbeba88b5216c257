"""Captures and reconstructions as differentiable functions of PyTorch's tensors (extra ``torch``).

Leading axes beyond those that a function names are a batch. Results have the type, which must be floating point, and
the device of the input. CPU tensors share memory with NumPy; others are copied to the CPU and back, except by `render`,
whose tensors go to Dr.Jit's device by DLPack. All functions have derivatives in reverse and forward mode, and can be
used in the transforms of ``torch.func``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera import PlenopticCamera
from ...errors import InputError, refuse_if, short_repr
from ...points import CaptureOperator
from ...runtime import Array, Pair, drjit_array
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
    import torch
except ImportError:
    raise InputError(
        "mitsuba_plenoptic.torch needs the package torch: pip install 'mitsuba-plenoptic[torch]'"
    ) from None

__all__ = ["adjoint", "capture", "forward", "refocus", "render"]


def forward(operator: CaptureOperator, weights: torch.Tensor) -> torch.Tensor:
    """Return captures of weighted points, as `CaptureOperator.forward` does; differentiable any number of times.

    A `StoredOperator` computes its point spreads once; forward and reverse passes are then products with its matrix.

    Parameters
    ----------
    operator : CaptureOperator
        The points before a camera.
    weights : Tensor (..., n)
        Weights of the points; with a spectrum (..., wavelengths, n).

    Returns
    -------
    Tensor (..., rows, columns)
        The images; with a spectrum (..., channels, rows, columns).
    """
    return _Linear.apply(weights, points(operator))


def adjoint(operator: CaptureOperator, images: torch.Tensor) -> torch.Tensor:
    """Return images correlated with point spreads, as `CaptureOperator.adjoint`; differentiable any number of times.

    Parameters
    ----------
    operator : CaptureOperator
        The points before a camera.
    images : Tensor (..., rows, columns)
        The images; with a spectrum (..., channels, rows, columns).

    Returns
    -------
    Tensor (..., n)
        Products with the spreads; with a spectrum (..., wavelengths, n).
    """
    return _Linear.apply(images, points(operator).T)


def capture(
    make: Callable[[PlenopticCamera], CaptureOperator],
    camera: PlenopticCamera,
    parameters: Mapping[str, torch.Tensor],
    weights: torch.Tensor,
) -> torch.Tensor:
    """Return captures of points by a camera, differentiable once with respect to given parameters and the weights.

    The derivatives are those of `CaptureOperator.gradient`: the points and the power through the pupil are fixed.

    Parameters
    ----------
    make : callable
        Returns the operator for a camera, such as ``lambda camera: CaptureOperator(camera, points, wavelength=633)``;
        a `StoredOperator` computes no spread again for the gradient by the weights.
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
    """
    values = map(_required, parameters.values())
    return _Smooth.apply(_latest(CameraCapture(make, camera, tuple(parameters))), _required(weights), *values)


def refocus(by: Refocus, captures: torch.Tensor) -> torch.Tensor:
    """Return refocused captures; differentiable any number of times with the ray model, once with other methods.

    For the reverse pass, a coherent refocus stores the fields, and a deconvolution the images of all steps, of every
    capture in a batch.

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
    """
    function = refocusing(by)
    if isinstance(function, LinearFunction):
        return _Linear.apply(captures, function)
    return _Smooth.apply(_latest(function), _required(captures))


def render(
    scene: Any, values: Mapping[str, torch.Tensor], *, integrator: Any = None, spp: int = 0, seed: int = 0
) -> torch.Tensor:
    """Return the image of a scene with given parameters, as ``mi.render`` does, with first derivatives by them.

    The scene keeps the given values; derivatives restore them first.

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
        Seed of the random numbers. Derivatives draw others.

    Returns
    -------
    Tensor (rows, columns, channels)
        The film's image, computed in single precision.
    """
    shapes = {name: tuple(_required(value).shape) for name, value in values.items()}
    function = Rendering(scene, shapes, integrator=integrator, spp=spp, seed=seed)
    remembering = Latest(function, torch.clone, torch.equal, _drjit)
    return _Smooth.apply(remembering, *(value.float() for value in values.values()))


class _Linear(torch.autograd.Function):
    """A linear map between arrays, with its transpose."""

    @staticmethod
    def forward(tensor: torch.Tensor, function: LinearFunction) -> torch.Tensor:
        return _tensor(function.straight(_array(tensor)), tensor)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
        _, ctx.function = inputs

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        return _Linear.apply(gradient, ctx.function.T), None

    @staticmethod
    def jvp(ctx: Any, change: torch.Tensor, _: None) -> torch.Tensor:
        return _Linear.apply(change, ctx.function)

    @staticmethod
    def vmap(
        _: Any, axes: tuple[int, None], tensor: torch.Tensor, function: LinearFunction
    ) -> tuple[torch.Tensor, int]:
        return _Linear.apply(tensor.movedim(axes[0], 0), function), 0


class _RowByRow(torch.autograd.Function):
    """Function for autograd that ``torch.vmap`` applies row by row."""

    @classmethod
    def vmap(cls, info: Any, axes: tuple[int | None, ...], *tensor: Any) -> Pair:
        pairs = list(zip(tensor, axes, strict=True))
        rows = [
            cls.apply(*(value if axis is None else value.select(axis, row) for value, axis in pairs))
            for row in range(info.batch_size)
        ]
        if isinstance(rows[0], torch.Tensor):
            return torch.stack(rows), 0
        return tuple(map(torch.stack, zip(*rows, strict=True))), (0,) * len(rows[0])


class _Smooth(_RowByRow):
    """A differentiable function of arrays; its derivatives are taken at the arrays of the forward pass."""

    @staticmethod
    def forward(function: Latest, *tensor: torch.Tensor) -> torch.Tensor:
        return _tensor(function.at(tensor).value, tensor[0])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: torch.Tensor) -> None:
        ctx.function, *tensors = inputs
        # PyTorch refuses derivatives at tensors that have been overwritten.
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        needed = ctx.needs_input_grad[1:]
        gradients = iter(_Gradients.apply(ctx.function, _where(needed), gradient, *ctx.saved_tensors))
        return None, *(next(gradients) if is_needed else None for is_needed in needed)

    @staticmethod
    def jvp(ctx: Any, _: None, *changes: torch.Tensor | None) -> torch.Tensor:
        nonzero = [change for change in changes if change is not None]
        which = _where([change is not None for change in changes])
        return _Change.apply(ctx.function, which, *nonzero, *ctx.saved_tensors)


class _Once(_RowByRow):
    """Derivative of a function that cannot be differentiated a second time."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: Any) -> None:
        """Save nothing for the backward pass."""

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise InputError(ONCE)

    @staticmethod
    def jvp(ctx: Any, *_: Any) -> Any:
        raise InputError(ONCE)


class _Change(_Once):
    """Change of a function's value for changes of some arrays."""

    @staticmethod
    def forward(function: Latest, which: frozenset[int], *tensors: torch.Tensor) -> torch.Tensor:
        changes = iter(tensors[: len(which)])
        tensor = tensors[len(which) :]
        taken = [function.taken(next(changes)) if k in which else None for k in range(len(tensor))]
        return _tensor(function.at(tensor).jvp(taken), tensor[0])


class _Gradients(_Once):
    """Gradients with respect to some of the arrays."""

    @staticmethod
    def forward(
        function: Latest, needed: frozenset[int], gradient: torch.Tensor, *tensor: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        gradients = function.at(tensor).vjp(function.taken(gradient), [k in needed for k in range(len(tensor))])
        return tuple(
            _tensor(gradient_of, like)
            for gradient_of, like in zip(gradients, tensor, strict=True)
            if gradient_of is not None
        )


def _where(which: Iterable[bool]) -> frozenset[int]:
    """Return the indices of true entries as a frozenset, which PyTorch's transforms do not inspect."""
    return frozenset(k for k, is_true in enumerate(which) if is_true)


def _latest(function: SmoothFunction) -> Latest:
    """Return a function that remembers its latest value."""
    return Latest(function, torch.clone, torch.equal, _array)


def _array(tensor: torch.Tensor) -> Array:
    """Return a tensor as a NumPy array: its own memory, or a copy on the processor."""
    on_host = _required(tensor).detach().cpu()
    # NumPy has no types for bfloat16 and for a quarter of the precision.
    floating = on_host if on_host.dtype in (torch.float32, torch.float64) else on_host.float()
    return working_array(floating.resolve_neg().numpy())


def _required(value: Any) -> torch.Tensor:
    """Return a floating-point tensor with values in memory; refuse whole numbers, which would round results."""
    refuse_if(not isinstance(value, torch.Tensor), f"{short_repr(value)}: it must be a tensor of PyTorch")
    refuse_if(
        not value.is_floating_point() or value.layout != torch.strided or value.is_meta,
        f"tensor of shape {tuple(value.shape)}, {value.dtype}, {value.layout}, device {value.device}: it must be a "
        "dense tensor of floating point with values",
    )
    return value


def _tensor(array: Any, like: torch.Tensor) -> torch.Tensor:
    """Return an array as a tensor of the type and device of another."""
    return (array.torch() if dr.is_tensor_v(array) else torch.from_numpy(np.asarray(array))).to(like)


def _drjit(tensor: torch.Tensor) -> Any:
    """Return a tensor as a Dr.Jit tensor, on a device by DLPack."""
    tensor = tensor.detach()
    return drjit_array(mi.TensorXf, tensor.numpy() if tensor.device.type == "cpu" else tensor.contiguous())
