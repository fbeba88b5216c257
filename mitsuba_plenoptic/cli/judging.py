"""Checks of options that refuse wrong values before the library is imported, which takes ten times as long."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import (
    SCENE_XML,
    InputError,
    content_of,
    did_you_mean,
    refuse_if,
    refusing,
    require_choice,
    require_count,
    require_suffix,
    require_wavelength,
    short_repr,
)
from ..extension import entries, missing
from ..presets import PRESETS
from ..refocus_options import METHODS
from ..scene_files import scene_names, scene_path


@dataclass(frozen=True)
class Judged:
    """Metadata of a type annotation: a function that refuses wrong values of the option."""

    judge: Callable[[str, Any], object]


def judging(function: Callable[..., None]) -> Callable[..., None]:
    """Return a command that checks its option values when it is called."""
    parameters = inspect.signature(function, eval_str=True).parameters
    judges = []
    for name, parameter in parameters.items():
        notes = getattr(parameter.annotation, "__metadata__", ())
        # Some options have another name than the argument, such as --format: what Typer holds for the default first.
        spelt = [word for one in notes if (word := str(getattr(one, "default", ""))).startswith("--")]
        shown = spelt[0].strip("-").replace("-", "_") if spelt else name
        judges += [(name, shown, one.judge) for one in notes if isinstance(one, Judged)]

    @functools.wraps(function)
    def command(**options: Any) -> None:
        for name, shown, judge in judges:
            value = options[name]
            for one in value if isinstance(value, list) else [value]:
                if one is not None:
                    judge(shown, one)
        function(**options)

    return command


def one_of(choices: Collection[str]) -> Judged:
    """Return the metadata of an option whose value is one of some words."""
    return Judged(lambda name, value: require_choice(name, value, choices))


def ends_in(*suffixes: str) -> Judged:
    """Return the metadata of an option that names a file to be written, which must end in one of the suffixes."""
    return Judged(lambda _, path: None if path.is_dir() else require_suffix(path, suffixes))


def _require_wavelengths(name: str, text: str) -> None:
    wrong = f"{name} = {short_repr(text)}: it must be nanometres, or three of them separated by commas"
    with refusing(wrong, ValueError):
        parts = [float(part) for part in text.split(",")]
    for part in parts:
        require_wavelength(part, name)


def _require_file(name: str, path: Path) -> None:
    refuse_if(not path.exists(), f"{path}: there is no such file")


def _require_recording(name: str, path: Path) -> None:
    scene = content_of(path) == SCENE_XML if path.exists() else str(path) in scene_names()
    refuse_if(scene, f"{path}: it is a scene: give what 'render' made of it")
    _require_file(name, path)


def require_camera_name(name: str, source: str) -> None:
    """Refuse a text that names no camera, that is, no preset, parameters, file or scene."""
    names = scene_names()
    if "=" not in source and not Path(source).exists() and source not in (*PRESETS, *names):
        absent = missing("presets", source)
        raise InputError(
            absent
            or f"{source}: there is no such file, and no camera ({', '.join(PRESETS)}) or built-in scene "
            f"({', '.join(names)}) of that name{did_you_mean(source, [*PRESETS, *names])}"
        )


COUNTED, WAVELENGTH = Judged(require_count), Judged(lambda name, value: require_wavelength(value, name))
WAVELENGTHS = Judged(_require_wavelengths)
SCENE = Judged(lambda _, scene: Path(scene).is_file() or scene_path(scene))
METHOD = Judged(
    lambda name, value: require_choice(
        name, value, tuple(dict.fromkeys((*METHODS, *(key for _, key, _ in entries("methods")))))
    )
)
CAMERA = Judged(require_camera_name)
FILE, RECORDING = Judged(_require_file), Judged(_require_recording)
