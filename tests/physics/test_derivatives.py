"""Derivatives of captures by numbers of the camera are their differences, for every kind of camera."""

import numpy as np
import pytest
from cameras import CAMERAS, WAVELENGTH, error, seen_by

from mitsuba_plenoptic import CaptureOperator

STEPS = {
    "focal_length": 4e-3,
    "mla_distance": 4e-3,
    "mla_focal_length": 5e-4,
    "mla_pitch": 7e-5,
    "mla_offset": 1e-4,
    "mla_rotation": 0.1,
    "mla_fill": 2e-3,
    "detector_distance": 2e-4,
    "detector_width": 8e-4,
    "aperture_radius": 0.027,
    "wavefront": 4e-3,
}
LIMITS = {
    "mla_pitch": 0.02,
    "detector_distance": 0.02,
    "aperture_radius": 0.02,
    "mla_fill": 0.04,
}
QUICK = [
    ("square", "focal_length"),
    ("square", "aperture_radius"),
    ("square", "wavefront"),
    ("medium", "mla_distance"),
    ("turned", "mla_pitch"),
    ("cropped", "detector_width"),
]


def small(name):
    """Return a camera with half as many lenses across."""
    camera = CAMERAS[name]
    if name in ("cropped", "microscope"):
        return camera
    halved = tuple(count // 2 for count in camera.resolution)
    return camera.replace(detector_width=camera.detector_width / 2, resolution=halved)


def changed(camera, name, amount):
    """Return the camera with the last number of a parameter changed, and the change by one."""
    given = camera.mla_focal_lengths if name == "mla_focal_length" else getattr(camera, name)
    start = np.atleast_1d(np.asarray(given, float))
    if name == "wavefront":
        start = np.pad(start, (0, 15 - len(start)))
    unit = np.eye(len(start))[-1]
    value = start + amount * unit
    # The detector stays where it stands, whatever focal length its distance follows.
    values = {"detector_distance": camera.detector_distance, name: tuple(value) if len(value) > 1 else value[0]}
    return camera.replace(**values), unit if len(unit) > 1 else 1.0


@pytest.mark.parametrize(
    ("camera", "name"),
    [
        *QUICK,
        pytest.param("gaps", "detector_distance", marks=pytest.mark.slow),
        *(
            pytest.param(camera, name, marks=pytest.mark.slow)
            for camera in ("square", "circles", "stretched", "three focal lengths", "medium", "real")
            for name in STEPS
            # Surfaces of a real lens have their own aberrations.
            if (camera, name) not in (*QUICK, ("real", "wavefront"))
        ),
    ],
)
def test_points(camera, name):
    start, points, weights = small(camera), seen_by(camera)[:1], [1.0]
    if name == "mla_fill":
        # Lenses that touch can not grow.
        start = start.replace(mla_fill=min(start.mla_fill, 0.95))
    _, unit = changed(start, name, 0.0)
    up, down = (
        CaptureOperator(changed(start, name, step)[0], points, wavelength=WAVELENGTH, accuracy=0).forward(weights)
        for step in (STEPS[name], -STEPS[name])
    )
    operator = CaptureOperator(start, points, wavelength=WAVELENGTH, accuracy=0)
    expected = (up.astype(float) - down) / (2 * STEPS[name])
    assert error(operator.derivative(weights, {name: unit}), expected) < LIMITS.get(name, 0.01)
