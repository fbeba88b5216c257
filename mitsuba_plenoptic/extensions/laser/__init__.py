"""Extension `laser`: fields of coherent points, and captures of coherent and partially coherent light."""

from ...extension import Extension

EXTENSION = Extension(
    modules={"laser": "laser"},
    plugins={"plenoptic_laser": ("laser_integrator", "integrator")},
    hooks={"coherent fields": "coherent:CoherentFields"},
)
