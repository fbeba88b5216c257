"""Putting another plenoptic camera into a scene file, in the place of the one that it has."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from ..camera import PlenopticCamera
from ..errors import InputError

_KEPT = {"to_world", "shutter_open", "shutter_close"}


def with_camera(text: str, camera: PlenopticCamera) -> str:
    """Return the text of a scene whose first plenoptic sensor is this camera, at the same place and as long open.

    The film keeps its pixel format; its size and crop window are the camera's.

    Raises
    ------
    InputError
        If there is no plenoptic sensor in the file itself.
    """
    root = ElementTree.fromstring(text)
    sensor = next((node for node in root.iter("sensor") if node.get("type") == "plenoptic"), None)
    if sensor is None:
        raise InputError("scene: it has no sensor of type 'plenoptic' of its own that a camera could replace")
    for node in list(sensor):
        if node.get("name") is not None and node.get("name") not in _KEPT:
            sensor.remove(node)
    description = camera.to_sensor()
    film: dict[str, Any] = description.pop("film")
    for name, value in description.items():
        if name != "type":
            _put(sensor, name, value)
    place = sensor.find("film")
    if place is None:
        place = ElementTree.SubElement(sensor, "film", type="hdrfilm")
        for name in ("pixel_format", "component_format"):
            _put(place, name, film[name])
    if place.find("rfilter") is None:
        ElementTree.SubElement(place, "rfilter", type="box")
    sizes = {name: value for name, value in film.items() if isinstance(value, int)}
    for node in list(place):
        if node.get("name") in sizes:
            place.remove(node)
    for name, value in sizes.items():
        _put(place, name, value)
    return ElementTree.tostring(root, encoding="unicode")


def _put(node: ElementTree.Element, name: str, value: Any) -> None:
    tag = {int: "integer", float: "float"}.get(type(value), "string")
    ElementTree.SubElement(node, tag, name=name, value=str(value) if tag != "float" else repr(value))
