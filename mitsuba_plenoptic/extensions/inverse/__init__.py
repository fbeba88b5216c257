"""Extension `inverse`: fits to captures, stored sums of points, derivatives of refocusing, searches, PyTorch and JAX.

Derivatives of refocusing need the extension `deconvolution`.
"""

from ...extension import Extension

EXTENSION = Extension(
    names={
        f"refocus.{name}": f"differentiable:{name}" for name in ("CoherentRefocus", "DeconvolvedRefocus", "RayRefocus")
    },
    modules={name: name for name in ("fitting", "optimisation", "array_functions", "scene_functions", "torch", "jax")},
    commands={"fit": "fit_command"},
)
