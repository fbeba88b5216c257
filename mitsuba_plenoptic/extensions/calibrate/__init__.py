"""Extension `calibrate`: a real camera's parameters from pictures of boards, white pictures and dark ones.

Centres of LFToolbox need the extension `raw`.
"""

from ...extension import Extension

EXTENSION = Extension(
    modules={"calibration": "calibration"},
    hooks={"libpleno": "calibrated_cameras:libpleno_camera"},
    commands={
        f"calibrate {step}": "calibrate_command" for step in ("centres", "corners", "boards", "white", "evaluate")
    },
)
