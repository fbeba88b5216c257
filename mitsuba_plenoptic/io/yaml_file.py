"""YAML, and JSON as a part of it, from anyone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ..errors import InputError
from .files import read_text

LARGEST_FILE = 2**16


class _Loader(yaml.SafeLoader):
    """Refuses what PyYAML takes in silence: names given twice, and aliases, by which a small file grows endless."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        keys = [key.value for key, _ in node.value]
        for key in keys:
            if keys.count(key) > 1:
                raise InputError(f"{key} is given twice")
        return super().construct_mapping(node, deep)

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise InputError("aliases (*name) are not allowed")
        return super().compose_node(parent, index)


def read_yaml(path: str | Path) -> Any:
    """Read a YAML or JSON file of at most 64 KiB, without aliases.

    Raises
    ------
    InputError
        If there is no such file, it is larger, it is not YAML, or a name is given twice.
    """
    text = read_text(path, LARGEST_FILE)
    try:
        return yaml.load(text, Loader=_Loader)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: it is not YAML: {' '.join(str(error).split())}") from None
