"""Contents of a sample of dual or quad pixels: pictures of the photodiodes, and ground truth of each lens."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...camera import PlenopticCamera
from ...detector import SHARP
from ...io import Capture
from ...plugins.other_camera import with_camera
from ...runtime import Array, Pair, Shape, drjit_array
from ...scene import plenoptic_sensor, render_capture
from ...views import FirstHits
from ..onchip.disparity import blur_radius
from ..onchip.halves import dual_pixel, photodiode_names, photodiodes
from ..onchip.photodiode_response import ACROSS

_STOPPED = 32.0
"""Factor by which the main lens is stopped down for pictures that are all in focus."""


def pictures_of(capture: Capture, layout: Shape, name: str) -> dict[str, Array]:
    """Return the pictures of a capture's photodiodes, named like ``ray_left``."""
    halves = dual_pixel(capture, layout)
    names = photodiode_names(halves)
    return {f"{name}_{name_of_photodiode}": halves.values[index] for index, name_of_photodiode in np.ndenumerate(names)}


def truth_of_lenses(scene: Any, spp: int, seed: int) -> dict[str, Array]:
    """Return the all-in-focus picture, and each lens's depth (mm) and signed blur radius (lens pitches).

    The depth is measured along the ray through the centres of the lens and of the pupil. Where the scene is in focus,
    the picture is the sum of the pictures of the photodiodes.
    """
    sensor = plenoptic_sensor(scene)
    camera = PlenopticCamera.from_sensor(sensor)
    rows, columns = (count // ACROSS for count in camera.shape)
    x, y = (drjit_array(mi.Float, coordinate) for coordinate in camera.lattice.centre(*_lens_indices(camera)))
    hits = FirstHits(scene, sensor, ["depth"])

    def of_lenses(index: Any) -> Pair:
        position = dr.gather(mi.Float, x, index), dr.gather(mi.Float, y, index)
        return sensor.pupil_ray((mi.Float(0), mi.Float(0)), position)

    depth = hits.along(of_lenses, rows * columns)["depth"].reshape(rows, columns)
    small = _stopped_down(camera)
    sharp = render_capture(with_camera(scene, small), model="ray", spp=spp, seed=seed)
    total = photodiodes(sharp.image, 1, 1)[0, 0]
    # Pixels across a micro-image.
    wide, narrow = (of_camera.micro_image_diameter / of_camera.pixel_size for of_camera in (camera, small))
    return {
        "sharp": ((wide / narrow) ** 2 * total).astype(np.float32),
        "lens_depth": depth,
        "blur_radius": blur_radius(camera, depth).astype(np.float32),
    }


def _lens_indices(camera: PlenopticCamera) -> list[Array]:
    """Return both lattice indices of the recorded lenses, (rows, columns)."""
    index = [
        np.floor(((first + ACROSS * np.arange(size // ACROSS) + 1) - count / 2 - offset / camera.pixel_size) / ACROSS)
        for first, size, count, offset in zip(
            camera.crop_offset, camera.crop_size, camera.resolution, camera.mla_offset, strict=True
        )
    ]
    return list(np.meshgrid(*index))


def _stopped_down(camera: PlenopticCamera) -> PlenopticCamera:
    """Return a camera with the same lenses and a smaller pupil, whose images behind the lenses keep their size.

    Lenses aligned to chief rays are placed with the smaller pitch that fits the recorded lenses best.
    """
    b = camera.pupil_distance
    index = _lens_indices(camera)
    x, y = camera.lattice.regular.centre(*index)
    right, up = camera.lattice.centre(*index)
    pitch = camera.row_pitch * float((x * right + y * up).sum() / (x * x + y * y).sum())
    # Micro-images are then 0.95 of the pitch wide.
    z = 0.95 * pitch * b * _STOPPED / (2 * camera.pupil_radius)
    return camera.replace(
        aperture_radius=camera.aperture_radius / _STOPPED,
        mla_shape=None,
        mla_medium=1.0,
        mla_absorption=0.0,
        mla_focal_length=z,
        detector_distance=z,
        mla_pitch=pitch,
        detector_width=camera.resolution[0] * pitch * (b + z) / (ACROSS * b),
        mla_cra=(),
        **SHARP,
        pixel_response=(),
        photodiode_response=None,
    )
