"""The numbers that a calibration fits, as a camera and back.

A camera's detector is centred on the axis. A principal point elsewhere makes the full detector larger than what is
recorded of it: the crop window is where the real detector is.
"""

from __future__ import annotations

import numpy as np

from ..camera import PlenopticCamera
from ..camera.vector import parts_of, with_parts
from .model import AT, CALIBRATED

_PRINCIPAL = [AT["principal_u"], AT["principal_v"]]


def on_pixel_grid(numbers: np.ndarray) -> np.ndarray:
    """Return the numbers with the principal point moved to the nearest centre, edge or corner of a pixel."""
    moved = numbers.copy()
    moved[_PRINCIPAL] = np.round(2 * moved[_PRINCIPAL]) / 2
    return moved


def camera_of(numbers: np.ndarray, like: PlenopticCamera) -> PlenopticCamera:
    """Return the camera of these numbers, with a principal point `on_pixel_grid`.

    What they do not determine is as in `like`: recorded pixels and their size, f-number, lattice, apertures and focal
    lengths of the microlenses, and how rays refract.
    """
    ends = np.cumsum([len(parts_of(like, name)) for name in CALIBRATED])
    *rest, beyond = np.split(numbers, ends)
    parts, focal_length = dict(zip(CALIBRATED, rest, strict=True)), numbers[AT["focal_length"]]
    parts |= {"distortion": beyond[2:], "aperture_radius": np.array([focal_length / (2 * like.f_number)])}
    offset, parts["mla_offset"] = parts["mla_offset"], np.zeros(2)
    resolution, crop = [], []
    for pixels, principal in zip(like.crop_size, numbers[_PRINCIPAL], strict=True):
        # Twice the distance of the axis from the first pixel's edge.
        twice = round(2 * principal) + 1
        crop.append(max(0, pixels - twice))
        resolution.append(max(twice, 2 * pixels - twice))
    camera = with_parts(
        like,
        parts,
        detector_width=like.pixel_size * resolution[0],
        resolution=tuple(resolution),
        crop_offset=tuple(crop),
        crop_size=like.crop_size,
    )
    return with_parts(camera, {"mla_offset": offset - camera.lattice.centre(0.0, 0.0)})


def numbers_of(camera: PlenopticCamera) -> np.ndarray:
    """Return a camera's numbers, in the order of `NAMES`."""
    parts = {name: parts_of(camera, name) for name in CALIBRATED} | {"mla_offset": camera.lattice.centre(0.0, 0.0)}
    principal = [(size - 1) / 2 - offset for size, offset in zip(camera.resolution, camera.crop_offset, strict=True)]
    return np.concatenate([*parts.values(), principal, camera.distortion])
