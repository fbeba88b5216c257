"""What notebooks show of captures, reconstructions and cameras, which pages of `report` draw.

They are below `report`, which is therefore looked up when a notebook asks.
"""

from __future__ import annotations

import importlib
from typing import Any


def report_module(name: str) -> Any:
    """Return a module of `report`, imported on first use."""
    return importlib.import_module(f"{__package__.partition('.')[0]}.report.{name}")


class Displayed:
    """A class whose objects notebooks show with a picture or a table."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return str(report_module("thumbnails").thumbnail(self))
