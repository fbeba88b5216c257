"""Points through cameras of many kinds: patches are full fields, derivatives are differences."""

import numpy as np
import pytest
from cameras import CAMERAS, WAVELENGTH, capture, error, seen_by

from mitsuba_plenoptic import CaptureOperator
from mitsuba_plenoptic.camera import shortest_parts
from tools.bench.cases.derivatives import STEP, difference


@pytest.mark.parametrize("name", ["microscope", "real"])
def test_patches_are_full_fields(name):
    """Behind real main lenses; a relation compares them behind others."""
    patch, full = (
        capture(CAMERAS[name], seen_by(name), [1.0, 2.0], accuracy=accuracy, method=method)
        for method, accuracy in (("patch", 0), ("full_field", None))
    )
    assert patch.shape == full.shape == CAMERAS[name].shape
    assert patch.dtype == np.float32 and patch.min() >= 0
    assert error(patch, full) < 0.005


SLOPES = {
    "aperture_radius": 0.015,
    # Differences of full fields round the edges of hexagonal lenses: 0.03, and 0.006 for circles and squares.
    "mla_fill": 0.035,
}
PAIRS = [
    ("square", "aperture_radius"), ("cropped", "detector_width"), ("square", "focal_length"), ("square", "wavefront"),
    ("gaps", "detector_distance"), ("medium", "mla_distance"), ("turned", "mla_pitch"),
    ("circles", "mla_fill"), ("stretched", "mla_rotation"), ("three focal lengths", "mla_focal_length"),
    ("three focal lengths", "mla_offset"), ("medium", "detector_distance"), ("real", "focal_length"),
    ("real", "aperture_radius"),
]  # fmt: skip


def small(name):
    """Return a camera with half as many lenses across."""
    camera = CAMERAS[name]
    if name in ("cropped", "microscope"):
        return camera
    halved = tuple(count // 2 for count in camera.resolution)
    return camera.replace(detector_width=camera.detector_width / 2, resolution=halved)


@pytest.mark.slow
@pytest.mark.parametrize(("camera", "name"), PAIRS)
def test_points(camera, name):
    """Differences of the operator's own images miss by up to 14 %, as its grids of samples follow the camera.

    They jump with sizes of transforms, and light that they fold back changes as fast as the pitch and the rotation.
    Derivatives keep the grids, and have twice as many samples; differences of the full field hold its grids, too.
    """
    start, (point, _) = small(camera), seen_by(camera)
    if name == "mla_fill":
        # Lenses that touch can not grow.
        start = start.replace(mla_fill=min(start.mla_fill, 0.95))
    last = np.eye(15 if name == "wavefront" else len(shortest_parts(start, name)))[-1]
    operator = CaptureOperator(start, [point], wavelength=WAVELENGTH, accuracy=0)
    change = operator.derivative([1.0], {name: last})
    step = STEP * np.linalg.norm(operator.forward([1.0])) / np.linalg.norm(change)
    assert error(change, difference(start, point, name, last, step, finer=1.0, window=1.5)) < SLOPES.get(name, 0.008)
