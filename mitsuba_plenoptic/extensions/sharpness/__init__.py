"""Extension `sharpness`: modulation transfer functions from slanted edges in images."""

from ...extension import Extension

EXTENSION = Extension(commands={"mtf": "mtf_command"})
