"""Records that files and headers hold as plain data: numbers, strings, lists and dictionaries by the fields' names."""

import json
from collections.abc import Callable
from dataclasses import MISSING, fields
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from ..errors import InputError, naming, refuse_if, require_known, short_repr
from .files import read_json_value


class PlainData:
    """A frozen dataclass whose fields are entries of its plain data; records of one class are equal if these are."""

    where: ClassVar[str] = ""
    """What begins messages on entries."""

    def to_plain(self) -> dict[str, Any]:
        """Return the fields, but for None, as values by name, for `from_plain`, files and headers."""
        values = {field.name: _plain(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]
        return {name: value for name, value in values.items() if value is not None}

    @classmethod
    def from_plain(cls, value: Any) -> Self:
        """Return the record that `to_plain` described, after its checks.

        Parameters
        ----------
        value : dict
            The fields by name; those with a default may be missing.
        """
        refuse_if(not isinstance(value, dict), f"{cls.where}{short_repr(value)}: it must be a dictionary")
        entries = {field.name: field for field in fields(cls)}  # type: ignore[arg-type]
        require_known(cls.where, value, entries)
        for name, field in entries.items():
            refuse_if(name not in value and field.default is MISSING, f"{cls.where}{name} is missing")
        return cls(**value)

    @cached_property
    def _contents(self) -> tuple:
        values = [getattr(self, field.name) for field in fields(self)]  # type: ignore[arg-type]
        return tuple(
            (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else json.dumps(_plain(value))
            for value in values
        )

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self._contents == other._contents

    def __hash__(self) -> int:
        return hash(self._contents)


Record = TypeVar("Record", bound=PlainData)


def known_record(
    kind: type[Record], name: str, value: Any, resolve: Callable[[str], str] = str, form: str = "a dictionary"
) -> Record | None:
    """Return a parameter's record, given as such, as plain data, a JSON file or its text; None means none.

    A table that is all a record needs may be given alone, and tables by the names of files, which `resolve` finds, for
    example in the folder of a scene. `form` says in messages what a record is.
    """
    if value is None or isinstance(value, kind):
        return value
    table, *others = [field.name for field in fields(kind) if field.default is MISSING]  # type: ignore[arg-type]
    with naming(name):
        if isinstance(value, (str, Path)):
            is_json = str(value).lstrip().startswith("{") or Path(value).suffix.lower() == ".json"
            value = read_json_value(value, resolve) if is_json or others else Path(resolve(str(value)))
        if isinstance(value, dict):
            file = value.get(table)
            return kind.from_plain(value | {table: Path(resolve(file))} if isinstance(file, str) else value)
        if others or isinstance(value, (int, float)):
            raise InputError(f"{short_repr(value)}: it must be {form} or a JSON file")
        return kind(value)  # type: ignore[call-arg]


def _plain(value: Any) -> Any:
    """Return a field as a JSON value."""
    for method in ("to_plain", "tolist"):
        if hasattr(value, method):
            return getattr(value, method)()
    return list(value) if isinstance(value, tuple) else value
