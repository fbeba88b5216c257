"""Extension `laser`: captures of coherent and partially coherent light."""

from ...extension import Extension

EXTENSION = Extension(
    modules={"laser": "laser"},
    plugins={"plenoptic_laser": ("laser_integrator", "integrator")},
)
