"""Extension `inverse`: fits to captures, stored sums of points, derivatives of refocusing, searches, PyTorch and JAX.

Derivatives of refocusing need the extension `deconvolution`.
"""

from ...extension import Extension

EXTENSION = Extension(
    names={
        "fitting": ("fit",),
        "stored": ("StoredOperator",),
        "volume_points": ("volume_points",),
        "differentiable": ("refocus.CoherentRefocus", "refocus.DeconvolvedRefocus", "refocus.RayRefocus"),
    },
    modules={name: name for name in ("fitting", "optimisation", "array_functions", "scene_functions", "torch", "jax")},
    commands={"fit": "fit_command"},
)
