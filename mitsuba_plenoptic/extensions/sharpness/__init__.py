"""Extension `sharpness`: the command that measures modulation transfer functions from slanted edges."""

from ...extension import Extension

EXTENSION = Extension(commands={"mtf": "mtf_command"})
