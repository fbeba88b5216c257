"""Loading of scenes: files, dictionaries, and the scenes that come with the package."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PARAMETERS
from ..errors import (
    SCENE_XML,
    InputError,
    content_of,
    did_you_mean,
    refuse_if,
    require_choice,
    short_repr,
    suggest_keywords,
)
from ..extension import missing
from ..io import read_parts
from ..runtime import one_at_a_time, require_file, require_size, set_variant
from ..scene_files import scene_path
from .radiance import require_seen, warn_of_metres

LARGEST_SCENE = 2**28
"""Largest size of an XML file in bytes; Mitsuba's parser needs several times as much memory."""

_NATIVE = re.compile(r"\.(so|dylib|dll|pyd)(\.|$)", re.IGNORECASE)

_ATTRIBUTES = ("name", "value", "type", "filename")


def check_scene_file(path: Path, parameters: Mapping[str, str]) -> list[Element]:
    """Return the root elements of a scene file and of all that it includes.

    Scenes that would run native code as plugins are refused, and pictures that crash Mitsuba.
    """
    content = content_of(require_size(path, LARGEST_SCENE))
    refuse_if(content != SCENE_XML, f"{path}: it is {content}; a scene is XML in UTF-8 with the root <scene>")
    roots: dict[Path, Element] = {}
    _check(path, dict(parameters), [Path.cwd(), path.parent], roots)
    return list(roots.values())


def _check(path: Path, parameters: dict[str, str], folders: list[Path], roots: dict[Path, Element]) -> None:
    """Check a scene file and what it includes, each once, and add their root elements to `roots`."""
    require_size(path, LARGEST_SCENE)
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        cause = str(error).partition(":")[0]
        raise InputError(f"{path}, line {error.position[0]}: it is not well-formed XML: {cause}") from None
    roots[path.resolve()] = root
    # A scene's defaults also apply to the files that it includes.
    values = scene_defaults([root]) | parameters
    elements = [
        (element.tag, {key: _filled(element.get(key, ""), values) for key in _ATTRIBUTES}) for element in root.iter()
    ]
    folders = [*folders, path.parent]
    folders += [path.parent / attributes["value"] for tag, attributes in elements if tag == "path"]
    for plugins in (folder / "plugins" for folder in folders):
        with contextlib.suppress(OSError):  # there is no such folder
            native = sorted(item.name for item in plugins.iterdir() if _NATIVE.search(item.name))
            refuse_if(
                native,
                f"{path}: Mitsuba would run the native code in {plugins} ({', '.join(native[:3])}) as plugins of this "
                "scene: move the folder away",
            )
    for tag, attributes in elements:
        plugin = attributes["type"]
        refuse_if(
            re.search(r"[^\w$.\-]", plugin) or ".." in plugin,
            f"{path}: type = {short_repr(plugin)}: it must be the name of a plugin",
        )
        for file in _existing(attributes["filename"], folders) if tag == "include" else ():
            if file.resolve() not in roots:
                _check(file, values, folders, roots)
        for file in _existing(attributes["value"], folders) if attributes["value"].lower().endswith(".exr") else ():
            for layer in read_parts(file):
                refuse_if(
                    min(layer.origin) < 0,
                    f"{path}: {file}: its data window begins at {layer.origin}, and Mitsuba crashes below 0",
                )


def scene_defaults(roots: Iterable[Element]) -> dict[str, str]:
    """Return the defaults of a scene's parameters; of several with one name the first, as in Mitsuba."""
    defaults: dict[str, str] = {}
    for root in roots:
        for element in root.iter("default"):
            if name := element.get("name"):
                defaults.setdefault(name, element.get("value", ""))
    return defaults


def names_in(element: Element) -> set[str]:
    """Return the names of scene parameters that an element's attributes refer to."""
    return {name for text in element.attrib.values() for name in re.findall(r"\$(\w+)", text)}


