"""Reading of plugin parameters, with checks of their types, which Mitsuba does not make.

Messages state the plugin, the parameter, its value and the rule.
"""

from __future__ import annotations

import json
from typing import Any

import mitsuba as mi

from ..camera import PlenopticCamera
from ..camera.entry import Form
from ..camera.parameters import PARAMETERS
from ..errors import InputError, refuse_if, require_choice, require_count, require_number
from ..io.lens_file import read_lens
from ..lens_data import LensData


def read_plain(props: Any, name: str, default: Any) -> Any:
    """Read a value from a plugin's properties without a check; the caller checks it."""
    return _plain(props[name]) if name in props else default


def read_number(props: Any, plugin: str, name: str, default: float | None) -> float | None:
    """Read a positive, finite value from a plugin's properties."""
    if name not in props:
        return default
    return require_number(f"{plugin}: {name}", _plain(props[name]), positive=True)


def read_count(props: Any, plugin: str, name: str, default: int, *, maximum: int | None = None) -> int:
    """Read an integer of at least 1 from a plugin's properties."""
    return require_count(f"{plugin}: {name}", props[name], maximum=maximum) if name in props else default


def read_choice(props: Any, plugin: str, name: str, choices: tuple[str, ...]) -> str:
    """Read one of several words from a plugin's properties; the first is the default."""
    return require_choice(f"{plugin}: {name}", props[name] if name in props else choices[0], choices)


def _plain(value: Any) -> Any:
    """Return the entry of an array of one entry, which ``load_dict`` accepts for a scalar, or any other value as is."""
    return value[0] if hasattr(value, "__len__") and not isinstance(value, str) and len(value) == 1 else value


def read_camera(props: Any, plugin: str, film: Any) -> PlenopticCamera:
    """Return the camera of a plugin's properties and its film, which is the detector."""
    try:
        given = {
            name: _READERS.get(entry.form, _read_one)(props, name)
            for name, entry in PARAMETERS.items()
            if name in props and entry.form is not Form.FILM
        }
        camera = PlenopticCamera(**given, **film_numbers(film))
    except InputError as error:
        raise InputError(f"{plugin}: {error}") from None
    refuse_if(
        camera.lens_data.images_stop,
        f"{plugin}: main_lens: arrangement = fourier: no stop bounds its micro-images for rays; use "
        "CaptureOperator with method full_field",
    )
    return camera


def film_numbers(film: Any) -> dict[str, Any]:
    """Return the camera parameters that the film determines."""
    return {
        "resolution": tuple(film.size()),
        "crop_offset": tuple(film.crop_offset()),
        "crop_size": tuple(film.crop_size()),
    }


def _read_one(props: Any, name: str) -> Any:
    """Read a value that the camera will check."""
    return _plain(props[name])


def _read_numbers(props: Any, name: str) -> tuple[float, ...]:
    """Read one or several values, given as a scalar, a point, vector or list, or as text separated by commas."""
    value = _plain(props[name])
    if isinstance(value, str):
        try:
            value = [float(part) for part in value.split(",")]
        except ValueError:
            raise InputError(f"{name} = {value!r}: it must be a number, or several with commas between them") from None
    elif not hasattr(value, "__len__"):
        value = [value]
    return tuple(require_number(name, _plain(number)) for number in value)


def _read_position(props: Any, name: str) -> tuple[float, ...]:
    """Read the x and y of a position, given as a pair or as a point or vector whose z is 0."""
    position = _read_numbers(props, name)
    return position[:2] if len(position) == 3 and position[2] == 0 else position


def _read_main_lens(props: Any, name: str) -> LensData:
    """Read a main lens, given as a file, a bundled lens or the text of a JSON file."""
    source = _plain(props[name])
    if not isinstance(source, str):
        raise InputError(f"{name} = {source!r}: it must be text: a file or a bundled lens")
    return read_lens(source, lambda path: str(mi.file_resolver().resolve(path)))


def _read_glass(props: Any, name: str) -> Any:
    """Read a glass, given as a name, a refractive index or the text of a JSON object."""
    source = _plain(props[name])
    if not isinstance(source, str) or not source.lstrip().startswith("{"):
        return source
    try:
        return json.loads(source)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name}: it must be a JSON object: {error}") from None


_READERS = {
    Form.SEVERAL: _read_numbers,
    Form.NUMBERS: _read_numbers,
    Form.PLACE: _read_position,
    Form.LENS: _read_main_lens,
    Form.GLASS: _read_glass,
}
"""Readers for the forms of parameters that scene files write differently from Python."""
