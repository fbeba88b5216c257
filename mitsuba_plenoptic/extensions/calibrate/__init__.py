"""Extension `calibrate`: a real camera's parameters from pictures of boards and white pictures.

Centres of LFToolbox need the extension `raw`.
"""

from ...extension import Extension

EXTENSION = Extension(
    names={"calibration": ("calibrate",)},
    modules={"calibration": "calibration"},
    cameras={"libpleno": "calibrated_cameras:libpleno_camera"},
    commands={"calibrate": "calibrate_command"},
)
