"""Main lenses as files: YAML or JSON of `Prescription.to_plain`, and the formats of other programs."""

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from ..errors import NO_RECORD, InputError, naming, refusing
from ..extension import format_of, place
from ..runtime import Named, read_yaml, require_file
from .collimator import Collimator  # noqa: F401 (a kind of plain data that files may hold)
from .lens_data import LensData, known_kind
from .objective import Objective  # noqa: F401 (a kind of plain data that files may hold)
from .surfaces import BUNDLED, Prescription, bundled_prescription


def read_lens(source: str | Path, resolve: Callable[[str], str] = str) -> LensData:
    """Return a main lens, a prescription or an objective, from a file or a JSON text.

    Parameters
    ----------
    source : str or Path
        The file, name or text.
    resolve : callable, optional
        Finds a file by its name, for example in the folder of a scene.
    """
    text = str(source)
    if text.lstrip().startswith("{"):
        with refusing("main_lens: it must be a JSON object:", *NO_RECORD):
            return lens_from_plain(json.loads(text))
    path = Path(resolve(text))
    there = False
    # Not all text can be the name of a file.
    with contextlib.suppress(OSError, ValueError):
        there = path.exists()
    if text in BUNDLED or not there:
        return bundled_prescription(text)
    if (reader := format_of(path.suffix.lower(), "lens", str(path))) is not None:
        return cast(LensData, place(*reader)(path))
    plain = read_yaml(require_file(path))
    with naming(path):
        return lens_from_plain(plain)


def read_prescription(source: str | Path, resolve: Callable[[str], str] = str) -> Prescription:
    """Return the prescription in a file, or of a bundled lens.

    Parameters
    ----------
    source : str or Path
        The name of a bundled lens; a YAML or JSON file, a Zemax ``.zmx`` or CODE V ``.seq`` file; or the text of a JSON
        file. The file of a bundled lens, such as ``tessar.yaml``, is found where there is no file of that name.
    resolve : callable, optional
        Finds a file by its name, for example in the folder of a scene.
    """
    lens = read_lens(source, resolve)
    if not isinstance(lens, Prescription):
        raise InputError(f"{source}: it is an {type(lens).__name__.lower()}; a lens with surfaces is needed")
    return lens


def lens_from_plain(value: Any) -> LensData:
    """Return the main lens of plain data: a prescription, unless an entry marks another kind."""
    return known_kind(value, Prescription).from_plain(value)


def known_lens(value: LensData | str | Path | Named | None) -> LensData | None:
    """Return a main lens from any of its forms; None means a thin lens."""
    if value is None or isinstance(value, LensData):
        return value
    return read_lens(value) if isinstance(value, (str, Path)) else lens_from_plain(value)
