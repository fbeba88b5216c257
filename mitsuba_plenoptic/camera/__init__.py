"""A plenoptic camera: the table of its parameters, their checks and forms, and the few numbers that most code derives.

What else follows from them is in `mitsuba_plenoptic.design`.
"""

from __future__ import annotations

from .plenoptic_camera import PlenopticCamera as PlenopticCamera
from .plenoptic_camera import require_camera as require_camera
