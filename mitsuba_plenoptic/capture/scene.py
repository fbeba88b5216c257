"""Loading scenes: files, and those that come with the package."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..camera import PlenopticCamera
from ..errors import InputError, did_you_mean, shown, suggest_keywords
from ..io.files import require_file
from ..runtime.backend import one_at_a_time
from ..runtime.variant import set_variant
from .scene_file import check_scene_file

KNOWN_PARAMETERS = {
    "plenoptic": (*inspect.signature(PlenopticCamera).parameters, "to_world"),
    "plenoptic_wave": (
        *("wavelength", "bandwidth", "responses", "wavelength_count", "nodes"),
        *("method", "accuracy"),
    ),
}
"""Parameters of this package's plugins, for the suggestions of messages; it is Mitsuba that finds the unknown ones."""


def scene_names() -> list[str]:
    """Return the names of the scenes that come with the package."""
    return sorted(path.stem for path in _folder().glob("*.xml"))


def _folder() -> Path:
    """Folder of the built-in scenes: in the installed package, or at the top of a clone, where users edit them."""
    installed = Path(__file__).parents[1] / "scenes"
    return installed if installed.is_dir() else installed.parents[1] / "scenes"


def scene_path(name: str) -> Path:
    """Path of a scene that comes with the package, by its name without suffix.

    Parameters
    ----------
    name : str
        Such as ``letters``.

    Raises
    ------
    InputError
        If there is none of that name; the message lists those there are.
    """
    path = _folder() / f"{name}.xml"
    if path.name != f"{name}.xml" or not path.is_file():
        names = scene_names()
        raise InputError(
            f"scene = {name!r}: there is no such file, nor a built-in scene of that name ({', '.join(names)})"
            f"{did_you_mean(name, names)}"
        )
    return path


@suggest_keywords
@one_at_a_time
def load_scene(
    scene: str | Path | Mapping[str, Any], *, variant: str | None = None, parameters: Mapping[str, str] | None = None
) -> Any:
    """Load a scene file, a built-in scene by its name, or a dictionary as ``mi.load_dict`` takes it.

    Parameters
    ----------
    scene : str, path or dict
        An XML file, a built-in name such as ``letters``, or a scene's dictionary, which is taken as it is: its
        transforms and objects must be of the variant that is active or given.
    variant : str, optional
        Mitsuba variant to set. Default: the active one, or ``llvm_ad_mono`` if none is.
    parameters : mapping, optional
        Values for the ``$name`` parameters of a scene file. Where a scene has the columns and rows of its detector as
        ``$resolution`` and ``$rows``, rows that are not given follow the columns in proportion.

    Returns
    -------
    mitsuba.Scene

    Raises
    ------
    InputError
        If there is no such scene or variant, it does what `scene_file` forbids, or Mitsuba
        refuses the scene: one line with the place in the file.
    """
    if isinstance(scene, Mapping):
        return _load_dictionary(scene, variant, parameters)
    if parameters is not None and not isinstance(parameters, Mapping):
        raise InputError(f"parameters = {shown(parameters)}: they must be values by name")
    path = _find(scene)
    set_variant(variant)
    parameters = {str(name): str(value) for name, value in (parameters or {}).items()}
    text = check_scene_file(path, parameters)
    for name in parameters:
        # Mitsuba takes a misspelled name in silence.
        if f"${name}" not in text:
            known = sorted(set(re.findall(r"<default\s+name=\"(\w+)\"", text)))
            names = f"none of that name ({', '.join(known)})" if known else "no parameters"
            raise InputError(f"parameter {name}: the scene {path} has {names}{did_you_mean(name, known)}")
    parameters = _with_rows(text, parameters)
    try:
        # Mitsuba's optimisation lists merged shapes and emitters in an order that changes from run to run, and with
        # it the random numbers that each gets.
        loaded = mi.load_file(str(path), optimize=False, **parameters)
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError) as error:
        place = re.search(r"\b(line \d+(?:, col(?:umn)? \d+)?)", str(error))
        raise InputError(f"{path}{f', {place.group(1)}' if place else ''}: {mitsuba_sentence(error)}") from None
    # The name that captures carry in their metadata.
    loaded.set_id(path.name)
    return loaded


def _load_dictionary(scene: Mapping[str, Any], variant: str | None, parameters: Mapping[str, str] | None) -> Any:
    if parameters:
        raise InputError(f"parameters = {shown(dict(parameters))}: a dictionary has none; put the values into it")
    if scene.get("type") != "scene":
        raise InputError(f"scene: its 'type' is {shown(scene.get('type'))}: it must be 'scene'")
    set_variant(variant)
    try:
        # Not optimized, for the same reason as a file's.
        loaded = mi.load_dict(dict(scene), optimize=False)
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(f"scene: {mitsuba_sentence(error)}") from None
    loaded.set_id("dictionary")
    return loaded


def _with_rows(text: str, parameters: dict[str, str]) -> dict[str, str]:
    """Add the rows that keep the detector's aspect; Mitsuba's XML cannot compute them."""
    columns, rows = (re.search(rf'<default name="{name}" value="(\d+)"', text) for name in ("resolution", "rows"))
    wanted = parameters.get("resolution", "")
    if not columns or not rows or "rows" in parameters or not re.fullmatch(r"\d{1,9}", wanted):
        return parameters
    return {**parameters, "rows": str(max(1, round(int(wanted) * int(rows[1]) / int(columns[1]))))}


def _find(scene: str | Path) -> Path:
    """Return the file of a scene, which a file's name or a built-in name means."""
    text = str(scene)
    if re.fullmatch(r"[\w-]{1,64}", text) and not Path(text).exists():
        return scene_path(text)
    return require_file(scene)


def mitsuba_sentence(error: Exception) -> str:
    """Shrink an error of Mitsuba's, which may hold a whole Python traceback, to what is wrong."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    # A list of misspelled parameters stands below the sentence that says so.
    start = max((i for i, line in enumerate(lines) if not line.startswith("- ")), default=0)
    last = " ".join(lines[start:])
    if found := re.search(r'unreferenced \w+ in .*? of type "(\w+)": - \w+ "(\w+)"', last):
        known = KNOWN_PARAMETERS.get(found[1], ())
        return f"{found[1]}: {found[2]}: it has no such parameter{did_you_mean(found[2], known)}"
    if found := re.search(r'Plugin "(\w+)" not found', last):
        return f"type = {found[1]}: Mitsuba has no such plugin{did_you_mean(found[1], KNOWN_PARAMETERS)}"
    last = re.sub(r"^\[[\w.]+:\d+\] ", "", last)
    last = re.sub(r"^(?:At|While loading|Error while loading) [^:]*?(?:\([^)]*\)|\"[^\"]*\"): ", "", last)
    if found := re.match(r"\[(\w+)\] could not assign an object of type '(\w+)'", last):
        return f"{found[1]}: a value of type {found[2]} is none that plugins take; give a number or text"
    return re.sub(r"^(?:[\w.]+\.)?(?:InputError|RuntimeError|ValueError|TypeError|Exception): ", "", last)
