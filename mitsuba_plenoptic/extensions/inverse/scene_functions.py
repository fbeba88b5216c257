"""The image of a scene as a differentiable function of some of its parameters, for the PyTorch and JAX modules."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import refuse_if, require_count, require_known, short_repr
from ...runtime import Sizes, drjit_array, one_at_a_time
from ...scene import MOST_SAMPLES


class Rendering:
    """Image of a scene as a function of some of its parameters, given as NumPy or Dr.Jit tensors.

    Parameters
    ----------
    scene : mitsuba.Scene
        The scene.
    shapes : mapping of str to tuple of int
        Parameters of the scene, by their names in ``mi.traverse``, and the shapes of their arrays.
    integrator : mitsuba.Integrator or None
        The integrator in place of the scene's.
    spp : int
        Samples per pixel; 0 means those of the sensor's sampler.
    seed : int
        Seed of the samples.
    """

    def __init__(self, scene: Any, shapes: Mapping[str, Sizes], *, integrator: Any, spp: int, seed: int):
        # Each variant has a class of its own.
        refuse_if(not hasattr(scene, "sensors"), f"scene = {short_repr(scene)}: it must be a scene of Mitsuba")
        self._scene, self._integrator, self.parameters = scene, integrator or scene.integrator(), mi.traverse(scene)
        self._spp = require_count("spp", spp, minimum=0, maximum=MOST_SAMPLES)
        self._seed = require_count("seed", seed, minimum=0, maximum=2**32 - 1)
        self._expected = dict[str, Sizes]()
        refuse_if(not scene.sensors(), "scene: it has no sensor")
        refuse_if(self._integrator is None, "integrator: the scene has none: give one")
        self.require_variant()
        require_known("values: ", shapes, list(self.parameters.keys()))
        refuse_if(not shapes, "values: give at least one parameter of the scene")
        for name, shape in shapes.items():
            kind = type(self.parameters[name])
            refuse_if(
                not dr.is_diff_v(kind) or not dr.is_float_v(kind),
                f"{name}: it is {kind.__name__}: give floating-point numbers, vectors, colours or textures of a "
                "variant with derivatives",
            )
            expected = self._expected[name] = np.shape(np.array(self.parameters[name]))
            # One number may have no axis.
            refuse_if(
                tuple(shape) != expected and not math.prod(shape) == math.prod(expected) == 1,
                f"{name} of shape {tuple(shape)}: it must be {expected}",
            )

    def at(self, *given: Any) -> RenderedValue:
        """Return the image of the scene with given parameter values."""
        return RenderedValue(self, given)

    def shape(self, _: Sizes) -> Sizes:
        """Return the shape of the image."""
        film = self._scene.sensors()[0].film()
        film.prepare(getattr(self._integrator, "child", self._integrator).aov_names())
        columns, rows = film.crop_size()
        return int(rows), int(columns), int(film.bitmap().channel_count())

    def require_variant(self) -> None:
        """Refuse an active variant that differs from the variant of the scene and the integrator."""
        for name, plugin in (("scene", self._scene), ("integrator", self._integrator)):
            own = plugin.variant_name()
            active = mi.variant()
            refuse_if(own != active, f"{name}: it is of the variant {own}, but {active} is active; set {own}")

    def typed(self, values: Sequence) -> list:
        """Return values converted to the Dr.Jit types of the scene's parameters."""
        made = []
        for (name, shape), value in zip(self._expected.items(), values, strict=True):
            kind = type(self.parameters[name])
            flat = _tensor(value).array
            made.append(kind(flat, shape) if dr.is_tensor_v(kind) else dr.unravel(kind, flat, order="C"))
        return made

    def put(self, typed: Sequence) -> None:
        """Write parameter values, already converted, into the scene."""
        for name, value in zip(self._expected, typed, strict=True):
            self.parameters[name] = value
        self.parameters.update()

    def image(self, typed: Sequence) -> Any:
        """Render the scene with values, which the scene keeps unless they are refused."""
        before = {name: type(self.parameters[name])(self.parameters[name]) for name in self._expected}
        try:
            self.put(typed)
            # As `mi.render`, which hides from its callers why an integrator refuses a scene.
            with dr.suspend_grad():
                made = self._integrator.render(self._scene, self._scene.sensors()[0], self._seed, self._spp)
                dr.eval(made)
        except Exception:
            self.put(list(before.values()))
            raise
        return made

    def forward(self) -> Any:
        """Return the change of the image for the changes that the scene's parameters carry."""
        return self._integrator.render_forward(self._scene, self.parameters, *self._with_other_seed())

    def backward(self, gradient: Any) -> None:
        """Propagate the gradient with respect to the image back to the scene's parameters."""
        self._integrator.render_backward(self._scene, self.parameters, gradient, *self._with_other_seed())

    def _with_other_seed(self) -> tuple[Any, int, int]:
        """Return the sensor, the seed with which `mi.render` renders derivatives, and the samples per pixel."""
        return self._scene.sensors()[0], mi.sample_tea_32(self._seed, 1)[0], self._spp


class RenderedValue:
    """Image of a scene at given parameter values, with derivatives with respect to these values.

    Derivatives render again; they first give the scene the values of this image, which may have been replaced since.
    """

    @one_at_a_time
    def __init__(self, rendering: Rendering, given: Sequence):
        self._rendering, self._typed = rendering, rendering.typed(given)
        self._shapes = [np.shape(each) for each in given]
        rendering.require_variant()
        self.value = rendering.image(self._typed)

    @one_at_a_time
    def jvp(self, changes: Sequence) -> Any:
        """Return the change of the image for changes of the parameter values; see `Value`."""
        kept = [np.zeros(shape) if each is None else each for each, shape in zip(changes, self._shapes, strict=True)]
        with self._attached([each is not None for each in changes]) as values:
            dr.set_grad(values, self._rendering.typed(kept))
            dr.enqueue(dr.ADMode.Forward, values)
            dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)
            change = self._rendering.forward()
            dr.eval(change)
        return dr.detach(change)

    @one_at_a_time
    def vjp(self, gradient: Any, needed: Sequence[bool]) -> list:
        """Return the gradient with respect to each value that needs it; see `Value`."""
        with self._attached(needed) as values:
            self._rendering.backward(_tensor(gradient))
            found = [dr.grad(each) for each in values]
        flat = [each.array if dr.is_tensor_v(each) else dr.ravel(each, order="C") for each in found]
        made = [mi.TensorXf(each, shape) for each, shape in zip(flat, self._shapes, strict=True)]
        return [each if one else None for each, one in zip(made, needed, strict=True)]

    @contextmanager
    def _attached(self, which: Sequence[bool]) -> Iterator[list]:
        """Put the values into the scene while the context is open, the chosen ones with gradients."""
        self._rendering.require_variant()
        values = [type(each)(each) for each in self._typed]
        dr.enable_grad([each for each, one in zip(values, which, strict=True) if one])
        self._rendering.put(values)
        try:
            yield values
        finally:
            self._rendering.put(self._typed)


def _tensor(array: Any) -> Any:
    """Return an array as a tensor of Dr.Jit."""
    if dr.is_tensor_v(array):
        return array
    return drjit_array(mi.TensorXf, np.asarray(array))
