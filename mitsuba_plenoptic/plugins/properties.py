"""Reading plugin parameters with the checks that Mitsuba leaves out."""

from __future__ import annotations

import json
from typing import Any

import mitsuba as mi

from ..camera import PlenopticCamera
from ..errors import InputError, require_choice, require_count, require_number
from ..io.lens_file import read_lens
from ..lens_data import LensData


def read_plain(props: Any, name: str, default: Any) -> Any:
    """Take a value from a plugin's properties, to be checked by whom it is for."""
    return _plain(props[name]) if name in props else default


def read_number(props: Any, plugin: str, name: str, default: float | None) -> float | None:
    """Take a positive, finite number from a plugin's properties.

    Mitsuba refuses misspelled names by itself, but it takes values of any type.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    if name not in props:
        return default
    return require_number(f"{plugin}: {name}", _plain(props[name]), positive=True, finite=name != "focus_distance")


def read_numbers(props: Any, plugin: str, name: str) -> tuple[float, ...] | None:
    """Take one or more finite numbers from a plugin's properties, or None if they are not given.

    They come as a number, as a point, vector or list, or as a string with commas between them.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    if name not in props:
        return None
    value = _plain(props[name])
    if isinstance(value, str):
        try:
            value = [float(part) for part in value.split(",")]
        except ValueError:
            raise InputError(
                f"{plugin}: {name} = {value!r}: it must be a number, or several with commas between them"
            ) from None
    elif not hasattr(value, "__len__"):
        value = [value]
    return tuple(require_number(f"{plugin}: {name}", _plain(number)) for number in value)


def read_count(props: Any, plugin: str, name: str, default: int, *, maximum: int | None = None) -> int:
    """Take a whole number of at least 1 from a plugin's properties.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    return require_count(f"{plugin}: {name}", props[name], maximum=maximum) if name in props else default


def read_choice(props: Any, plugin: str, name: str, choices: tuple[str, ...]) -> str:
    """Take one of several words from a plugin's properties; the first is the default.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    return require_choice(f"{plugin}: {name}", props[name] if name in props else choices[0], choices)


def _plain(value: Any) -> Any:
    """Turn a Dr.Jit array of one entry, as ``load_dict`` accepts it, into its entry."""
    return value[0] if hasattr(value, "__len__") and not isinstance(value, str) and len(value) == 1 else value


# Positive numbers that can be changed and differentiated through `mi.traverse`, in the order of the documentation;
# so can those of one value or several, `mla_rotation` and `mla_offset`.
POSITIVE = (
    "focal_length",
    "aperture_radius",
    "mla_distance",
    "mla_fill",
    "detector_distance",
    "detector_width",
)
SEVERAL = {"mla_focal_length": "mla_focal_lengths", "mla_pitch": "mla_pitches"}
NUMBERS = (*POSITIVE, *SEVERAL, "mla_rotation", "mla_offset")
WORDS = ("mla_lattice", "mla_aperture", "lens_model")
FIXED = ("mla_tilt", "distortion", "mla_jitter", "mla_seed", "pixel_response")


def read_camera(props: Any, plugin: str, film: Any) -> PlenopticCamera:
    """Return the camera of a plugin's properties.

    Parameters
    ----------
    props : mitsuba.Properties
        The properties.
    plugin : str
        The plugin's name, for messages.
    film : mitsuba.Film
        Its size and crop window are those of the detector.

    Raises
    ------
    InputError
        Naming plugin, parameter, value and rule.
    """
    given: dict[str, Any] = {
        **{name: read_number(props, plugin, name, None) for name in (*POSITIVE, "focus_distance")},
        **{name: read_plain(props, name, None) for name in WORDS},
        **{name: read_numbers(props, plugin, name) for name in SEVERAL},
        "mla_rotation": read_plain(props, "mla_rotation", None),
        "mla_offset": _flat(read_numbers(props, plugin, "mla_offset")),
        "mla_tilt": _flat(read_numbers(props, plugin, "mla_tilt")),
        "distortion": read_numbers(props, plugin, "distortion"),
        "wavefront": read_numbers(props, plugin, "wavefront"),
        "mla_jitter": _flat(read_numbers(props, plugin, "mla_jitter")),
        "mla_seed": read_plain(props, "mla_seed", None),
        "pixel_response": read_numbers(props, plugin, "pixel_response"),
    }
    try:
        given["main_lens"] = _read_main_lens(props, "main_lens")
        given["glass"] = _read_glass(props, "glass")
        given["mla_glass"] = _read_glass(props, "mla_glass")
        camera = PlenopticCamera(
            **{name: value for name, value in given.items() if value is not None},
            resolution=tuple(film.size()),
            crop_offset=tuple(film.crop_offset()),
            crop_size=tuple(film.crop_size()),
        )
    except InputError as error:
        raise InputError(f"{plugin}: {error}") from None
    if camera.lens_data.images_stop:
        raise InputError(
            f"{plugin}: main_lens: arrangement = fourier: no stop bounds its micro-images for rays; use "
            "CaptureOperator with method full_field"
        )
    return camera


def _read_main_lens(props: Any, name: str) -> LensData | None:
    """Take a main lens from a plugin's properties: a file, a bundled lens or the text of a JSON file."""
    source = read_plain(props, name, None)
    if source is None:
        return None
    if not isinstance(source, str):
        raise InputError(f"{name} = {source!r}: it must be text: a file or a bundled lens")
    return read_lens(source, lambda path: str(mi.file_resolver().resolve(path)))


def _read_glass(props: Any, name: str) -> Any:
    """Take a glass from a plugin's properties: a name, an index or the text of a JSON object."""
    source = read_plain(props, name, None)
    if not isinstance(source, str) or not source.lstrip().startswith("{"):
        return source
    try:
        return json.loads(source)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name}: it must be a JSON object: {error}") from None


def _flat(offset: tuple[float, ...] | None) -> tuple[float, ...] | None:
    """Drop the z of a point or vector, which must be 0."""
    if offset is not None and len(offset) == 3 and offset[2] == 0:
        return offset[:2]
    return offset
