"""A plenoptic camera: the table of its parameters, their checks and forms, and commonly used derived quantities.

Further derived quantities are in `mitsuba_plenoptic.design`.
"""

from __future__ import annotations

from .geometry import has_small_lenses as has_small_lenses
from .plenoptic_camera import PlenopticCamera as PlenopticCamera
from .plenoptic_camera import are_alike as are_alike
from .plenoptic_camera import film_numbers as film_numbers
from .plenoptic_camera import require_camera as require_camera
