"""Units of scenes: their scaling to millimetres, and a warning of lengths that are probably metres."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ..design import depth_ranges
from ..errors import InputError, advice, require_choice, warn

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
"""Millimetres in each unit of lengths of scenes."""

_SHAPES = frozenset(
    ("sphere", "rectangle", "disk", "cube", "cylinder", "obj", "ply", "serialized", "sdfgrid", "shapegroup", "instance")
)
_SENSORS = frozenset(("plenoptic", "perspective", "thinlens", "radiancemeter"))
_AT_POINTS = frozenset(("point", "spot", "projector"))
_EMITTERS = _AT_POINTS | {"area", "directionalarea", "directional", "constant", "envmap", "sunsky", "timed_sunsky"}
_MEDIA = frozenset(("homogeneous", "heterogeneous"))
_VOLUMES = frozenset(("gridvolume", "constvolume"))

_LENGTHS = {"near_clip": 1e-2, "far_clip": 1e4, "focus_distance": None, "aperture_radius": None}
"""Lengths of Mitsuba's cameras, with the defaults of those whose default is a length of the scene."""


def require_unit(unit: str) -> float:
    """Return the millimetres in a unit."""
    return UNITS[require_choice("unit", unit, UNITS)]


def scale_nodes(nodes: Any, factor: float) -> None:
    """Multiply the lengths of a parsed scene by a factor; refuse what would change its look, by name.

    Radiance stays, so that surfaces and skies look the same. Lamps at points send `factor` squared as much, and media
    are as many times thinner as paths through them get longer. A plenoptic camera is moved and keeps its own lengths,
    which are millimetres in every scene.
    """
    for node in nodes:
        properties, plugin = node.props, node.props.plugin_name()
        name = f"{plugin}{f' {node.props.id()!r}' if node.props.id() else ''}"
        for key in properties.keys():  # noqa: SIM118 (properties are no mapping)
            made = isinstance(properties[key], _made())
            _require(not made, name, f"{key}: an object that is already made cannot be scaled; give its dictionary")
        _SCALINGS.get(node.type, _nothing)(properties, plugin, name, factor)


def _require(holds: bool, name: str, rule: str) -> None:
    if not holds:
        raise InputError(f"unit: {name}: {rule}")


def _known(plugin: str, known: frozenset[str], name: str) -> None:
    rule = f"its lengths cannot be scaled, only those of {', '.join(sorted(known))}; scale the scene itself"
    _require(plugin in known, name, rule)


def _matrix(properties: Any) -> np.ndarray:
    return np.array(properties["to_world"].matrix, np.float64) if "to_world" in properties else np.eye(4)


def _scale(properties: Any, factor: float) -> None:
    """Scale an object together with its place."""
    properties["to_world"] = mi.ScalarTransform4f(np.diag([factor, factor, factor, 1]) @ _matrix(properties))


def _move(properties: Any, factor: float) -> None:
    """Scale the place of an object alone."""
    if "to_world" in properties:
        matrix = _matrix(properties)
        matrix[:3, 3] *= factor
        properties["to_world"] = mi.ScalarTransform4f(matrix)


def _nothing(*_: Any) -> None:
    pass


def _shape(properties: Any, plugin: str, name: str, factor: float) -> None:
    _known(plugin, _SHAPES, name)
    # The shapes of a group are scaled, so that an instance of them is only moved.
    if plugin == "instance":
        _move(properties, factor)
    elif plugin != "shapegroup":
        _scale(properties, factor)


def _sensor(properties: Any, plugin: str, name: str, factor: float) -> None:
    _known(plugin, _SENSORS, name)
    _move(properties, factor)
    for of_place in ("origin", "position"):
        if of_place in properties:
            properties[of_place] = [factor * value for value in properties[of_place]]
    if plugin in ("perspective", "thinlens"):
        for length, default in _LENGTHS.items():
            if length in properties or default is not None:
                properties[length] = factor * float(properties.get(length, default))


def _emitter(properties: Any, plugin: str, name: str, factor: float) -> None:
    _known(plugin, _EMITTERS, name)
    if plugin not in _AT_POINTS:
        return
    _move(properties, factor)
    if "position" in properties:
        properties["position"] = [factor * value for value in properties["position"]]
    power = "scale" if plugin == "projector" else "intensity"
    value: Any = properties.get(power, 1.0)
    if hasattr(value, "is_uniform"):
        values = [factor**2 * one for one in value.values]
        scaled = type(value)(values[0]) if value.is_uniform() else type(value)(value.wavelengths, values)
    else:
        numbers = isinstance(value, (int, float)) or hasattr(value, "__len__")
        _require(numbers, name, f"{power}: it must be given as numbers, so that it can be scaled")
        scaled = value * factor**2
    properties[power] = scaled


def _medium(properties: Any, plugin: str, name: str, factor: float) -> None:
    _known(plugin, _MEDIA, name)
    properties["scale"] = float(properties.get("scale", 1.0)) / factor


def _volume(properties: Any, plugin: str, name: str, factor: float) -> None:
    _known(plugin, _VOLUMES, name)
    if plugin == "gridvolume":
        _scale(properties, factor)


def _bsdf(properties: Any, plugin: str, name: str, factor: float) -> None:
    # Heights of bumps are lengths.
    if plugin == "bumpmap":
        properties["scale"] = float(properties.get("scale", 1.0)) * factor


def _made() -> tuple[type, ...]:
    """Return the classes of objects, in the active variant, that have lengths or may hold some that do."""
    return (mi.Shape, mi.Sensor, mi.Emitter, mi.Medium, mi.Volume, mi.BSDF, mi.Texture)


_SCALINGS = {
    mi.ObjectType.Shape: _shape,
    mi.ObjectType.Sensor: _sensor,
    mi.ObjectType.Emitter: _emitter,
    mi.ObjectType.Medium: _medium,
    mi.ObjectType.Volume: _volume,
    mi.ObjectType.BSDF: _bsdf,
}


_FAR_TOO_NEAR = 0.5
"""Distance over the nearest sharp one below which a scene is not just out of focus."""


def warn_of_metres(scene: Any, sensor: Any) -> None:
    """Warn if all of a scene is far too near to its plenoptic camera, as scenes in metres are.

    That is within the focal length, or nearer than half the nearest distance that refocusing makes sharp. Of other
    cameras nothing is known.
    """
    camera, box = getattr(sensor, "camera", None), scene.bbox()
    # An objective sees what is nearer than its focal length.
    if camera is None or not box.valid() or not camera.lens_data.converges:
        return
    to_camera = np.linalg.inv(np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4))
    corners = np.array([np.append(np.ravel(box.corner(index)), 1.0) for index in range(8)])
    farthest = float((corners @ to_camera[2]).max())
    if farthest <= 0:
        return
    sharp = min((found[0] for found in depth_ranges(camera) if found), default=0.0)
    if farthest < camera.focal_length:
        where = f"within the main lens's focal length of {camera.focal_length:.4g} mm"
    elif farthest < _FAR_TOO_NEAR * sharp:
        where = f"and refocusing makes nothing sharp that is nearer than {sharp:.4g} mm"
    else:
        return
    instead = advice(python='load_scene(..., unit="m") scales them', shell="--unit m scales them")
    warn(
        f"the whole scene is nearer than {farthest:.4g} mm, {where}: lengths are taken as millimetres; if the scene's "
        f"are metres, {instead}"
    )
