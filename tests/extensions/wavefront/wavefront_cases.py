"""A small telescope with its array in the focus, and its captures of stars."""

import numpy as np

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera

WAVELENGTH = 633.0
STAR = (0.0, 0.0, 1e9)
ACCURACY = 0.2


def telescope(lenses=8, pixels=6, width=4.0, **changes):
    """Return an f/50 telescope with its array in the focus, of lenses some lambda / D wide."""
    pitch = width * 633e-6 * 50
    return PlenopticCamera(
        focal_length=500.0, aperture_radius=5.0, mla_distance=500.0, mla_pitch=pitch, mla_focal_length=45 * pitch,
        detector_width=lenses * pitch, resolution=(lenses * pixels,) * 2, **changes,
    )  # fmt: skip


def captured(camera, points, photons, terms=()):
    """Return the capture of stars of a total of some photons, with the noise of these."""
    operator = CaptureOperator(camera.replace(wavefront=terms), points, wavelength=WAVELENGTH, accuracy=ACCURACY)
    image = np.maximum(operator.forward(np.ones(len(points))), 0).astype(np.float64)
    return np.random.default_rng(5).poisson(image * photons / image.sum()).astype(np.float64)
