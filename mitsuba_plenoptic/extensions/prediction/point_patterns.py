r"""Pictures of voxels behind a regular array, by waves and by rays, from which a volume's picture is put together.

Behind an objective with the array in its image, points that are one pitch apart have equal pictures one lens apart, so
that the voxels before one lens stand for all (Broxton et al. 2013, "Wave optics theory and 3-D deconvolution for the
light field microscope", Optics Express 21, 25418).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from ...camera import PlenopticCamera
from ...detector import SHARP
from ...errors import InputError
from ...points import CaptureOperator, ray_spread
from ...prescription import Objective
from .array_part import ArrayPart

_FIRST = 0.75
_GROWTH = 1.12
_WIDEST = 14.0
"""Blur of the first plane beyond the focus in lenses, factor by which steps grow, and blur of the last plane."""

_FINE = 4
_COARSE = 3
_FINE_BLUR = 6.5
"""Voxels along a lens's side, and the blur in lenses from which on they are coarse."""

_PARTS = 2
"""Points along a voxel's side."""

_RAYS = 8
"""Rays along a pixel."""

_DIFFRACTED = 0.6
"""Light of a point beyond its blur's border, in lenses, that counts."""


@dataclass(frozen=True)
class Plane:
    """A plane of voxels, with the picture of each of a lens's voxels.

    Attributes
    ----------
    depth : float
        Depth in millimetres, positive beyond the plane in focus.
    across : int
        Voxels along a lens's side.
    pictures : (rows, columns, voxels) float32 array
        Light in pixels of an odd number of lenses along a side, over the light through the pupil; voxels row by row,
        in the directions of the picture.
    """

    depth: float
    across: int
    pictures: np.ndarray


def depths_of(camera: PlenopticCamera) -> list[float]:
    """Return the depths of planes in millimetres, in the steps in which a light field resolves them."""
    count = int(np.log(1 + (_GROWTH - 1) * _WIDEST / _FIRST) / np.log(_GROWTH))
    blurs = _FIRST * (_GROWTH ** np.arange(1, count + 1) - 1) / (_GROWTH - 1)
    behind = (blurs / _blur_rate(camera)).tolist()
    return [*(-depth for depth in behind[::-1]), 0.0, *behind]


def _objective(camera: PlenopticCamera) -> Objective:
    """Return the objective; refuse cameras without one, or with the array elsewhere than in the objective's image."""
    objective = camera.objective
    if objective is None or objective.arrangement != "image":
        raise InputError("camera: light fields are predicted of microscopes, with the array in an objective's image")
    return objective


def _blur_rate(camera: PlenopticCamera) -> float:
    """Return the diameter of a point's blur on the array, in pitches, per millimetre of depth."""
    objective = _objective(camera)
    return float(2 * np.tan(objective.half_angle) * objective.magnification / camera.mla_pitch)


def pixels_across(part: ArrayPart) -> int:
    """Return the pixels along a lens's side of the regular array: at least as many as the picture has."""
    return int(np.ceil(part.model.pitch.max()))


def plane_of(part: ArrayPart, depth: float) -> Plane:
    """Return a plane's voxels with their pictures."""
    blur = abs(depth) * _blur_rate(part.model.camera)
    across = _FINE if blur < _FINE_BLUR else _COARSE
    # A voxel may be half a pitch from the middle of its lens.
    lenses = 2 * int(np.ceil(blur / 2 + 0.5 + _DIFFRACTED)) + 1
    camera = _regular(part, lenses)
    pitch = camera.mla_pitch / _objective(camera).magnification
    step = ((np.arange(across * _PARTS) + 0.5) / (across * _PARTS) - 0.5) * pitch
    # The objective's image is upside down.
    y, x = np.meshgrid(-step, -step, indexing="ij")
    points = np.stack([x, y, np.full_like(x, depth)], axis=-1)
    points = points.reshape(across, _PARTS, across, _PARTS, 3).transpose(0, 2, 1, 3, 4).reshape(across**2, -1, 3)
    blurred = part.numbers.blur * pixels_across(part) / part.model.pitch.max()
    wavelength = part.model.wavelength
    sharp = _by_rays(camera, points) if wavelength is None else _by_waves(camera, points, wavelength)
    return Plane(depth, across, gaussian_filter(sharp, (blurred, blurred, 0)).astype(np.float32))


def _regular(part: ArrayPart, lenses: int) -> PlenopticCamera:
    """Return a camera of a few lenses that are those in the middle of a part, without displacements."""
    camera = part.model.camera
    across = pixels_across(part)
    pupil = None
    if camera.vignetting is not None:
        here = camera.vignetting.at(*part.middle)
        numbers: dict[str, Any] = {name: [float(value)] for name, value in here.items()}
        pupil = replace(camera.vignetting, **numbers)
    pitch = camera.mla_pitch
    return camera.replace(
        mla_pitch=pitch,
        mla_rotation=0.0,
        # A lens is centred on the axis.
        mla_offset=(pitch / 2, pitch / 2),
        mla_warp=(),
        mla_cra=(),
        mla_transmissions=None,
        **SHARP,
        vignetting=pupil,
        resolution=(lenses * across, lenses * across),
        detector_width=lenses * pitch * camera.image_growth,
        crop_offset=(0, 0),
        crop_size=(lenses * across, lenses * across),
    )


def _by_waves(camera: PlenopticCamera, points: np.ndarray, wavelength: float) -> np.ndarray:
    """Return the pictures of voxels, each of several points (voxels, points, 3)."""
    weights = np.full(points.shape[1], 1 / points.shape[1])
    # Voxel by voxel, so that memory is that of a few patches.
    pictures = [CaptureOperator(camera, some, wavelength=wavelength, accuracy=0).forward(weights) for some in points]
    return np.stack(pictures, axis=-1)


def _by_rays(camera: PlenopticCamera, points: np.ndarray) -> np.ndarray:
    """Return the pictures of voxels, each of several points, by an even grid of rays through the pupil."""
    across = _RAYS * round(camera.mla_pitch / camera.pixel_size)
    generator = np.random.default_rng(0)

    def picture(point: np.ndarray) -> np.ndarray:
        # Places of the grid differ, so that borders of lenses fall between rays by chance.
        aside = generator.random((2, 1))
        samples = np.meshgrid(*((np.arange(across) + aside) * (2 / across) - 1))
        return ray_spread(camera, point, np.stack(samples, -1).reshape(-1, 2))

    return np.stack([np.mean([picture(point) for point in some], axis=0) for some in points], -1).astype(np.float32)
