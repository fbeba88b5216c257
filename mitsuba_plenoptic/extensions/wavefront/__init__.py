"""Extension `wavefront`: wavefronts from captures, far sources of light, and elements of HCIPy.

Fits need the extension `inverse`.
"""

from ...extension import Extension

EXTENSION = Extension(modules={"wavefront": "wavefront", "far_sources": "far_sources", "hcipy": "hcipy"})
