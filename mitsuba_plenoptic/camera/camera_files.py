"""Cameras named by ``--camera`` of a command: presets, files of parameters, and parameters as text."""

import contextlib
import json
import re
from pathlib import Path
from typing import Any

from ..errors import NO_RECORD, InputError, content_of, naming, refuse_if, refusing, short_repr
from ..extension import hook
from ..presets import PRESETS
from ..runtime import Named, parse_yaml, read_text, read_yaml, require_size
from .entry import Form
from .parameters import FILE_READERS, PARAMETERS
from .plenoptic_camera import PlenopticCamera

_LARGEST_FILE = 2**24


def camera_and_record(source: str | Path) -> tuple[PlenopticCamera, Any]:
    """Return a camera, and the object ``calibration`` of its file (None if there is none)."""
    stated, record = stated_and_record(source)
    with naming(Path(source)):
        return PlenopticCamera._from_names(stated), record


def stated_and_record(source: str | Path) -> tuple[Named, Any]:
    """Return what a source states of a camera, by name, and its file's object ``calibration`` (None without one)."""
    if str(source) in PRESETS and not Path(source).is_file():
        return dict(PRESETS[str(source)]), None
    path = Path(source)
    if states_camera(source):
        text = json.dumps(_stated(str(source)))
    elif not (content := content_of(require_size(path, _LARGEST_FILE))).startswith("text"):
        raise InputError(f"{path}: it is {content}; a camera's file has its parameters by name, in JSON or YAML")
    elif path.suffix.lower() in (".yaml", ".yml"):
        with refusing(f"{path}: it must be camera parameters by name:", *NO_RECORD):
            text = json.dumps(read_yaml(path))
    else:
        text = read_text(path, _LARGEST_FILE)
    with refusing(f"{path}: it is no JSON file:", *NO_RECORD):
        values = json.loads(text)
    # Names in each configuration of libpleno.
    if isinstance(values, dict) and set(values) >= {"mla", "main_lens", "sensor"}:
        read = hook("libpleno", str(path))
        with naming(path):
            return read(values).to_dict(), None
    refuse_if(
        not isinstance(values, dict), f"{path}: camera = {short_repr(values)}: it must be camera parameters by name"
    )
    if states_camera(source):
        return values, None
    record = values.pop("calibration", None)
    with naming(path):
        return _with_files(values, path.parent), record


def _with_files(values: Named, folder: Path) -> Named:
    """Return the parameters of a camera's file, with files that they name read from its folder if they lie there."""

    def resolve(name: str) -> str:
        # Not all text can be the name of a file.
        with contextlib.suppress(OSError, ValueError):
            if (beside := folder / name).is_file():
                return str(beside)
        return name

    read = dict(values)
    for name, value in values.items():
        form = PARAMETERS[name].form if name in PARAMETERS else None
        if form in FILE_READERS and isinstance(value, str):
            read[name] = FILE_READERS[form](value, resolve)
        elif form is Form.RESPONSE and isinstance(value, str):
            read[name] = resolve(value)
    return read


def states_camera(source: str | Path) -> bool:
    """Return whether a text states camera parameters, such as ``mla_pitch=0.1``, and is not the name of a file."""
    return re.match(r"\w+=", str(source)) is not None and not Path(source).is_file()


def _stated(text: str) -> Named:
    """Return the parameters of a text ``NAME=VALUE,NAME=VALUE``.

    Values may be lists in brackets or parentheses, or several with commas between.
    """
    values = {}
    for name, value in re.findall(r"(\w+)\s*=((?:[^=]*?)(?=,\s*\w+\s*=|$))", text):
        refuse_if(name in values, f"{name} is given twice")
        value = re.sub(r"^\s*\((.*)\)\s*$", r"[\1]", value)
        bracketed = value.lstrip().startswith("[")
        parts = [parse_yaml(item) for item in ([value] if bracketed else value.split(","))]
        refuse_if(None in parts, f"{name} = {value}: it must be a value, or several with commas between them")
        values[name] = parts[0] if len(parts) == 1 else parts
    return values
