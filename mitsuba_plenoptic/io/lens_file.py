"""Main lenses as files: our YAML or JSON, which holds what `Prescription.to_plain` returns, and what others write."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from ..errors import InputError
from ..objective import Objective
from ..prescription import Prescription, bundled_prescription
from .files import atomic_output, require_file
from .lens_designs import SUFFIXES, read_design
from .yaml_file import read_yaml


def read_lens(source: str | Path, resolve: Callable[[str], str] = str) -> Prescription | Objective:
    """Read a main lens: what `read_prescription` reads, or an objective as a file or as the text of a JSON file.

    Parameters
    ----------
    source : str or Path
        The file, name or text.
    resolve : callable, optional
        Finds a file by its name, for example beside a scene.

    Raises
    ------
    InputError
        If there is no such file or lens, or it is neither.
    """
    text = str(source)
    if text.lstrip().startswith("{"):
        return _from_plain(_parsed(text))
    path = Path(resolve(text))
    if path.exists() and path.suffix.lower() not in SUFFIXES:
        try:
            return _from_plain(read_yaml(require_file(path)))
        except InputError as error:
            raise InputError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None
    return read_prescription(source, resolve)


def read_prescription(source: str | Path, resolve: Callable[[str], str] = str) -> Prescription:
    """Read a main lens of surfaces.

    Parameters
    ----------
    source : str or Path
        A YAML or JSON file, a Zemax ``.zmx`` or CODE V ``.seq`` file (see `lens_designs`); the name of a
        bundled lens, where there is no such file; or the text of a JSON file.
    resolve : callable, optional
        Finds a file by its name, for example beside a scene.

    Raises
    ------
    InputError
        If there is no such file or lens, or it is not a prescription.
    """
    text = str(source)
    if text.lstrip().startswith("{"):
        return Prescription.from_plain(_parsed(text))
    path = Path(resolve(text))
    if not path.exists():
        return bundled_prescription(text)
    if path.suffix.lower() in SUFFIXES:
        return read_design(path)
    try:
        return Prescription.from_plain(read_yaml(require_file(path)))
    except InputError as error:
        raise InputError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"main_lens: it must be a JSON object: {error}") from None


def _from_plain(value: Any) -> Prescription | Objective:
    if isinstance(value, dict) and "magnification" in value:
        return Objective.from_plain(value)
    return Prescription.from_plain(value)


def write_prescription(path: str | Path, lens: Prescription) -> None:
    """Write a main lens as a YAML file, for `read_prescription`.

    Parameters
    ----------
    path : str or Path
        The file.
    lens : Prescription
        The lens.
    """
    with atomic_output(path, ".yaml", ".yml", ".json") as temporary:
        temporary.write_text(yaml.safe_dump(lens.to_plain(), sort_keys=False), encoding="utf-8")
