"""Scripts that set up and check, and the measurements of `tools.bench`; no part of the installed package."""
