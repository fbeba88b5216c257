"""Extensions: what a folder of `extensions`, or another package, adds to the core, and where it is looked up.

An extension is a package whose `__init__` holds an `Extension` called ``EXTENSION`` and nothing else. The folders of
`mitsuba_plenoptic.extensions` are found by themselves, other packages by the entry point group
``mitsuba_plenoptic.extensions``, whose entries name such packages. The core imports no extension; it asks this module.
Modules are imported when what they add is first asked for.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from .errors import InputError, refuse_if
from .shipped import SHIPPED

GROUP = "mitsuba_plenoptic.extensions"
"""Name of the entry point group of extensions in other packages, and of the package of the shipped ones."""


@dataclass(frozen=True)
class FileFormat:
    """The places of the functions that read and write files of one suffix.

    Parameters
    ----------
    holds : {"capture", "light field", "lens"}
        What a file contains.
    read : str
        Place of the function of a path that returns a `Capture`, a light field, or a main lens.
    write : str
        Place of the function of a path and a light field that writes the file; an empty text means none.
    """

    holds: str
    read: str
    write: str = ""


@dataclass(frozen=True, kw_only=True)
class Extension:
    """Record of what an extension adds; modules are named relative to the extension's package.

    A place is the name of a module, a colon, and the name of an object in the module.

    Parameters
    ----------
    names : mapping of str to tuple of str
        Public names of `mitsuba_plenoptic`, by the modules that define them; ``refocus.name`` is one of a subpackage.
    modules : mapping of str to str
        Public modules of `mitsuba_plenoptic`, such as ``torch``, and the modules that they are.
    commands : mapping of str to str
        Commands of ``mitsuba-plenoptic``, and the modules with a function, or a `typer.Typer`, of their name.
    parameters : mapping of str to str
        Parameters of the camera, and the places of their entries, of type `camera.entry.Parameter`.
    responses : mapping of str to str
        Parameters of the camera that take the place of the microlenses' refraction in ray captures, and the places of
        classes whose instances, made of the parameter's value, are called with the pixel in its lens, the slopes of
        light, and the wavelengths.
    presets : mapping of str to str
        Names of known cameras, and the places of dictionaries that have their parameters by these names.
    plugins : mapping of str to str
        Modules of plugins for Mitsuba, with ``NAME`` and ``make_class``, and their kind, sensor or integrator.
    captures : mapping of str to str
        Kinds of cameras whose scenes the core's signed rays cannot capture, such as ``small lenses``, and the places of
        functions of a camera, its light, the colours and the accuracy, which return their wave capture.
    methods : mapping of str to str
        Methods of reconstruction, and the modules that register them by `refocus.methods.method`.
    lenses : mapping of str to str
        Kinds of main lenses, and the modules that register them by `lenses.common.builds`.
    cameras : mapping of str to str
        Programs whose JSON files of cameras are read, and the places of functions of such a file's object that return
        the camera.
    generators : mapping of str to str
        Generators of the samples of data sets, by the names that recipes call them, and the places of their classes.
    displays : mapping of str to str
        Classes whose objects notebooks show with a picture or a table, such as ``Capture``, and the places of functions
        of such an object that return its HTML.
    comparisons : mapping of str to str
        Options of ``compare`` that take the place of a scene, and the places of the functions that they call.
    formats : mapping of str to FileFormat
        Suffixes of files, such as ``.lfr``, or the name of a file in each folder, such as ``parameters.cfg``, and how
        they are read and written.
    """

    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    modules: Mapping[str, str] = field(default_factory=dict)
    commands: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, str] = field(default_factory=dict)
    responses: Mapping[str, str] = field(default_factory=dict)
    presets: Mapping[str, str] = field(default_factory=dict)
    plugins: Mapping[str, str] = field(default_factory=dict)
    captures: Mapping[str, str] = field(default_factory=dict)
    methods: Mapping[str, str] = field(default_factory=dict)
    lenses: Mapping[str, str] = field(default_factory=dict)
    cameras: Mapping[str, str] = field(default_factory=dict)
    generators: Mapping[str, str] = field(default_factory=dict)
    displays: Mapping[str, str] = field(default_factory=dict)
    comparisons: Mapping[str, str] = field(default_factory=dict)
    formats: Mapping[str, FileFormat] = field(default_factory=dict)


@cache
def installed() -> Mapping[str, Extension]:
    """Return the records of all installed extensions by package name."""
    packages = [entry.value for entry in entry_points(group=GROUP)]
    try:
        shipped = importlib.import_module(GROUP)
    except ModuleNotFoundError:
        pass
    else:
        packages = [f"{GROUP}.{module.name}" for module in pkgutil.iter_modules(shipped.__path__)] + packages
    return {package: importlib.import_module(package).EXTENSION for package in packages}


def place(package: str, text: str) -> Any:
    """Return the object at a place of an extension's package."""
    module, _, name = text.partition(":")
    return getattr(importlib.import_module(f"{package}.{module}"), name)


def entries(kind: str) -> Iterator[tuple[str, str, Any]]:
    """Yield package, key and value of all entries in one mapping of the records, such as ``commands``."""
    for package, record in installed().items():
        for key, value in getattr(record, kind).items():
            yield package, key, value


def entry_of(kind: str, key: str, what: str) -> Any:
    """Return the object that a mapping of the records, such as ``commands``, names for a key.

    Raises
    ------
    InputError
        If no extension has the entry; `what` begins the line.
    """
    for package, found, text in entries(kind):
        if found == key:
            return place(package, text)
    raise InputError(f"{what}: {missing(kind, key) or f'no extension has {key}'}")


class Displayed:
    """A class whose objects notebooks show as an extension draws them, or as plain text without that extension."""

    __slots__ = ()

    def _repr_html_(self) -> str | None:
        for package, name, text in entries("displays"):
            if name == type(self).__name__:
                return str(place(package, text)(self))
        return None


def register(kind: str) -> None:
    """Import the modules listed under ``methods`` or ``lenses`` of the records, which register themselves."""
    for package, record in installed().items():
        for module in getattr(record, kind).values():
            importlib.import_module(f"{package}.{module}")


def format_of(suffix: str, holds: str, what: str, write: bool = False) -> tuple[str, str] | None:
    """Return package and place of the reader, or writer, of files of a suffix; None where no extension has one.

    Raises
    ------
    InputError
        If a shipped extension has one and is not installed; `what` begins the line.
    """
    for package, key, found in entries("formats"):
        if (key, found.holds) == (suffix, holds):
            return package, found.write if write else found.read
    refuse_if(absent := missing("formats", suffix), f"{what}: {absent}")
    return None


GONE = {"benchmark": "a recipe of a data set serves instead (docs/datasets.md)"}
"""Commands and modules of version 1.0 that are gone, and what serves instead."""


def missing(kind: str, name: str) -> str:
    """Return the line on what is gone, or on a shipped extension that has it and is not installed; else no text."""
    if kind in ("commands", "modules") and name in GONE:
        return f"{name}: it is gone since version 2.0; {GONE[name]}"
    owner = SHIPPED[kind].get(name)
    return f"{name}: extension {owner} is not installed" if owner and f"{GROUP}.{owner}" not in installed() else ""
