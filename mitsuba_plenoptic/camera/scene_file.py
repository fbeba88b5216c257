"""A camera as a sensor for Mitsuba: a dictionary, and the text of a scene file."""

from __future__ import annotations

import json
from typing import Any
from xml.etree import ElementTree


def describe(parameters: dict[str, Any], to_world: Any) -> dict[str, Any]:
    """Return the sensor for ``mi.load_dict`` of a camera's parameters by name; see `PlenopticCamera.to_sensor`."""
    values = dict(parameters)
    columns, rows = values.pop("resolution")
    (left, top), (width, height) = values.pop("crop_offset"), values.pop("crop_size")
    sensor = {"type": "plenoptic"} | {name: _plain(value) for name, value in values.items() if value != ()}
    if to_world is not None:
        sensor["to_world"] = to_world
    crop = {"crop_offset_x": left, "crop_offset_y": top, "crop_width": width, "crop_height": height}
    is_cropped = (width, height) != (columns, rows)
    sensor["film"] = {
        "type": "hdrfilm",
        "width": columns,
        "height": rows,
        # Of a full film a crop would remain where its size is changed later.
        **(crop if is_cropped else {}),
        "rfilter": {"type": "box"},
        "pixel_format": "luminance",
        "component_format": "float32",
    }
    return sensor


def _plain(value: Any) -> Any:
    """Return a parameter in the form for a plugin: lenses and glasses as JSON, several values separated by commas."""
    if isinstance(value, dict):
        return json.dumps(value)
    return ", ".join(map(repr, value)) if isinstance(value, tuple) else value


def write_xml(sensor: dict[str, Any]) -> str:
    """Write a sensor from `describe` as text for a scene file."""

    def element(tag: str, values: dict[str, Any], **attributes: str) -> ElementTree.Element:
        made = ElementTree.Element(tag, {"type": values["type"], **attributes})
        for name, value in values.items():
            if isinstance(value, dict):
                made.append(element(name, value))
            elif name != "type":
                kind = {int: "integer", float: "float", str: "string"}[type(value)]
                ElementTree.SubElement(made, kind, name=name, value=str(value))
        return made

    tree = element("sensor", sensor, id="camera")
    ElementTree.indent(tree, "    ")
    return ElementTree.tostring(tree, encoding="unicode") + "\n"
