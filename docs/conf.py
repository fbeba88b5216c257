"""Configuration of the site, which `make docs` builds with Sphinx; EXECUTE=off leaves the notebooks unexecuted."""

from __future__ import annotations

import importlib.util
import os
import sys
import tomllib
from pathlib import Path

import scipy.stats  # noqa: F401  # before torch is mocked, for whose tensors SciPy looks when this is imported
from sphinx.ext.autodoc.mock import _MockObject

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE / "_extensions"))
PROJECT = tomllib.loads((HERE.parent / "pyproject.toml").read_text())["project"]

project = "mitsuba_plenoptic"
author = "The mitsuba_plenoptic developers"
copyright = author
release = PROJECT["version"]
version = ".".join(release.split(".")[:2])

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "myst_nb",
    "sphinx_design",
    "sphinx_copybutton",
    "generated_reference",
    "picture_texts",
    "python_reference",
]
# The reference of the modules for them needs no PyTorch or JAX.
autodoc_mock_imports = ["hcipy", "jax", "torch"]
# Rules of derivatives are entered into JAX's tables.
_MockObject.__setitem__ = lambda *_: None  # type: ignore[attr-defined]
exclude_patterns = ["_extensions", "**/.ipynb_checkpoints"]
default_role = "py:obj"

# The site works without a network: its fonts are the reader's, MathJax is among its files.
html_theme = "furo"
html_title = f"mitsuba_plenoptic {release}"
MATHJAX = importlib.util.find_spec("sphinx-mathjax-offline").submodule_search_locations[0]
html_static_path = ["_static", f"{MATHJAX}/static"]
mathjax_path = "mathjax/tex-chtml.js"
html_css_files = ["site.css"]
SOURCE = PROJECT.get("urls", {}).get("Source")
html_theme_options = (
    {"source_repository": SOURCE, "source_branch": "main", "source_directory": "docs/"} if SOURCE else {}
)
html_copy_source = False
html_show_sphinx = False

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "amsmath"]
myst_heading_anchors = 3
myst_links_external_new_tab = False

# Quotation marks and ellipses are set, but two hyphens stay: they begin the command's options.
smartquotes_action = "qe"

nb_execution_mode = {"on": "force", "off": "off"}[os.environ.get("EXECUTE", "on")]
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "none"
autodoc_default_options = {"members": True, "imported-members": True, "show-inheritance": False}
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos, .gp, .go"
