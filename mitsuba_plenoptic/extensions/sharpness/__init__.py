"""Extension `sharpness`: modulation transfer functions from slanted edges in images."""

from ...extension import Extension

EXTENSION = Extension(
    commands={
        "mtf": ("mtf_command", "Measure the modulation transfer function from one slanted edge in a refocused image."),
    },
)
