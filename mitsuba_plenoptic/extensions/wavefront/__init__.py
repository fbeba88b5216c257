"""Extension `wavefront`: wavefronts from captures, and elements of HCIPy.

Searches need the extensions `inverse` and `deconvolution`.
"""

from ...extension import Extension

EXTENSION = Extension(modules={"wavefront": "wavefront", "hcipy": "hcipy"})
