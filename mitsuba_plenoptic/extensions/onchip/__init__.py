"""Extension `onchip`: on-chip lenses over two by two photodiodes, their responses, pictures and disparities.

Banks of point spreads by rays (`psf_bank`) need the extension `inverse`.
"""

from ...extension import Extension

EXTENSION = Extension(
    modules={"onchip": "onchip"},
    commands={"dual": "dual_command"},
    parameters={"photodiode_response": "parameter:PHOTODIODE_RESPONSE"},
    responses={"photodiode_response": "photodiode_table:PhotodiodeTable"},
    presets=dict.fromkeys(("full_frame_dual", "phone_quad", "phone_quad_bayer"), "cameras:CAMERAS"),
    hooks={"small lenses": "responses:ResponseCapture"},
)