def _filled(text: str, values: Mapping[str, str]) -> str:
    """Return a text with ``$names`` replaced by their values, the longest names first, as Mitsuba does."""
    for name in sorted(values, key=len, reverse=True) if "$" in text else ():
        text = text.replace(f"${name}", values[name])
    return text


def _existing(name: str, folders: list[Path]) -> Iterator[Path]:
    """Yield the files of a name in the folders."""
    for file in dict.fromkeys(folder / name for folder in folders):
        with contextlib.suppress(OSError, ValueError):  # a text that is no name of a file
            if name and file.is_file():
                yield file


KNOWN_PARAMETERS = {
    "plenoptic": (*PARAMETERS, "to_world"),
    "plenoptic_wave": (*("wavelength", "bandwidth", "responses", "wavelength_count", "nodes"), *("method", "accuracy")),
    "plenoptic_laser": (
        *("lasers", "wavelength", "modes", "points_per_spot"),
        *("source_diameter", "source_distance", "bandwidth", "roughness"),
    ),
}
"""Parameters of this package's plugins, for suggestions in messages."""


def unknown_parameter(plugin: str, name: str) -> str:
    """Return the message on a parameter that a plugin does not have, with the most similar known one."""
    return f"{plugin}: {name}: it has no such parameter{did_you_mean(name, KNOWN_PARAMETERS.get(plugin, ()))}"


def as_scene(scene: Any) -> Any:
    """Return a scene, loaded if it is a file, a built-in scene's name or a dictionary."""
    return load_scene(scene) if isinstance(scene, (str, Path, Mapping)) else scene


@suggest_keywords
@one_at_a_time
def load_scene(
    scene: str | Path | Mapping[str, Any],
    *,
    variant: str | None = None,
    parameters: Mapping[str, str] | None = None,
    unit: str = "mm",
) -> Any:
    """Return a scene loaded from a file, by the name of a built-in scene, or from a dictionary for ``mi.load_dict``.

    Parameters
    ----------
    scene : str, path or dict
        An XML file, a built-in name such as ``letters``, or a scene's dictionary, whose transforms and objects must be
        of the given or active variant.
    variant : str, optional
        Mitsuba variant to set. Default: the active one, or ``llvm_ad_mono`` if no variant is active.
    parameters : mapping, optional
        Values for the ``$name`` parameters of a scene file. If a scene has ``$resolution`` and ``$rows`` for the
        columns and rows of its detector and only the columns are given, the rows follow in proportion.
    unit : str, optional
        Unit of the scene's lengths: ``mm``, ``cm`` or ``m``. Shapes, instances, lamps, media, volumes, heights of bumps
        and the places of sensors are scaled to millimetres, so that the scene looks the same; what cannot be scaled
        is refused by name. A plenoptic camera in the scene has millimetres of its own in any unit. ``$name``
        parameters are in the scene's unit.

    Returns
    -------
    mitsuba.Scene

    Raises
    ------
    InputError
        If there is no such scene or variant, the file would run native code or read unsuitable files, or Mitsuba
        refuses the scene. The message is one line with the position in the file.

    Warns
    -----
    UserWarning
        If the whole scene is within the focal length of its plenoptic camera, or nearer than half of what refocusing
        makes sharp, as scenes in metres are.

    Examples
    --------
    >>> import mitsuba_plenoptic as mp
    >>> size = {"detector_width": 0.256, "resolution": 128}
    >>> scene = mp.load_scene("letters", variant="llvm_ad_mono", parameters=size)
    """
    factor = UNITS[require_choice("unit", unit, UNITS)]
    load: Callable
    parse: Callable[[Any], Any]
    if isinstance(scene, Mapping):
        if parameters:
            raise InputError(
                f"parameters = {short_repr(dict(parameters))}: a dictionary has none; put the values into it"
            )
        if scene.get("type") != "scene":
            raise InputError(f"scene: its 'type' is {short_repr(scene.get('type'))}: it must be 'scene'")
        without = ", ".join(_keys_of_none(scene))
        refuse_if(without, f"scene: {without} = None: it must have a value; leave it out for the default")
        set_variant(variant)
        where = "scene"
        name = "dictionary"
        entries = dict(scene)
        load, parse = (
            partial(mi.load_dict, entries, parallel=False),
            lambda config: mi.parser.parse_dict(config, entries),
        )
    else:
        if parameters is not None and not isinstance(parameters, Mapping):
            raise InputError(f"parameters = {short_repr(parameters)}: they must be values by name")
        is_name = re.fullmatch(r"[\w-]{1,64}", str(scene)) and not Path(scene).is_file()
        path = scene_path(str(scene)) if is_name else require_file(scene)
        set_variant(variant)
        values = _complete(path, {str(name): str(value) for name, value in (parameters or {}).items()})
        where = str(path)
        name = path.name
        load, parse = (
            partial(mi.load_file, where, parallel=False, **values),
            lambda config: mi.parser.parse_file(config, where, **values),
        )
    with loading(where):
        # In parallel, Dr.Jit's messages would wait for Python in one thread while it waits for Dr.Jit in another.
        # Mitsuba's optimisation would list merged shapes and emitters in an order that changes from run to run, and
        # with it the random numbers that each gets.
        if factor == 1:
            loaded = load(optimize=False)
        else:
            config = mi.parser.ParserConfig(mi.variant())
            config.merge_meshes = config.merge_equivalent = config.parallel = False
            # As `mi.load_file` does, which is not used here: files are looked for next to the scene.
            mi.set_file_resolver(mi.FileResolver(resolver := mi.file_resolver()))
            mi.file_resolver().prepend(str(Path(where).parent))
            try:
                state = parse(config)
                mi.parser.transform_all(config, state)
                scale_nodes(state.nodes, factor)
                loaded = mi.parser.instantiate(config, state)
            finally:
                mi.set_file_resolver(resolver)
    # Captures state this name in their metadata.
    loaded.set_id(name)
    if sensors := loaded.sensors():
        warn_of_metres(loaded, sensors[0])
        if loaded.integrator() is not None and hasattr(type(sensors[0]), "camera"):
            require_seen(loaded.integrator(), sensors[0])
    return loaded


