"""Extension `prediction`: pixels of a real light field that are predicted from the others, by rays and by waves.

Cameras are fitted by the extension `calibrate`.
"""

from ...extension import Extension

EXTENSION = Extension(hooks={"--real": "real_command:compare_real"})
