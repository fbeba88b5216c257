"""Extensions: what a folder of `extensions`, or another package, adds to the core, and where it is looked up.

An extension is a package whose `__init__` holds an `Extension` called ``EXTENSION`` and nothing else. The folders of
`mitsuba_plenoptic.extensions` are found by themselves, other packages by the entry point group
``mitsuba_plenoptic.extensions``, whose entries name such packages. The core imports no extension; it asks this module.
Modules are imported when what they add is first asked for.
"""

import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from .errors import InputError, did_you_mean, refuse_if

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
    names : mapping of str to str
        Public names that other packages add to `mitsuba_plenoptic`, or to its `refocus` as ``refocus.name``, and the
        places of the objects. Those of shipped extensions stand in ``mitsuba_plenoptic/__init__.pyi``.
    modules : mapping of str to str
        Public modules of `mitsuba_plenoptic`, such as ``torch``, and the modules that they are.
    commands : mapping of str to str
        Commands of ``mitsuba-plenoptic``, and the modules with a function of the last word of their name. Of a group
        of commands, whose first word is the same, the module's docstring is the help.
    parameters : mapping of str to str
        Parameters of the camera, and the places of their entries, of type `camera.entry.Parameter`.
    responses : mapping of str to str
        Parameters of the camera that take the place of the microlenses' refraction in ray captures, and the places of
        classes whose instances, made of the parameter's value, are called with the pixel in its lens, the slopes of
        light, and the wavelengths.
    presets : mapping of str to str
        Names of known cameras, and the places of dictionaries that have their parameters by these names.
    plugins : mapping of str to (str, str)
        Names of plugins for Mitsuba, the modules whose ``make_class`` defines them, and their kind, sensor or
        integrator.
    methods : mapping of str to str
        Methods of reconstruction, and the modules that register them by `refocus.methods.method`.
    options : mapping of str to str
        Those of these methods that have options, and the places of typed dictionaries whose fields are the options,
        such as `refocus_options.RayOptions`. Help reads them, so that their module should import no large library.
    generators : mapping of str to str
        Generators of the samples of data sets, by the names that recipes call them, and the places of their classes.
    displays : mapping of str to str
        Classes whose objects notebooks show with a picture or a table, such as ``Capture``, and the places of functions
        of such an object that return its HTML.
    hooks : mapping of str to str
        Places of functions that the core calls where they are installed: ``small lenses``, the wave capture of a
        camera, its light, the colours and the accuracy; ``libpleno``, the camera of the object in such a file;
        ``--real``, what ``compare`` does with a real light field; ``coherent fields``, those of a wave camera's points.
    formats : mapping of str to FileFormat
        Suffixes of files, such as ``.lfr``, or the name of a file in each folder, such as ``parameters.cfg``, and how
        they are read and written.
    """

    names: Mapping[str, str] = field(default_factory=dict)
    modules: Mapping[str, str] = field(default_factory=dict)
    commands: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, str] = field(default_factory=dict)
    responses: Mapping[str, str] = field(default_factory=dict)
    presets: Mapping[str, str] = field(default_factory=dict)
    plugins: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    methods: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, str] = field(default_factory=dict)
    generators: Mapping[str, str] = field(default_factory=dict)
    displays: Mapping[str, str] = field(default_factory=dict)
    hooks: Mapping[str, str] = field(default_factory=dict)
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


def hook(key: str, what: str) -> Any:
    """Return the function that the records name for a key under ``hooks``.

    Without one, refuse in a line that `what` begins.
    """
    for package, name, text in entries("hooks"):
        if name == key:
            return place(package, text)
    raise InputError(f"{what}: {missing('hooks', key) or f'no extension has {key}'}")


class Suggesting(type):
    """Class of classes that answer an unknown attribute with the most similar known one."""

    def __getattr__(cls, name: str) -> Any:
        public = [] if name.startswith("_") else dir(cls)
        raise AttributeError(f"type object {cls.__name__!r} has no attribute {name!r}{did_you_mean(name, public)}")


class Shown(metaclass=Suggesting):
    """A class whose objects notebooks show as an extension draws them, or as plain text without that extension."""

    __slots__ = ()

    def _repr_html_(self) -> str | None:
        for package, name, text in entries("displays"):
            if name == type(self).__name__:
                return str(place(package, text)(self))
        return None


class Displayed(Shown):
    """A class with an image, which NumPy takes for the object."""

    __slots__ = ()
    image: Any

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        import numpy as np

        return np.array(self.image, dtype, copy=copy)


def format_of(suffix: str, holds: str, what: str, write: bool = False) -> tuple[str, str] | None:
    """Return package and place of the reader, or writer, of files of a suffix; None where no extension has one.

    If a shipped extension has one and is not installed, refuse in a line that `what` begins.
    """
    for package, key, value in entries("formats"):
        if (key, value.holds) == (suffix, holds):
            return package, value.write if write else value.read
    refuse_if(absent := missing("formats", suffix), f"{what}: {absent}")
    return None


SHIPPED = {
    "calibrate": ("calibrate", "calibration", "photon_transfer", "libpleno"),
    "data": ("dataset",),
    "deconvolution": ("incoherent", "deconvolved", "price of a response"),
    "inverse": (
        "fit", "StoredOperator", "volume_points", "refocus.CoherentRefocus", "refocus.DeconvolvedRefocus",
        "refocus.RayRefocus", "fitting", "optimisation", "array_functions", "scene_functions", "torch", "jax",
    ),
    "laser": ("laser", "plenoptic_laser", "coherent fields"),
    "lensdesign": ("focus_by_group", ".zmx", ".seq"),
    "onchip": (
        "bank_disparity", "dual_pixel", "half_disparity", "match_halves", "psf_bank", "onchip", "dual", "small lenses",
        "photodiode_response", "full_frame_dual", "phone_quad", "phone_quad_bayer",
    ),
    "paper": ("reproduce",),
    "particles": ("particles",),
    "prediction": ("--real",),
    "raw": ("demosaic", "exchange", ".lfp", ".lfr", ".raw", "parameters.cfg", ".mat"),
    "sharpness": ("mtf",),
    "studio": ("Viewer", "view", "preview", "sweep"),
    "wavefront": ("wavefront", "far_sources", "hcipy"),
}  # fmt: skip
"""What the shipped extensions add, so that one that is not installed is named."""


def missing(kind: str, name: str) -> str:
    """Return the line on a shipped extension that has a name and is not installed; else no text."""
    for owner, names in SHIPPED.items():
        if name in names and f"{GROUP}.{owner}" not in installed():
            return f"{name}: extension {owner} is not installed"
    return ""
