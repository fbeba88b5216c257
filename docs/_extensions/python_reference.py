"""The Python reference: a summary of each module, links of types, and links to the pages that use a function."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from mitsuba_plenoptic.errors import InputError

DOCS = Path(__file__).resolve().parents[1]

ELSEWHERE = {
    "mitsuba.Scene": "https://mitsuba.readthedocs.io/en/stable/src/api_reference.html#mitsuba.Scene",
    "numpy.ndarray": "https://numpy.org/doc/stable/reference/generated/numpy.ndarray.html",
    "xarray.DataArray": "https://docs.xarray.dev/en/stable/generated/xarray.DataArray.html",
    "xarray.Dataset": "https://docs.xarray.dev/en/stable/generated/xarray.Dataset.html",
}
"""Types of other packages, and their pages; the site is built without a network, so that Sphinx cannot look them up."""

FEW = 3
"""Members of a module that need no summary."""


@cache
def pages() -> dict[str, str]:
    """Return the texts of the pages that show how things are used, by their names as documents."""
    texts = {}
    for path in [*sorted((DOCS / "start").glob("*.md")), *sorted((DOCS / "guides").rglob("*.md")), DOCS / "index.md"]:
        if path.stem not in ("index", "other_programs"):
            texts[path.relative_to(DOCS).with_suffix("").as_posix()] = path.read_text()
    return texts


def used_in(name: str) -> list[str]:
    """Return the pages whose code uses a function or a class, which has a full name."""
    module, _, last = name.rpartition(".")
    short = re.escape(name.removeprefix("mitsuba_plenoptic."))
    patterns = [rf"\bmp\.{short}\b", rf"from {re.escape(module)} import [^\n]*\b{last}\b"]
    if module != "mitsuba_plenoptic":
        # As in ``lightfield.view(lf)``, after the import of the module.
        patterns.append(rf"(?<![\w.]){re.escape('.'.join(name.split('.')[-2:]))}\(")
    found = re.compile("|".join(patterns))
    code = r"^```(?:\{code-cell\} |\{code-block\} )?python\n(.*?)^```"
    return [
        page
        for page, text in pages().items()
        if any(found.search(block) for block in re.findall(code, text, flags=re.MULTILINE | re.DOTALL))
    ]


def members(module: ModuleType) -> list[str]:
    """Return the public functions and classes of a module: those of its own if it does not list its names."""
    own = [name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__]
    listed = [name for name in getattr(module, "__all__", own) if not name.startswith("_")]
    return [
        name for name in listed if inspect.isclass(getattr(module, name)) or inspect.isroutine(getattr(module, name))
    ]


def _add_links(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Add a summary to a module's docstring, and the pages that use a function or a class to its own."""
    if what == "module" and options.get("members"):
        excluded = options.get("exclude-members") or ()
        names = [each for each in members(thing) if each not in excluded]
        if len(names) > FEW:
            lines += ["", ".. autosummary::", "   :nosignatures:", ""]
            lines += [f"   {each}" for each in sorted(names, key=str.lower)]
            lines.append("")
    # Types that are more than a word: Sphinx would take ``channels`` in a shape for the attribute of some class.
    lines[:] = [re.sub(r"^(:(?:var)?type [^:]+: )(.+)", _linked, line) for line in lines]
    lines[:] = [re.sub(r"^(:returns: )\*([^*]+)\*", _linked, line) for line in lines]
    if what in ("function", "class") and (found := used_in(name)):
        lines += ["", "**Used in:** " + ", ".join(f":doc:`/{page}`" for page in found), ""]


def _linked(found: re.Match[str]) -> str:
    """Mark the classes in a type, so that they alone become links."""
    return found[1] + re.sub(r"(?:[a-z]+\.)?[A-Z]\w+", r"`\g<0>`", found[2])


def _resolve(app: Any, env: Any, node: Any, content: Any) -> Any:
    """Find what a docstring calls by a short name, if only one thing of the reference ends in it."""
    from docutils import nodes
    from sphinx.util import logging
    from sphinx.util.nodes import make_refnode

    if node.get("refdomain") != "py" or node.get("reftype") not in ("obj", "class", "exc"):
        return None
    target = node["reftarget"]
    if target.startswith("mitsuba_plenoptic."):
        try:
            pkgutil.resolve_name(target)
        except (ImportError, AttributeError) as error:
            logging.getLogger(__name__).warning("%s: it does not exist: %s", target, error, location=node)
        except InputError:
            # A module whose extra is not installed.
            pass
    if target in ELSEWHERE:
        return nodes.reference("", "", content, refuri=ELSEWHERE[target], internal=False)
    domain = env.get_domain("py")
    target = target.removeprefix("mitsuba_plenoptic.")
    ends = [name for name in domain.objects if name == target or name.endswith(f".{target}")]
    if "." not in target:
        # A word such as ``path`` is a parameter, not the attribute of some class.
        ends = [name for name in ends if domain.objects[name].objtype not in ("attribute", "method", "property")]
    if len(ends) != 1:
        return None
    found = domain.objects[ends[0]]
    return make_refnode(app.builder, node.get("refdoc", ""), found.docname, found.node_id, content, ends[0])


def setup(app: Any) -> dict[str, Any]:
    """Register with Sphinx."""
    importlib.import_module("mitsuba_plenoptic")
    # After the sections of NumPy docstrings have been read, which end where other text begins.
    app.connect("autodoc-process-docstring", _add_links, priority=900)
    app.connect("missing-reference", _resolve)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
