"""Which parameters of a scene carry gradients, and those of the camera's numbers, for captures by waves."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..capture.derivatives import NUMBERS, values_of
from ..errors import InputError


def numbers_and_others(params: Any, sensor: Any) -> tuple[tuple[str, ...], bool]:
    """Return which numbers of the camera carry gradients, and whether parameters of the scene do.

    Parameters
    ----------
    params : mitsuba.SceneParameters, or None
        As `mi.render` has been given them.
    sensor : mitsuba.Sensor
        The camera.

    Raises
    ------
    InputError
        If there is one by which captures have no derivative.
    """
    names, others = [], False
    for key, (_, _, node, _) in {} if params is None else params.properties.items():
        if not dr.grad_enabled(params[key]):
            continue
        name = key.rsplit(".", 1)[-1]
        if isinstance(node, mi.Shape) or name == "to_world":
            raise InputError(f"plenoptic_wave: {key}: it has no gradient: places of shapes and cameras are held")
        if isinstance(node, (mi.Sensor, mi.Film)):
            if name not in NUMBERS:
                raise InputError(f"plenoptic_wave: {key}: captures by waves have no derivative by it")
            if node is sensor:
                names.append(name)
        else:
            others = True
    return tuple(names), others


def tangent(sensor: Any, name: str) -> NDArray[np.float64]:
    """Return in which direction a number of the camera changes, as `derivatives.values_of` has its parts."""
    given = np.ravel(np.array(dr.grad(getattr(sensor, name)), np.float64))
    size = _parts(sensor, name)
    return np.repeat(given, 2) if name == "mla_pitch" and given.size == 1 else np.pad(given, (0, size - given.size))


def accumulate(sensor: Any, name: str, gradient: NDArray[np.float64]) -> None:
    """Add to the gradient of a number of the camera."""
    value = getattr(sensor, name)
    if name == "mla_pitch" and dr.width(value) == 1:
        gradient = gradient.sum(keepdims=True)
    if name == "wavefront":
        gradient = gradient[: dr.width(value)]
    dr.accum_grad(value, type(value)(gradient.tolist()))


def _parts(sensor: Any, name: str) -> int:
    """Return of how many parts `derivatives.values_of` takes a number to be."""
    return values_of(sensor.camera, 1.0, name).size
