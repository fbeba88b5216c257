"""Ten figures: what is slow, what takes memory, and how exact it is, at sizes that take seconds.

`tools/benchmark.py` and the accuracy scripts measure the same at full size, and write the tables of the documentation.
"""

from __future__ import annotations

import functools
import subprocess
import sys
from typing import Any

import mitsuba as mi
import numpy as np

import mitsuba_plenoptic as mp

SMALL = {"detector_width": 2.048, "resolution": 1024, "letter_scale": 0.25}
DISTANCES = (210.0, 240.0, 280.0)


@functools.cache
def letters(model: str = "ray") -> Any:
    """Render the letters before a quarter of the paper's camera."""
    mi.set_variant("llvm_ad_mono")
    return mp.render_capture(mp.load_scene("letters", parameters=SMALL), model=model, spp=16)


class Start:
    """1: how long the package takes to be imported."""

    timeout = 120

    def time_import(self) -> None:
        """Import it in a new process."""
        subprocess.run([sys.executable, "-c", "import mitsuba_plenoptic"], check=True)


class Captures:
    """2 to 5: time and memory of captures, and their energy."""

    timeout = 300

    def setup(self) -> None:
        """Load the scene, and compile its kernels."""
        letters()
        self.scene = mp.load_scene("letters", parameters=SMALL)

    def time_ray_capture(self) -> None:
        """Capture by rays."""
        mp.render_capture(self.scene, spp=64)

    def time_wave_capture(self) -> None:
        """Capture by waves."""
        mp.render_capture(self.scene, model="wave", spp=16)

    def peakmem_wave_capture(self) -> None:
        """Capture by waves."""
        mp.render_capture(self.scene, model="wave", spp=16)

    def track_wave_energy(self) -> float:
        """Return the energy of the capture by waves over that by rays."""
        return float(letters("wave").image.sum() / letters().image.sum())


class Reconstructions:
    """6 to 8: time of each method."""

    timeout = 300
    params = ("ray", "coherent", "partial")
    param_names = ("method",)

    def setup(self, method: str) -> None:
        """Render the capture."""
        self.capture = letters("wave")
        mp.reconstruct(self.capture, 240.0, method=method)

    def time_reconstruct(self, method: str) -> None:
        """Refocus to three distances."""
        mp.reconstruct(self.capture, DISTANCES, method=method)


class PointSpreads:
    """9: how far the quick route is from the reference."""

    timeout = 300

    def track_patch_error(self) -> float:
        """Return the relative difference (L2) of one point spread, out of focus and off the axis."""
        camera = mp.PlenopticCamera(detector_width=1.024, resolution=(512, 512))
        spreads = [
            mp.point_spread_function(camera, (0.1, -0.2, 215.0), wavelength=633.0, method=method)
            for method in ("patch", "full_field")
        ]
        return float(np.linalg.norm(spreads[0] - spreads[1]) / np.linalg.norm(spreads[1]))


class LightFields:
    """10: time of a depth map."""

    timeout = 300

    def setup(self) -> None:
        """Decode the capture."""
        self.lf = mp.decode(letters())

    def time_depth_map(self) -> None:
        """Find the depth of every bin."""
        mp.lightfield.depth_map(self.lf, 200.0, 300.0)