def _keys_of_none(entries: Mapping[str, Any]) -> Iterator[str]:
    """Yield the keys of values that are None, on which Mitsuba's loader ends the process."""
    for key, value in entries.items():
        if value is None:
            yield str(key)
        elif isinstance(value, Mapping):
            yield from (f"{key}.{rest}" for rest in _keys_of_none(value))


def with_objects(scene: mi.Scene, new: Sequence[mi.Object], old: Sequence[mi.Object]) -> mi.Scene:
    """Return a scene of new objects, then of all others of a scene but for some, which keep their ids."""
    properties = mi.Properties("scene")
    # Unlike the lists of shapes and emitters, the traversal names the groups that instances show.
    parts = [child for child, (_, depth) in mi.traverse(scene).hierarchy.items() if depth == 1 and child not in old]
    for index, child in enumerate((*new, *parts)):
        properties[f"{index}"] = child
    copy = mi.PluginManager.instance().create_object(properties)
    copy.set_id(scene.id())
    return copy


def meet_moved(scene: Any, sensor: Any) -> None:
    """Rebuild what rays meet in a scene of shared shapes, which may have been moved through another scene."""
    shares = isinstance(scene, mi.Scene) and getattr(sensor, "shares_shapes", False)
    # Frozen functions record no rebuilding.
    if not shares or dr.flag(dr.JitFlag.FreezingScope):
        return
    for shape in mi.traverse(scene).hierarchy:
        if isinstance(shape, mi.Shape):
            # Normals that are named among the changes are kept.
            shape.parameters_changed(list(mi.traverse(shape).keys()))
    scene.parameters_changed([])


