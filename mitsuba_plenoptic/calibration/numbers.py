"""The numbers that a calibration fits, as a camera and back.

A camera's detector is centred on the axis. A principal point elsewhere makes the full detector larger than what is
recorded of it: the crop window is where the real detector is.
"""

from __future__ import annotations

import numpy as np

from ..camera import PlenopticCamera
from .model import AT, NAMES

_PRINCIPAL = [AT["principal_u"], AT["principal_v"]]


def on_pixel_grid(numbers: np.ndarray) -> np.ndarray:
    """Return the numbers with the principal point moved to the nearest centre, edge or corner of a pixel."""
    moved = numbers.copy()
    moved[_PRINCIPAL] = np.round(2 * moved[_PRINCIPAL]) / 2
    return moved


def camera_of(numbers: np.ndarray, like: PlenopticCamera) -> PlenopticCamera:
    """Return the camera of these numbers, with a principal point `on_pixel_grid`.

    What they do not tell is as in `like`: recorded pixels and their size, f-number, lattice, apertures and focal
    lengths of the microlenses, and how rays refract.
    """
    value = dict(zip(NAMES, numbers.tolist(), strict=True))
    resolution, crop = [], []
    for pixels, principal in zip(like.crop_size, numbers[_PRINCIPAL], strict=True):
        # Twice the place of the axis from the first pixel's edge.
        twice = round(2 * principal) + 1
        crop.append(max(0, pixels - twice))
        resolution.append(max(twice, 2 * pixels - twice))
    pitches = value["pitch_along"], value["pitch_across"]
    camera = like.replace(
        focal_length=value["focal_length"],
        aperture_radius=value["focal_length"] / (2 * like.f_number),
        mla_distance=value["mla_distance"],
        detector_distance=value["detector_distance"],
        mla_pitch=pitches,
        mla_rotation=value["mla_rotation"],
        mla_tilt=(value["tilt_x"], value["tilt_y"]),
        mla_offset=(0.0, 0.0),
        detector_width=like.pixel_size * resolution[0],
        resolution=tuple(resolution),
        crop_offset=tuple(crop),
        crop_size=like.crop_size,
        distortion=tuple(numbers[12:].tolist()),
    )
    x, y = camera.lattice.centre(0.0, 0.0)
    return camera.replace(mla_offset=(value["offset_x"] - x, value["offset_y"] - y))


def numbers_of(camera: PlenopticCamera) -> np.ndarray:
    """Return a camera's numbers, in the order of `NAMES`."""
    principal = [(size - 1) / 2 - offset for size, offset in zip(camera.resolution, camera.crop_offset, strict=True)]
    return np.array(
        [
            camera.focal_length,
            camera.mla_distance,
            camera.detector_distance,
            *camera.mla_pitches,
            camera.mla_rotation,
            *camera.lattice.centre(0.0, 0.0),
            *camera.mla_tilt,
            *principal,
            *camera.distortion,
        ]
    )
