"""Plain numbers of a plenoptic camera: their checks, their forms, and the few others that nearly everything uses.

What else follows from them is in `mitsuba_plenoptic.design`.
"""

from __future__ import annotations

from .plenoptic_camera import PlenopticCamera as PlenopticCamera
from .plenoptic_camera import require_camera as require_camera
