"""What the cases of speed share: their table, a row of two timings, a beam, and points of scenes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, load_scene
from mitsuba_plenoptic.points.pupil_weights import PupilWeights
from mitsuba_plenoptic.points.scene_points import find_points
from mitsuba_plenoptic.scene.radiance import SceneLight
from mitsuba_plenoptic.waves.accuracy import DEFAULT_ACCURACY

WAVELENGTH = 633.0
SPEED = {
    "what": "{what}", "unit": "{unit}", "ours": "{ours:.3g}", "against": "{against}", "theirs": "{theirs:.3g}",
    "ratio": "{ratio:.3g}", "CPU ratio": "{cpu_ratio:.3g}", "difference": "{difference:.0e}", "note": "{note}",
}  # fmt: skip


def beam(size: int, turns: tuple[int, int] = (9, -14)) -> np.ndarray:
    """Make a beam with turns of phase across the window, far from its edges: padded or not, its step is the same."""
    x = (np.arange(size) - size // 2) / size
    along_x, along_y = (
        np.exp(-((x - centre) ** 2) / 0.004 + 2j * np.pi * each * x).astype(np.complex64)
        for centre, each in zip((0.03, -0.02), turns, strict=True)
    )
    return along_y[:, None] * along_x


_STILL_LIFE = {"resolution": "1024", "detector_width": "2.048"}

SCENES = {"letters": {}, "still_life": _STILL_LIFE}


@dataclass(frozen=True)
class ScenePoints:
    """Points of a scene before a camera, their weights and what they see of the pupil."""

    camera: PlenopticCamera
    positions: np.ndarray
    weights: np.ndarray
    pupil_weights: PupilWeights | None

    @classmethod
    def of(cls, scene_name: str, parameters: dict[str, str]) -> ScenePoints:
        """Find them."""
        scene = load_scene(scene_name, parameters=parameters)
        sensor = scene.sensors()[0]
        camera = PlenopticCamera.from_sensor(sensor)
        found = find_points([SceneLight(scene, sensor, mi.load_dict({"type": "path"}))], camera, 64, seed=1, paths=4)
        return cls(camera, found.positions, found.weights[:, 0], found.pupil_weights)

    def take(self, which: Any) -> ScenePoints:
        """Return some of them."""
        pupil_weights = self.pupil_weights and self.pupil_weights.take(which)
        return ScenePoints(self.camera, self.positions[which], self.weights[which], pupil_weights)

    def operator(self, accuracy: float = DEFAULT_ACCURACY) -> CaptureOperator:
        """Return the operator of their capture, with nothing planned yet."""
        return CaptureOperator(
            self.camera, self.positions, wavelength=WAVELENGTH, accuracy=accuracy, pupil_weights=self.pupil_weights
        )

    def __str__(self) -> str:
        columns, rows = self.camera.resolution
        return f"{columns} x {rows}, {len(self.positions)} points"