def _complete(path: Path, parameters: dict[str, str]) -> dict[str, str]:
    """Return the parameters for a scene file, with rows in proportion to the columns; refuse names that it has not."""
    roots = check_scene_file(path, parameters)
    defaults = scene_defaults(roots)
    texts = [text for root in roots for element in root.iter() for text in element.attrib.values()]
    for name in parameters:
        # Mitsuba ignores misspelled names silently, and replaces names wherever they are part of a text, but for longer
        # names.
        longer = [default for default in defaults if default.startswith(name) and default != name]
        pattern = "|".join(rf"\${default}" for default in longer) or "$^"
        if not any(f"${name}" in re.sub(pattern, "", text) for text in texts):
            names = sorted(defaults)
            stated = f"none of that name ({', '.join(names)})" if names else "no parameters"
            raise InputError(f"parameter {name}: the scene {path} has {stated}{did_you_mean(name, names)}")
    counts = parameters.get("resolution", ""), defaults.get("resolution", ""), defaults.get("rows", "")
    if "rows" in parameters or not all(re.fullmatch(r"\d{1,9}", count) for count in counts):
        return parameters
    columns, own_columns, own_rows = map(int, counts)
    return {**parameters, "rows": str(max(1, round(columns * own_rows / own_columns)))}


@contextlib.contextmanager
def loading(subject: str = "") -> Iterator[None]:
    """Turn Mitsuba's refusal to load a scene into an `InputError` with the cause and the line of the file."""
    try:
        yield
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError) as error:
        # Mitsuba names what a plugin in Python raised in an error, Ctrl-C as well.
        if "KeyboardInterrupt" in str(error):
            raise KeyboardInterrupt from None
        # A traceback states lines of Python.
        line = re.search(r"\b(line \d+(?:, col(?:umn)? \d+)?)", str(error).partition("Traceback")[0])
        where = f"{subject}{f', {line[1]}' if line else ''}: " if subject else ""
        raise InputError(f"{where}{mitsuba_sentence(error)}") from None


def mitsuba_sentence(error: Exception) -> str:
    """Return the sentence of a Mitsuba error message, without the traceback that may surround it."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    # Mitsuba lists misspelled parameters below the sentence that reports them.
    start = max((i for i, line in enumerate(lines) if not line.startswith("- ")), default=0)
    last = " ".join(lines[start:])
    if match := re.search(r'unreferenced \w+ in .*? of type "(\w+)": - \w+ "(\w+)"', last):
        return unknown_parameter(match[1], match[2])
    if match := re.search(r'Plugin "(\w+)" not found', last):
        absent = missing("plugins", match[1])
        return absent or f"type = {match[1]}: Mitsuba has no such plugin{did_you_mean(match[1], KNOWN_PARAMETERS)}"
    last = re.sub(r"^\[[\w.]+:\d+\] ", "", last)
    last = re.sub(r"^(?:At|While loading|Error while loading) [^:]*?(?:\([^)]*\)|\"[^\"]*\"): ", "", last)
    if match := re.match(r"\[(\w+)\] could not assign an object of type '(\w+)'", last):
        return f"{match[1]}: a value of type {match[2]} is none that plugins take; give a number or text"
    return re.sub(r"^(?:[\w.]+\.)?(?:InputError|RuntimeError|ValueError|TypeError|Exception): ", "", last)


# -- units ---------------------------------------------------------------------------------------------

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
"""Millimetres in each unit of lengths of scenes."""

_MOVED_LAMPS = ("point", "spot", "projector")
_MOVED_CAMERAS = ("plenoptic", "perspective", "thinlens", "radiancemeter")
_SCALED_SHAPES = (*("sphere", "rectangle", "disk", "cube", "cylinder"), *("obj", "ply", "serialized", "sdfgrid"))
_SKIES = ("area", "directionalarea", "directional", "constant", "envmap", "sunsky", "timed_sunsky")

_SCALABLE = {
    mi.ObjectType.Shape: (*_SCALED_SHAPES, "shapegroup", "instance"),
    mi.ObjectType.Sensor: (*_MOVED_CAMERAS, "irradiancemeter"),
    mi.ObjectType.Emitter: (*_MOVED_LAMPS, *_SKIES),
    mi.ObjectType.Medium: ("homogeneous", "heterogeneous"),
    mi.ObjectType.Volume: ("gridvolume", "constvolume"),
}
"""Plugins that can be scaled, of each type of objects of which some cannot."""

_LENGTHS = {"near_clip": 1e-2, "far_clip": 1e4, "focus_distance": None, "aperture_radius": None}
"""Lengths of Mitsuba's cameras, with the defaults of those whose default is a length of the scene."""


