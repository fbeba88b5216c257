"""What a scene file may do: checked before Mitsuba sees it, since scene files come from strangers too.

A scene file may name other files to read, meshes, textures, spectra and scenes to include, wherever the user may read.
It may not

- be anything but UTF-8 XML, with a document type (whose entities can grow without bounds) or nested deeper than 64;
- include itself, include scenes deeper than 8, or more than 256 of them;
- name devices, pipes or sockets, which may never end;
- name pictures or meshes whose headers claim more than memory or the file holds, or that make Mitsuba crash;
- bring native code: Mitsuba looks for plugins first in a folder ``plugins`` beside the scene, and runs what it finds.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.parsers import expat

from ..errors import InputError, shown
from ..io.exr import read_parts
from ..io.files import require_file, require_size
from ..runtime.limits import require_memory

_DEEPEST = 64
_DEEPEST_INCLUDE = 8
_MOST_FILES = 256
LARGEST_SCENE = 2**28
"""Bytes of an XML file, at most: Mitsuba's parser holds several times as much."""

_NATIVE = re.compile(r"\.(so|dylib|dll|pyd)(\.|$)", re.IGNORECASE)
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tga")

# Bytes that Mitsuba takes for a texel: four channels, as read and in single precision, twice.
_TEXEL = 40

_LONGEST_PLY_HEADER = 2**16

_ATTRIBUTES = ("name", "value", "type", "filename")

_Element = tuple[str, dict[str, str]]
"""Tag and those attributes, empty where it has none."""


def check_scene_file(path: Path, parameters: Mapping[str, str]) -> str:
    """Refuse a scene file that does what none needs to do; the module's text says what.

    Parameters
    ----------
    path : Path
        An XML file.
    parameters : mapping
        Values for its ``$name`` parameters, where they differ from its defaults.

    Returns
    -------
    str
        The text of the file, and of those that it includes.

    Raises
    ------
    InputError
        Naming the file, what is in it and the rule.
    """
    folders = [Path.cwd(), path.parent]
    files: list[Path] = []
    _check(path, dict(parameters), folders, files, ())
    return "".join(file.read_text("utf-8-sig") for file in files)


def _check(
    path: Path, parameters: dict[str, str], folders: list[Path], files: list[Path], parents: tuple[Path, ...]
) -> None:
    path = require_file(path)
    files.append(path)
    if path.resolve() in parents or len(parents) > _DEEPEST_INCLUDE or len(files) > _MOST_FILES:
        raise InputError(
            f"{path}: scenes include each other without end, deeper than {_DEEPEST_INCLUDE} or more than "
            f"{_MOST_FILES} times"
        )
    elements = _parse(path)
    # Of several defaults of one name the first counts. A scene's defaults serve what it includes.
    defaults = (given for tag, given in reversed(elements) if tag == "default" and given["name"])
    values = {given["name"]: given["value"] for given in defaults} | parameters
    elements = [(tag, {key: _filled(text, values) for key, text in given.items()}) for tag, given in elements]
    folders = [*folders, path.parent, *(path.parent / given["value"] for tag, given in elements if tag == "path")]
    for folder in folders:
        _refuse_native_code(path, folder)
    for tag, given in elements:
        plugin = given["type"]
        if re.search(r"[^\w$.\-]", plugin) or ".." in plugin:
            raise InputError(f"{path}: type = {shown(plugin)}: it must be the name of a plugin")
        for name in (given["value"], given["filename"]):
            for file in _existing(name, folders):
                _check_resource(path, file)
        for file in _existing(given["filename"], folders) if tag == "include" else ():
            _check(file, values, folders, files, (*parents, path.resolve()))


def _parse(path: Path) -> list[_Element]:
    """Read the elements of an XML file, with a parser that stops at what is not allowed."""
    # A scene's meshes belong in their own files.
    require_size(path, LARGEST_SCENE)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: it is not UTF-8 text: {error.reason} at byte {error.start}") from None
    # Two parsers that read an encoding differently would see two scenes.
    declared = re.match(r"\s*<\?xml[^>]*?encoding\s*=\s*[\"']([^\"']*)", text)
    if declared and declared.group(1).lower() not in ("utf-8", "utf8", "us-ascii", "ascii"):
        raise InputError(f"{path}: its encoding is {shown(declared.group(1))}: it must be UTF-8")
    elements: list[_Element] = []
    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise InputError(f"{path}, line {parser.CurrentLineNumber}: nested deeper than {_DEEPEST}")
        elements.append((tag, {name: attributes.get(name, "") for name in _ATTRIBUTES}))

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1

    def doctype(*_: object) -> None:
        raise InputError(f"{path}, line {parser.CurrentLineNumber}: a scene has no document type; remove <!DOCTYPE")

    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = start, end, doctype
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise InputError(
            f"{path}, line {error.lineno}: it is not well-formed XML: {expat.ErrorString(error.code)}"
        ) from None
    return elements


def _filled(text: str, values: Mapping[str, str]) -> str:
    """Put values in the place of ``$names``, the longest first, as Mitsuba does."""
    for name in sorted(values, key=len, reverse=True) if "$" in text else ():
        text = text.replace(f"${name}", values[name])
    return text


def _existing(name: str, folders: list[Path]) -> Iterator[Path]:
    """Yield the files, of whatever kind, that a name means."""
    if not name or "\0" in name:
        return
    for folder in dict.fromkeys(folders):
        file = folder / name
        try:
            if file.exists() and not file.is_dir():
                yield file
        except OSError:
            continue  # a text, too long for a name


def _refuse_native_code(path: Path, folder: Path) -> None:
    try:
        native = sorted(item.name for item in (folder / "plugins").iterdir() if _NATIVE.search(item.name))
    except OSError:
        return
    if native:
        raise InputError(
            f"{path}: Mitsuba would run the native code in {folder / 'plugins'} ({', '.join(native[:3])}) as "
            "plugins of this scene: move the folder away"
        )


def _check_resource(scene: Path, file: Path) -> None:
    """Refuse a file that may never end, or that claims more than there is."""
    status = file.stat()
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{scene}: {file} is a device, a pipe or a socket: a scene may name regular files only")
    # Imported here, like all that only some scenes need.
    from PIL import Image

    suffix = file.suffix.lower()
    try:
        if suffix in _PICTURES:
            with Image.open(file) as picture:
                _check_picture(scene, file, *picture.size)
        elif suffix == ".exr":
            for part in read_parts(file):
                _check_picture(scene, file, part.columns, part.rows)
                if min(part.origin) < 0:
                    raise ValueError(f"its data window begins at {part.origin}, and Mitsuba crashes below 0")
        elif suffix == ".ply":
            _check_ply(scene, file, status.st_size)
    except InputError:
        raise
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{scene}: {file} cannot be read: {error}") from None


def _check_picture(scene: Path, file: Path, columns: int, rows: int) -> None:
    require_memory(_TEXEL * columns * rows, f"{scene}: {file} of {columns} x {rows} pixels")


def _check_ply(scene: Path, file: Path, size: int) -> None:
    """See that a mesh has no more elements than its file has bytes."""
    with file.open("rb") as opened:
        header = opened.read(_LONGEST_PLY_HEADER).partition(b"end_header")[0]
    for match in re.finditer(rb"^\s*element\s+(\w+)\s+(\S+)", header, re.MULTILINE):
        name, count = (word.decode(errors="replace") for word in match.groups())
        if not count.isdecimal() or len(count) > 18 or int(count) > size:
            raise InputError(f"{scene}: {file} claims {shown(count)} elements '{name}' in {size} bytes")
