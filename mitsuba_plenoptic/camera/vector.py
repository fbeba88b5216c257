"""Conversion of camera parameters to a vector and back, for fits, calibrations, gradients and searches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError, did_you_mean, refuse_if, short_repr
from ..runtime import Doubles, Pair, Sizes
from .entry import Captures, Form
from .parameters import PARAMETERS
from .plenoptic_camera import PlenopticCamera

Values = dict[str, Doubles]
"""Numbers by parameter: one for each of its parts."""

_FARTHEST = 50.0
"""Steps, of `CameraVector.scales`, by which numbers may change where no bounds are given."""


def with_gradient(kind: Captures) -> tuple[str, ...]:
    """Return the names of the parameters with respect to which captures of a kind have derivatives."""
    return tuple(name for name, entry in PARAMETERS.items() if kind in entry.gradients)


def part_units(name: str) -> dict[str, str]:
    """Return the unit of each component of a parameter, by the component's name in calibrations."""
    entry = PARAMETERS[name]
    parts = entry.parts or (name,)
    return dict(zip(parts, [entry.unit] * len(parts) if isinstance(entry.unit, str) else entry.unit, strict=True))


def parts_of(camera: PlenopticCamera, name: str) -> Doubles:
    """Return the current components of a parameter: both pitches, each focal length, each coefficient; none without."""
    value = getattr(camera, PARAMETERS[name].attribute)
    return np.array([] if value is None else np.ravel(value), np.float64)


def shortest_parts(camera: PlenopticCamera, name: str) -> Doubles:
    """Return the components of a parameter in its shortest form: one pitch if both are equal."""
    entry = PARAMETERS[name]
    return np.array(np.ravel(entry.plain(getattr(camera, entry.attribute))), np.float64)


def change_of(camera: PlenopticCamera, name: str, change: Any) -> Doubles:
    """Return the change of all differentiable components of a parameter; a single value applies to all of them.

    Coefficients beyond those given do not change.
    """
    numbers = np.ravel(change)
    form = PARAMETERS[name].form
    size = size_of(camera, name)
    if form is Form.NUMBERS and len(numbers) < size:
        return np.pad(numbers, (0, size - len(numbers)))
    return np.repeat(numbers, size) if form is Form.SEVERAL and len(numbers) == 1 else numbers


def size_of(camera: PlenopticCamera, name: str) -> int:
    """Return the number of a parameter's differentiable components."""
    return max(len(parts_of(camera, name)), PARAMETERS[name].room)


def with_parts(camera: PlenopticCamera, parts: Mapping[str, Doubles], **others: Any) -> PlenopticCamera:
    """Return the camera with parameters set from arrays of their components, and `others` from values."""
    for name, numbers in parts.items():
        others[name] = (
            float(numbers[0]) if PARAMETERS[name].form in (Form.NUMBER, Form.STRAY) else tuple(numbers.tolist())
        )
    # Derivatives by the focal length are those of a fixed aperture.
    if "focal_length" in parts:
        others.setdefault("aperture_radius", camera.aperture_radius)
    return camera.replace(**others)


@dataclass(frozen=True)
class Component:
    """Entry of a vector: one or several equal components of a parameter, with a label for results."""

    name: str
    parts: Sizes
    label: str


@dataclass(frozen=True)
class CameraVector:
    """A vector of parameters of a camera; `of` returns the same `components` with the values of another camera."""

    camera: PlenopticCamera
    components: tuple[Component, ...]

    @classmethod
    def by_names(cls, camera: PlenopticCamera, names: Iterable[str]) -> CameraVector:
        """Return the vector of the named parameters of a camera; refuse coefficients that the camera does not have.

        The piston of aberrations is left out.
        """
        components = []
        for name in names:
            count = len(parts_of(camera, name))
            entry = PARAMETERS[name]
            if entry.form is Form.SEVERAL and len(shortest_parts(camera, name)) == 1:
                components.append(Component(name, tuple(range(count)), name))
                continue
            rule = "the camera has no coefficients to start from; give it some, zeros too"
            refuse_if(count <= entry.unseen, f"{name}: {rule}")
            labels = [f"{name}.{index + 1}" for index in range(count)] if count > 1 else [name]
            components += [Component(name, (index,), labels[index]) for index in range(entry.unseen, count)]
        return cls(camera, tuple(components))

    def of(self, camera: PlenopticCamera) -> CameraVector:
        """Return the vector of the same components for another camera."""
        return replace(self, camera=camera)

    def keep(self, labels: Iterable[str]) -> CameraVector:
        """Return the components with the given labels, in their order in this vector."""
        chosen = set(labels)
        return replace(self, components=tuple(component for component in self.components if component.label in chosen))

    @property
    def labels(self) -> list[str]:
        """Names of the components: the parameter and, if it has several components, the index from 1."""
        return [component.label for component in self.components]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, without repetitions."""
        return tuple(dict.fromkeys(component.name for component in self.components))

    @property
    def values(self) -> Doubles:
        """Values of the components, in the units of the parameters."""
        return np.array([parts_of(self.camera, component.name)[component.parts[0]] for component in self.components])

    @property
    def scales(self) -> Doubles:
        """Steps of a fit, one for each component: a hundredth of its value, a degree, a pitch, or a wave."""
        scales = (PARAMETERS[component.name].scale for component in self.components)
        pairs = zip(scales, self.values, strict=True)
        return np.array([scale(self.camera) if scale else abs(value) / 100 for scale, value in pairs])

    def limits(self, bounds: Mapping[str, Pair] | None) -> Pair:
        """Return the lowest and highest value of each component: `bounds`, or a range around the present values.

        Bounds of other parameters, in the wrong order, or that exclude the camera are refused.
        """
        labels = self.labels
        start = self.values
        low = start - _FARTHEST * self.scales
        high = start + _FARTHEST * self.scales
        for index, component in enumerate(self.components):
            highest = PARAMETERS[component.name].highest
            high[index] = high[index] if highest is None else highest
        for name, pair in (bounds or {}).items():
            where = [
                index for index, component in enumerate(self.components) if name in (component.label, component.name)
            ]
            if not where:
                raise InputError(
                    f"bounds: {short_repr(name)} is not fitted; there are {', '.join(labels)}"
                    f"{did_you_mean(name, labels)}"
                )
            refuse_if(
                np.shape(pair) != (2,) or not pair[0] < pair[1],
                f"bounds: {name} = {short_repr(pair)}: it must be the lowest and the highest value",
            )
            low[where], high[where] = pair
        for label, value, least, most in zip(labels, start, low, high, strict=True):
            refuse_if(
                not least <= value <= most,
                f"bounds: {label} starts at {value:g}: it must lie from {least:g} to {most:g}",
            )
        return low, high

    def at(self, values: Doubles) -> PlenopticCamera:
        """Return the camera with other values of the components."""
        parts: Values = {}
        for component, value in zip(self.components, values.tolist(), strict=True):
            parts.setdefault(component.name, parts_of(self.camera, component.name))[list(component.parts)] = value
        return with_parts(self.camera, parts)

    def directions(self) -> list[Values]:
        """Return the change of the parameters for a unit change of each component."""
        changes = []
        for component in self.components:
            change = np.zeros(size_of(self.camera, component.name))
            change[list(component.parts)] = 1
            changes.append({component.name: change})
        return changes

    def slopes(self, gradient: Mapping[str, Doubles]) -> Doubles:
        """Return the derivatives with respect to this vector, from derivatives by all components of the parameters."""
        return np.array([gradient[component.name][list(component.parts)].sum() for component in self.components])