def scale_nodes(nodes: Any, factor: float) -> None:
    """Multiply the lengths of a parsed scene by a factor; refuse by name what would change the scene's look.

    Radiance stays, so that surfaces and skies look the same. The intensity of point lamps grows with the square of
    `factor`, and media become thinner as paths through them get longer. A plenoptic camera is moved and keeps its
    lengths, which are millimetres in every scene.
    """
    # Objects of the active variant that have lengths or may hold some that do.
    kinds = (mi.Shape, mi.Sensor, mi.Emitter, mi.Medium, mi.Volume, mi.BSDF, mi.Texture)
    for node in nodes:
        properties = node.props
        plugin = node.props.plugin_name()
        name = f"unit: {plugin}{f' {node.props.id()!r}' if node.props.id() else ''}"
        for key in properties.keys():  # noqa: SIM118 (properties are no mapping)
            refuse_if(
                isinstance(properties[key], kinds),
                f"{name}: {key}: an object that is already made cannot be scaled; give its dictionary",
            )
        scalable = _SCALABLE.get(node.type, (plugin,))
        refuse_if(
            plugin not in scalable,
            f"{name}: its lengths cannot be scaled, only those of {', '.join(sorted(scalable))}; scale the scene "
            "itself",
        )
        matrix = np.array(properties["to_world"].matrix, np.float64) if "to_world" in properties else np.eye(4)
        if plugin in (*_SCALED_SHAPES, "gridvolume"):
            properties["to_world"] = mi.ScalarTransform4f(np.diag([factor, factor, factor, 1]) @ matrix)
        # The shapes of a group are scaled, so that an instance of them is only moved.
        elif plugin in ("instance", *_MOVED_CAMERAS, *_MOVED_LAMPS):
            if "to_world" in properties:
                matrix[:3, 3] *= factor
                properties["to_world"] = mi.ScalarTransform4f(matrix)
            for key in ("origin", "position"):
                if key in properties:
                    properties[key] = [factor * value for value in properties[key]]
        if plugin in ("perspective", "thinlens"):
            for length, default in _LENGTHS.items():
                if length in properties or default is not None:
                    properties[length] = factor * float(properties.get(length, default))
        elif plugin in _MOVED_LAMPS:
            power = "scale" if plugin == "projector" else "intensity"
            properties[power] = _times(properties.get(power, 1.0), factor**2, f"{name}: {power}")
        elif node.type == mi.ObjectType.Medium:
            properties["scale"] = float(properties.get("scale", 1.0)) / factor
        elif plugin == "bumpmap":
            # Heights of bumps are lengths.
            properties["scale"] = float(properties.get("scale", 1.0)) * factor


def _times(value: Any, factor: float, name: str) -> Any:
    """Return the power of a lamp, a number, a colour or a spectrum, times a factor."""
    if hasattr(value, "is_uniform"):
        values = [factor * entry for entry in value.values]
        return type(value)(values[0]) if value.is_uniform() else type(value)(value.wavelengths, values)
    numbers = isinstance(value, (int, float)) or hasattr(value, "__len__")
    refuse_if(not numbers, f"{name}: it must be given as numbers, so that it can be scaled")
    return value * factor
