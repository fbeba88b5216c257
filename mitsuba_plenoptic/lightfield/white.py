"""The white image of a camera, computed: each pixel's share of the open pupil."""

from __future__ import annotations

import math

import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics.pupil import PupilFraction
from ..runtime.limits import require_memory
from .grid import LensGrid, lens_types, micro_image_centres

# Micro-images drawn at once.
_BLOCK = 128

# Pixels of micro-images, an hour.
_MOST_WORK = 3e10


def white_image(camera: PlenopticCamera, grid: LensGrid | None = None) -> np.ndarray:
    """Compute what a camera records of a scene of uniform radiance 1.

    The value of a pixel is its `PupilFraction`; where micro-images overlap, their light adds.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    grid : LensGrid, optional
        Micro-image centres; default those of the camera, with the ones beyond the image that reach into it.

    Returns
    -------
    (rows, columns) float32 array

    Raises
    ------
    InputError
        If micro-images are so wide or so much out of focus that it would take an hour, or too much memory.
    """
    kinds = [PupilFraction(camera, kind) for kind in range(len(camera.mla_focal_lengths))]
    half = math.ceil(max(share.reach for share in kinds) / camera.pupil_step)
    rows, columns = camera.shape
    require_memory(
        4.0 * (rows + 2 * half) * (columns + 2 * half) + 100.0 * _BLOCK * (2 * half + 1) ** 2,
        f"white image of {columns} x {rows} pixels, {2 * half + 1} x {2 * half + 1} for each lens",
    )
    if grid is None:
        centres = micro_image_centres(camera, half)
    else:
        centres = grid.centres().reshape(-1, 2)
        # Those whose micro-image reaches the detector.
        centres = centres[((centres > -half) & (centres < [columns + half, rows + half])).all(1)]
    work = float(len(centres)) * (2 * half + 1) ** 2
    if not work <= _MOST_WORK:
        raise InputError(
            f"camera: its white image takes {work:.2g} evaluations, at most {_MOST_WORK:.2g} are made: the images of "
            f"{len(centres)} lenses are up to {2 * half + 1} pixels wide"
        )
    image = np.zeros((rows + 2 * half, columns + 2 * half), dtype=np.float32)
    window = np.arange(-half, half + 1)
    for row in np.array_split(centres, -(-len(centres) // _BLOCK) or 1):
        base = np.floor(row).astype(np.int64)
        # Pupil coordinates that each pixel sees through its lens's centre, but for their sign.
        x, y = ((base[:, axis, None] + window + 0.5 - row[:, axis, None]) * camera.pupil_step for axis in (0, 1))
        share = np.zeros((len(base), window.size, window.size), dtype=np.float32)
        kind = lens_types(camera, row)
        for number, pupil in enumerate(kinds):
            share[kind == number] = pupil(x[kind == number, None, :], y[kind == number, :, None])
        down = base[:, 1, None, None] + window[:, None] + half
        across = base[:, 0, None, None] + window + half
        keep = (down >= 0) & (down < image.shape[0]) & (across >= 0) & (across < image.shape[1])
        keep &= share > 0
        place = (down * image.shape[1] + across)[keep]
        first = place.min(initial=image.size)
        added = np.bincount(place - first, weights=share[keep])
        image.reshape(-1)[first : first + added.size] += added
    return image[half : half + rows, half : half + columns]
