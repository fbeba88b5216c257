"""The white image of a camera, computed: the fraction of what each pixel sees that the pupil leaves open."""

from __future__ import annotations

import math

import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import rays
from ..optics.pupil import PupilFraction
from ..runtime.limits import require_memory
from .grid import LensGrid, lens_types, micro_image_centres

# Micro-images drawn at once.
_BLOCK = 128

# Lenses of a tilted array whose heights differ by less, in detector distances, are blurred alike.
_ALIKE = 0.01

# Pixels of micro-images, an hour.
_MOST_WORK = 3e10


def white_image(camera: PlenopticCamera, grid: LensGrid | None = None) -> np.ndarray:
    """Compute what a camera records of a scene of uniform radiance 1.

    The value of a pixel is its `PupilFraction`; where micro-images overlap, their light adds. Each lens of a tilted
    array has its own distances; distortion changes nothing, as rays keep their place on the pupil.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    grid : LensGrid, optional
        Micro-image centres; default those of the camera, with the ones beyond the image that reach into it, displaced
        as its tilt has it.

    Returns
    -------
    (rows, columns) float32 array

    Raises
    ------
    InputError
        If micro-images are so wide or so much out of focus that it would take an hour, or too much memory.
    """
    camera.require_thin("white images are computed")
    fractions = _Fractions(camera)
    half = fractions.half
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
        height = fractions.heights(row)
        if grid is None and any(camera.mla_tilt):
            # Where the tilt has moved them: c (b + z) / (b - h).
            middle = np.array(camera.resolution) / 2 - camera.crop_offset
            row = middle + (row - middle) / (1 - height[:, None] / camera.mla_distance)
        base = np.floor(row).astype(np.int64)
        # Places of the pupil that each pixel sees through its lens's centre, but for their sign.
        step = camera.pixel_size * (camera.mla_distance - height) / (camera.detector_distance + height)
        x, y = ((base[:, axis, None] + window + 0.5 - row[:, axis, None]) * step[:, None] for axis in (0, 1))
        fraction = fractions(lens_types(camera, row), height, x, y)
        down = base[:, 1, None, None] + window[:, None] + half
        across = base[:, 0, None, None] + window + half
        keep = (down >= 0) & (down < image.shape[0]) & (across >= 0) & (across < image.shape[1])
        keep &= fraction > 0
        place = (down * image.shape[1] + across)[keep]
        first = place.min(initial=image.size)
        added = np.bincount(place - first, weights=fraction[keep])
        image.reshape(-1)[first : first + added.size] += added
    return image[half : half + rows, half : half + columns]


class _Fractions:
    """The `PupilFraction` of lenses of all types and heights.

    Attributes
    ----------
    half : int
        Pixels from a micro-image's centre, along x or y, beyond which it is dark.
    """

    def __init__(self, camera: PlenopticCamera) -> None:
        self._camera = camera
        self._slopes = np.tan(np.deg2rad(camera.mla_tilt))
        self._step = _ALIKE * camera.detector_distance
        self._tables: dict[tuple[int, int], PupilFraction] = {}
        reach = max(math.hypot(*(camera.pixel_coordinates(axis)[end] for axis in (0, 1))) for end in (0, -1))
        rise = round(reach * math.hypot(*self._slopes) / self._step)
        pixels = [
            self._table(lens_type, level).reach / self._at(level).pupil_step
            for lens_type in range(len(camera.mla_focal_lengths))
            for level in {-rise, rise}
        ]
        self.half = math.ceil(max(pixels))

    def heights(self, centres: np.ndarray) -> np.ndarray:
        """Return by how much the lenses of micro-images (n, 2) stand nearer to the main lens than one on the axis."""
        camera = self._camera
        p = (centres + camera.crop_offset - np.array(camera.resolution) / 2) * camera.pixel_size
        chief = rays.chief_point(p, camera.mla_distance, camera.detector_distance)
        lens = np.stack(camera.lattice.centre(*camera.lattice.cell(*chief.T)), axis=-1)
        return np.asarray(lens @ self._slopes)

    def __call__(self, lens_type: np.ndarray, height: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the fractions (n, rows, columns) of lenses at places x (n, columns) and y (n, rows) of the pupil."""
        fraction = np.zeros((len(x), y.shape[1], x.shape[1]), dtype=np.float32)
        kinds, which = np.unique(np.stack([lens_type, np.round(height / self._step)]), axis=1, return_inverse=True)
        for number, (kind, level) in enumerate(kinds.T.astype(int)):
            mine = which.ravel() == number
            fraction[mine] = self._table(kind, level)(x[mine, None, :], y[mine, :, None])
        return fraction

    def _at(self, level: int) -> PlenopticCamera:
        camera, height = self._camera, level * self._step
        if not level:
            return camera
        b, z = camera.mla_distance - height, camera.detector_distance + height
        return camera.replace(mla_distance=b, detector_distance=z, mla_tilt=(0.0, 0.0))

    def _table(self, lens_type: int, level: int) -> PupilFraction:
        if (lens_type, level) not in self._tables:
            self._tables[lens_type, level] = PupilFraction(self._at(level), lens_type)
        return self._tables[lens_type, level]
