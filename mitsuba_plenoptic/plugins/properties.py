"""Reading of plugin parameters with checks of their types, which Mitsuba lacks.

Messages state the plugin, the parameter, its value and the rule.
"""

import json
from typing import Any

import mitsuba as mi

from ..camera import FILE_READERS, PARAMETERS, Form, PlenopticCamera, Use, film_numbers, require_support
from ..errors import NO_RECORD, InputError, naming, refusing, require_count, require_number
from ..extension import missing
from ..scene import unknown_parameter


def read_plain(props: Any, name: str, default: Any) -> Any:
    """Return a value of a plugin's properties without any check, which is left to the caller."""
    return _plain(props[name]) if name in props else default


def read_count(props: Any, plugin: str, name: str, default: int, *, maximum: int | None) -> int:
    """Read an integer of at least 1 from a plugin's properties."""
    return require_count(f"{plugin}: {name}", props[name], maximum=maximum) if name in props else default


def require_read(props: Any, plugin: str) -> None:
    """Refuse a parameter that a plugin has not read, as no parameter has its name.

    Mitsuba also refuses it once the plugin is made, but without naming the most similar parameter.
    """
    for name in props.unqueried():
        if absent := missing("parameters", name):
            raise InputError(f"{plugin}: {absent}")
        raise InputError(unknown_parameter(plugin, name))


def _plain(value: Any) -> Any:
    """Return the only entry of an array, which ``load_dict`` accepts for a scalar; other values unchanged."""
    return value[0] if hasattr(value, "__len__") and not isinstance(value, str) and len(value) == 1 else value


def read_camera(props: Any, plugin: str, film: Any) -> tuple[PlenopticCamera, dict[str, Any]]:
    """Return the camera described by a plugin's properties and by its film, the detector, and what they state."""
    with naming(plugin):
        values = {
            name: _read_parameter(_plain(props[name]), name, entry.form)
            for name, entry in PARAMETERS.items()
            if name in props and entry.form is not Form.FILM
        }
        stated = values | film_numbers(film)
        camera = PlenopticCamera(**stated)
        require_support(camera, Use.RAYS)
    return camera, stated


def _read_parameter(value: Any, name: str, form: Form) -> Any:
    """Return a camera's parameter of a form that scene files may write differently from Python."""

    def resolved(path: str) -> str:
        return str(mi.file_resolver().resolve(path))

    is_text = isinstance(value, str)
    is_object = isinstance(value, str) and value.lstrip().startswith("{")
    if form in (Form.SEVERAL, Form.NUMBERS, Form.PLACE):
        if is_text:
            with refusing(f"{name} = {value!r}: it must be a number, or several with commas between them", ValueError):
                value = [float(item) for item in value.split(",")]
        elif not hasattr(value, "__len__"):
            value = [value]
        numbers = tuple(require_number(name, _plain(item)) for item in value)
        # Points and vectors have a z.
        return numbers[:2] if form is Form.PLACE and len(numbers) == 3 and numbers[2] == 0 else numbers
    if form in FILE_READERS:
        return FILE_READERS[form](value, resolved)
    if form is Form.GLASS and is_object:
        with refusing(f"{name}: it must be a JSON object:", *NO_RECORD):
            return json.loads(value)
    if form is Form.RESPONSE and is_text and not is_object:
        return resolved(value)
    return value
