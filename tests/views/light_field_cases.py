"""Cameras that the tests of light fields share."""

import pytest
from cameras import OTHER

from mitsuba_plenoptic import PlenopticCamera

PAPER = PlenopticCamera(detector_width=1.024, resolution=(512, 512))
SQUARE = {
    "paper": PAPER,
    "crop": PAPER.replace(resolution=(500, 400), crop_offset=(70, 33), crop_size=(300, 290)),
    "other": PlenopticCamera(**OTHER, detector_distance=0.42, detector_width=1.0, resolution=(400, 300)),
}
LATTICES = {
    "hexagonal": {"mla_lattice": "hexagonal"},
    "hexagonal, upright": {"mla_lattice": "hexagonal", "mla_rotation": 90.0, "mla_aperture": "circle"},
    "turned": {"mla_rotation": 17.0, "mla_offset": (0.021, -0.008)},
    "moved": {"mla_offset": (0.021, -0.008)},
    "rectangular": {"mla_pitch": (0.064, 0.058)},
    "hexagonal, stretched": {"mla_lattice": "hexagonal", "mla_pitch": (0.058, 0.064), "mla_rotation": 7.0},
}
CAMERAS = SQUARE | {
    name: PlenopticCamera(detector_width=1.28, resolution=(640, 512), **lattice) for name, lattice in LATTICES.items()
}

square_cameras = pytest.mark.parametrize("camera", SQUARE.values(), ids=SQUARE)
all_cameras = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
