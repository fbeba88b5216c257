"""YAML, and JSON as a part of it, from anyone."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from ..errors import InputError
from .files import read_text

LARGEST_FILE = 2**16


class _Loader(yaml.SafeLoader):
    """YAML as version 1.2 and JSON have it, without what is easily mistaken.

    PyYAML reads version 1.1, in which 1e-05 is text, 010 is 8, 1:30 is 90 and `no` is false. Names given twice, and
    aliases, by which a small file grows endless, are refused.
    """

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


# The scalars of the core schema of YAML 1.2 (section 10.3.2), without octal and hexadecimal numbers.
_Loader.yaml_implicit_resolvers = {}
for _kind, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", list("-+.")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(rf"^(?:{_pattern})$"), _first)
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node)))


def read_yaml(path: str | Path) -> Any:
    """Read a YAML or JSON file of at most 64 KiB, without aliases."""
    text = read_text(path, LARGEST_FILE)
    try:
        return yaml.load(text, Loader=_Loader)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: it is not YAML: {' '.join(str(error).split())}") from None
