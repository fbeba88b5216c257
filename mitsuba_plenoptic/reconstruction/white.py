"""How much of a white micro-image's light comes back through the main lens by waves."""

from __future__ import annotations

import functools
import math

import numpy as np

from ..bounds import MOST_PIXELS
from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import rays
from ..optics.phase import soft_edge
from ..optics.pupil import PupilFraction
from ..optics.sampling import check_memory
from ..runtime.backend import backend
from .lens_by_lens import pupil_fields
from .lens_sets import LensSet, lens_set
from .lens_tiles import Tile

_THROUGHPUT_LENSES = 25


@functools.lru_cache(maxsize=16)
def white_throughput(camera: PlenopticCamera, wavelength: float, *, relay: bool = True) -> float:
    """Return the fraction of a white micro-image's power that comes back through the main lens.

    Its edge is one of the pupil, where light diffracts out: 7 % for the paper's camera.

    Raises
    ------
    InputError
        If no light comes back, for micro-images so small that they miss the centres of all pixels.
    """
    back, sent = (_aligned_throughput if camera.lenses_are_bins else _mean_throughput)(camera, wavelength, relay)
    if not min(back, sent) > 0:
        raise InputError(
            f"aperture_radius = {camera.aperture_radius:g}: its micro-images of "
            f"{camera.micro_image_diameter / camera.pixel_size:.2g} pixels light no pixel near the axis, so that "
            "waves cannot tell what is white"
        )
    return back / sent


def _aligned_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> tuple[float, float]:
    """Power that comes back, and power sent, of the micro-image of the lens beside the axis."""
    camera = _around_axis(camera, 2)
    centre = rays.chief_detector_point(camera.mla_pitch / 2, camera.mla_distance, camera.detector_distance)
    px, py = (camera.pixel_coordinates(axis) - centre for axis in (0, 1))
    image = soft_edge((camera.micro_image_diameter / 2 - np.hypot(px, py[:, None])) / camera.pixel_size)
    tile = Tile(camera, wavelength, _THROUGHPUT_LENSES, 1)
    check_memory(tile.memory, "wave reconstruction of a white micro-image")
    return _power(image, lens_set(tile), (0, 0), relay), float(image.sum()) * camera.pixel_size**2


def _mean_throughput(camera: PlenopticCamera, wavelength: float, relay: bool) -> tuple[float, float]:
    """Power that comes back, and power sent by pixels whose own ray passes the main lens, for a lens of every type."""
    camera = _around_axis(camera, 3)
    lenses = lens_set(Tile(camera, wavelength, _THROUGHPUT_LENSES, 1))
    back = sent = 0.0
    px, py = (camera.pixel_coordinates(axis) for axis in (0, 1))
    types = len(camera.mla_focal_lengths)
    for step in range(types):
        # Among the lenses beside the axis there is one of every type.
        i, j = camera.lattice.cell(0.0, 0.0)
        i += step
        lens_type = int(camera.lattice.lens_type(i, j)) if types > 1 else 0
        to_pupil = camera.mla_distance / camera.detector_distance
        centre = [
            rays.chief_detector_point(c, camera.mla_distance, camera.detector_distance)
            for c in camera.lattice.centre(i, j)
        ]
        Px, Py = (centre[0] - px) * to_pupil, ((centre[1] - py) * to_pupil)[:, None]
        image = PupilFraction(camera, lens_type)(*np.broadcast_arrays(Px, Py))
        sent += float(image[np.hypot(Px, Py) <= camera.lit_radius].sum()) * camera.pixel_size**2
        back += _power(image, lenses, (i, j), relay)
    return back, sent


def _around_axis(camera: PlenopticCamera, lenses: int) -> PlenopticCamera:
    """Return the camera with the pixels of so many lenses on each side of the axis, whether it has them or not."""
    around = math.ceil(lenses * camera.micro_image_pitch / camera.pixel_size)
    if around > MOST_PIXELS // 2:
        raise InputError(
            f"mla_pitch = {camera.mla_pitch:g}: a micro-image of {around // 2} pixels is too wide for waves"
        )
    columns, rows = (max(size, 2 * around) for size in camera.resolution)
    return camera.replace(
        resolution=(columns, rows),
        detector_width=columns * camera.pixel_size,
        crop_offset=(columns // 2 - around, rows // 2 - around),
        crop_size=(2 * around, 2 * around),
    )


def _power(image: np.ndarray, lenses: LensSet, index: tuple[float, float], relay: bool) -> float:
    """Power that one lens sends through the main lens."""
    tile, arrays = lenses.tile, backend().arrays
    batch = lenses.batch(np.array([lenses.find(*index)]))
    field = pupil_fields(arrays.asarray(np.sqrt(image).astype(np.float32)), tile, batch, relay=relay)[0]
    inside = (tile.camera.aperture_radius - np.hypot(tile.pupil, tile.pupil[:, None])) / tile.pupil_pitch
    return float((abs(field) ** 2 * arrays.asarray(soft_edge(inside))).sum()) * tile.pupil_pitch**2
