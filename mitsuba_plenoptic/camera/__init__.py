"""A plenoptic camera: the table of its parameters, their checks and forms, and commonly used derived quantities.

Further derived quantities are in `mitsuba_plenoptic.design`.
"""

from __future__ import annotations

from .plenoptic_camera import PlenopticCamera as PlenopticCamera
from .plenoptic_camera import require_camera as require_camera
