"""Start values of a fit from the data."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lightfield.grid_estimation import estimate_lens_grid


def lattice_from_white(camera: PlenopticCamera, white: Any) -> PlenopticCamera:
    """Return a camera with the pitches, the angle and the offset of its microlens array taken from a white capture.

    Parameters
    ----------
    camera : PlenopticCamera
        What is known of the camera: its distances tell how much closer than their micro-images the lenses stand, and
        its lattice which of all equal ones is meant: the one whose axis and angle are nearest.
    white : array (rows, columns)
        A capture of something evenly white.

    Raises
    ------
    InputError
        If the image shows no lattice.
    """
    centres = estimate_lens_grid(white).centres().reshape(-1, 2)
    shrunk = camera.pupil_distance / (camera.pupil_distance + camera.detector_distance)
    middle = np.array(camera.resolution) / 2
    place = (centres + camera.crop_offset - middle) * (camera.pixel_size * shrunk)
    distance = np.hypot(*place.T)
    reach, found = 3 * max(camera.mla_pitches), camera
    while True:
        # From the axis outwards, so that what is wrong of the start does not count in whole lenses.
        found = _fitted(found, place[distance <= reach])
        if reach > distance.max():
            return found
        reach *= 1.5


def _fitted(camera: PlenopticCamera, place: NDArray[np.float64]) -> PlenopticCamera:
    """Return the camera whose nearest lenses are at these places."""
    lattice = camera.lattice
    i, j = lattice.cell(*place.T)
    u, v = (np.asarray(part, np.float64) for part in lattice.unit_centre(i, j))
    v = v * lattice.row_ratio
    x, y = place.T
    one, none = np.ones(len(place)), np.zeros(len(place))
    # Steps (a, b) along the rows and q (-b, a) across them, of which the ratio q of the pitches is refined in turn.
    ratio = camera.mla_pitches[1] / camera.mla_pitches[0]
    for _ in range(8):
        rows = np.concatenate(
            [np.stack([u, -ratio * v, one, none], 1), np.stack([ratio * v, u, none, one], 1)],
        )
        (a, b, left, up), *_ = np.linalg.lstsq(rows, np.concatenate([x, y]), rcond=None)
        if np.ndim(camera.to_dict()["mla_pitch"]) == 0:
            break
        across = (x - left - a * u) * -b + (y - up - b * u) * a
        ratio = float((across * v).sum() / ((a * a + b * b) * (v * v).sum()))
    pitch = math.hypot(a, b)
    return camera.replace(
        mla_pitch=pitch if ratio == 1 else (pitch, ratio * pitch),
        mla_rotation=math.degrees(math.atan2(b, a)),
        mla_offset=(float(left), float(up)),
    )
