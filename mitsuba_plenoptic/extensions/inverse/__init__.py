"""Extension `inverse`: fits of cameras and layers to captures, searches of designs, PyTorch and JAX."""

from ...extension import Extension

EXTENSION = Extension(
    names={"fitting": ("fit",)},
    modules={name: name for name in ("fitting", "optimisation", "array_functions", "scene_functions", "torch", "jax")},
    commands={"fit": "fit_command"},
)
