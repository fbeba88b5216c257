"""Extension `sharpness`: modulation transfer functions from slanted edges in images."""

from ...extension import Extension

EXTENSION = Extension(names={"sharpness": ("EdgeSharpness", "edge_sharpness")}, commands={"mtf": "mtf_command"})
