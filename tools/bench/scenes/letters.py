"""Points of the letters."""

from __future__ import annotations

import numpy as np

from mitsuba_plenoptic import PlenopticCamera, load_scene
from mitsuba_plenoptic.lenses.common import main_lens
from mitsuba_plenoptic.points.scene_points import find_points
from mitsuba_plenoptic.points.units import radiance_weight
from mitsuba_plenoptic.scene.radiance import SceneLight


def letter_points(camera: PlenopticCamera, scale: float, per_lens: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays from each lens first hit the scaled letters, and the light of these points: 1 for a lens."""
    given = {
        "resolution": str(camera.resolution[0]),
        "detector_width": str(camera.detector_width),
        "letter_scale": str(scale),
    }
    scene = load_scene("letters", parameters=given)
    light = SceneLight(scene, scene.sensors()[0], scene.integrator())
    found = find_points([light], camera, per_lens, seed=0, paths=1)
    return found.positions, found.weights[:, 0] / radiance_weight(camera, main_lens(camera), camera.lattice.cell_area)
