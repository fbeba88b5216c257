"""Which numbers of a camera a fit varies, and what a camera of other numbers would record by waves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError, did_you_mean, shown
from ..operator.derivatives import NUMBERS, check_names, light_slopes, values_of
from ..operator.operator import CaptureOperator
from ..operator.units import brightness_at
from ..system.optical_system import OpticalSystem
from .light import View

_FARTHEST = 50.0
"""Units, of `scales`, by which numbers may change where no bounds are given."""


@dataclass(frozen=True)
class Number:
    """One of the numbers that are fitted.

    Attributes
    ----------
    name : str
        Of the camera's parameter.
    parts : tuple of int
        Which of its parts the number is; all of them are equal.
    """

    name: str
    parts: tuple[int, ...]

    @property
    def label(self) -> str:
        """What the number is called: the parameter, and which part it is, counted from 1, if there are others."""
        several = self.name in ("mla_offset", "wavefront") or (self.parts != (0,) and len(self.parts) == 1)
        return f"{self.name}.{self.parts[0] + 1}" if several else self.name


def numbers_of(camera: PlenopticCamera, names: Iterable[str] | str) -> list[Number]:
    """Return the numbers that parameters of a camera consist of, of aberrations all but the piston.

    Raises
    ------
    InputError
        If there is no parameter of some name, or a camera to which it means nothing.
    """
    given = (names,) if isinstance(names, str) else tuple(names)
    found: list[Number] = []
    for name in check_names(dict.fromkeys(given)):
        if name == "wavelength":
            raise InputError("wavelength: it is no number of a camera; give it, and fit the others")
        count = len(camera.wavefront) if name == "wavefront" else len(values_of(camera, 1.0, name))
        if name == "wavefront":
            if count < 2:
                raise InputError("wavefront: the camera has no coefficients to start from; give it some, zeros too")
            found += [Number(name, (part,)) for part in range(1, count)]
        elif name == "mla_pitch" and np.ndim(camera.to_dict()["mla_pitch"]) == 0:
            found.append(Number(name, tuple(range(count))))
        else:
            found += [Number(name, (part,)) for part in range(count)]
    if not found:
        raise InputError(f"names = {shown(given)}: name at least one of {', '.join(NUMBERS)}")
    return found


def values(camera: PlenopticCamera, numbers: list[Number]) -> NDArray[np.float64]:
    """Return the present values of numbers."""
    return np.array([values_of(camera, 1.0, number.name)[number.parts[0]] for number in numbers])


def scales(camera: PlenopticCamera, numbers: list[Number]) -> NDArray[np.float64]:
    """Return by how much each number changes for a change of one: a hundredth, a degree, a pitch, a wave."""
    fixed = {"mla_rotation": 1.0, "mla_offset": min(camera.mla_pitches), "wavefront": 1.0}
    given = zip(numbers, values(camera, numbers), strict=True)
    return np.array([fixed.get(number.name, abs(value) / 100) for number, value in given])


def limits_of(
    camera: PlenopticCamera, numbers: list[Number], bounds: Mapping[str, tuple[float, float]] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lowest and the highest values of numbers: not far from where a camera has them, unless given.

    Raises
    ------
    InputError
        If bounds are of a number that is not sought, in the wrong order, or the camera is outside them.
    """
    labels, start = [number.label for number in numbers], values(camera, numbers)
    unit = scales(camera, numbers)
    low, high = start - _FARTHEST * unit, start + _FARTHEST * unit
    high[[label == "mla_fill" for label in labels]] = 1.0
    for name, pair in (bounds or {}).items():
        if name not in labels:
            raise InputError(
                f"bounds: {shown(name)} is not fitted; there are {', '.join(labels)}{did_you_mean(name, labels)}"
            )
        if np.shape(pair) != (2,) or not pair[0] < pair[1]:
            raise InputError(f"bounds: {name} = {shown(pair)}: it must be the lowest and the highest value")
        low[labels.index(name)], high[labels.index(name)] = pair
    for label, value, least, most in zip(labels, start, low, high, strict=True):
        if not least <= value <= most:
            raise InputError(f"bounds: {label} starts at {value:g}: it must lie from {least:g} to {most:g}")
    return low, high


def changed(camera: PlenopticCamera, numbers: list[Number], x: NDArray[np.float64]) -> PlenopticCamera:
    """Return the camera with other values of its numbers."""
    new: dict[str, Any] = {}
    for number, value in zip(numbers, x.tolist(), strict=True):
        start = camera.wavefront if number.name == "wavefront" else values_of(camera, 1.0, number.name)
        parts = new.setdefault(number.name, np.array(start, np.float64))
        parts[list(number.parts)] = value
    for name, parts in new.items():
        one = len(parts) == 1 or (name == "mla_pitch" and np.ndim(camera.to_dict()[name]) == 0)
        new[name] = float(parts[0]) if one else tuple(parts.tolist())
    return camera.replace(**new)


class Model:
    """What a camera is expected to record of some views by waves.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    views : list of View
        The light.
    wavelength : float
        In nanometres.
    accuracy : float
        As of `CaptureOperator`.
    """

    def __init__(self, camera: PlenopticCamera, views: list[View], wavelength: float, accuracy: float) -> None:
        self._camera, self._views = camera, views
        self._system = OpticalSystem(camera.at_wavelength(wavelength), wavelength)
        self._weights = [brightness_at(self._system, view.points) * view.weights for view in views]
        self._operators = [
            CaptureOperator(
                camera,
                view.points,
                wavelength=wavelength,
                accuracy=accuracy,
                pupil_weights=view.pupil_weights,
                virtual=view.virtual,
                system=self._system,
            )
            for view in views
        ]

    def images(self) -> NDArray[np.float64]:
        """Return the expected pixels of all views, (views, rows, columns)."""
        pairs = zip(self._operators, self._weights, strict=True)
        return np.stack([operator.forward(weights) for operator, weights in pairs]).astype(np.float64)

    def derivatives(self, numbers: list[Number], images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of `images` by numbers, (numbers, views, rows, columns)."""
        names = {number.name for number in numbers}
        directions = []
        for number in numbers:
            change = np.zeros(len(values_of(self._camera, 1.0, number.name)))
            change[list(number.parts)] = 1
            directions.append({number.name: change})
        rows = []
        for view, operator, weights, image in zip(self._views, self._operators, self._weights, images, strict=True):
            slopes = light_slopes(self._system, names, view.points)
            growth = [change @ slopes[name] for direction in directions for name, change in direction.items()]
            grown = [
                # All the light together, or each point's by itself.
                each[0] * image if (each == each[0]).all() else operator.forward(each * weights)
                for each in growth
            ]
            rows.append(operator.jacobian(weights, directions) + np.stack(grown))
        return np.stack(rows, 1).astype(np.float64)
