"""Figures about captures and reconstructions: design sheets, pictures, comparisons."""

import importlib
from typing import Any


def __getattr__(name: str) -> Any:
    # The libraries of figures take a third of a second to load, which few commands need.
    if name == "plots":
        return importlib.import_module(".plots", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
