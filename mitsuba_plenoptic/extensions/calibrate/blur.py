r"""Focal lengths of microlenses from the blur of corners in their micro-images.

A point whose image by the main lens lies the distance a before the microlens array (negative: behind it) is spread on
the detector, the distance z behind the array, by a lens of the focal length f and the diameter D, over a disc of the
radius

.. math:: \rho = \frac{D}{2} \left(1 - \frac{z}{f} + \frac{z}{a}\right)

in the plane of the detector, which changes its sign where the point is in focus. With z/a known from a calibration, the
radii of the lenses of one type lie on a line. What programs call the radius of a blur differs by a factor, and in its
sign; the slope of the line gives both, and its value at z/a = 0, divided by the slope, gives z/f.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from ...array import Lattice
from ...camera import PlenopticCamera, Use, require_support
from ...errors import refuse_if
from ...runtime import Array, Numbers
from .adjustment import Adjusted
from .board_model import AT, Observations
from .observations import placed


@dataclass(frozen=True)
class Blur:
    """Focal lengths of a camera's microlenses from blur radii.

    Attributes
    ----------
    focal_lengths, deviations : tuple of float
        Focal lengths in mm of each type of lenses, and standard deviations, including those by the camera's parameters.
    scale : float
        Radius in pixels, in the terms of the data, for each unit of :math:`1 - z/f + z/a`: half of a lens's diameter if
        the data state radii of the whole disc.
    error : float
        RMS residual of the radii in pixels.
    """

    focal_lengths: Numbers
    deviations: Numbers
    scale: float
    error: float


def fit_blur(
    radius: Array,
    observed: Observations,
    numbers: Array,
    poses: Array,
    lattice: Lattice,
    types: int,
    moved: Sequence[Adjusted] = (),
) -> Blur:
    """Return the focal lengths of the microlenses, fitted to signed blur radii.

    Shapes: `radius` (n,), `numbers`, `poses` (17,).
    """
    ratio = image_ratios(observed, numbers, poses)
    row = np.round(observed.lens[:, 1])
    lens_type = np.zeros(len(row), dtype=int)
    if types > 1:
        column, _ = lattice.unit_centre(0.0, row)
        lens_type = np.asarray(lattice.lens_type(np.round(observed.lens[:, 0] - column), row), dtype=int)
    counts = np.bincount(lens_type, minlength=types)
    refuse_if(
        (counts < 2).any() or np.ptp(ratio) < 0.01,
        "corners: rho: blur radii are given, but of too few lenses or all at one depth to determine focus",
    )
    matrix = np.column_stack([*np.eye(types)[lens_type].T, ratio])
    line = np.linalg.lstsq(matrix, radius)[0]
    residual = radius - matrix @ line
    square = float(np.mean(residual**2))
    curves = np.column_stack([matrix, *(matrix[:, :-1] * ratio[:, None]).T, *(matrix[:, :-1] * ratio[:, None] ** 2).T])
    bent = float(np.mean((radius - curves @ np.linalg.lstsq(curves, radius)[0]) ** 2))
    rounding = 1e-12 * float(np.var(radius))
    refuse_if(
        not (square < 0.1 * np.var(radius) and bent + rounding > 0.5 * square),
        f"corners: rho: {math.sqrt(square):.3g} of {np.std(radius):.3g} pixels of the blur radii are not explained "
        f"by {types} type{'s' if types > 1 else ''} of microlenses, as many as mla_focal_length lists: radii must "
        "have a sign, other in front of focus than behind it; leave the column out if they have none",
    )
    scale = line[-1]
    over = 1 - line[:-1] / scale
    z = float(numbers[AT["detector_distance"]])
    refuse_if(not (over > 0).all(), "corners: rho: the focal lengths that fit the blur radii best are not positive")
    # Observations of one corner of one picture err together, as such radii are mostly found from its depth.
    group = np.unique(np.column_stack([observed.pose, observed.board]), axis=0, return_inverse=True)[1].ravel()
    inverse = np.linalg.inv(matrix.T @ matrix)
    scores = np.stack([np.bincount(group, residual * column) for column in matrix.T], axis=-1) @ inverse
    covariance = scores.T @ scores
    moved_lengths = []
    for solution in moved:
        matrix[:, -1] = image_ratios(observed, solution.numbers, solution.poses)
        *heights, steep = np.linalg.lstsq(matrix, radius)[0]
        moved_lengths.append(solution.numbers[AT["detector_distance"]] / (1 - np.array(heights) / steep))
    camera = ((np.array(moved_lengths).reshape(-1, types) - z / over) ** 2).sum(0)
    # Of z/f = 1 - position / slope.
    slopes = np.column_stack([-np.eye(types) / scale, line[:-1] / scale**2])
    deviations = np.sqrt(((slopes @ covariance) * slopes).sum(1) * (z / over**2) ** 2 + camera)
    return Blur(tuple((z / over).tolist()), tuple(deviations.tolist()), abs(float(scale)), math.sqrt(square))


def image_ratios(observed: Observations, numbers: Array, poses: Array) -> Array:
    """Return z/a for each observation: the detector's distance from the array over that of the corner's image."""
    f, b, z = numbers[:3]
    distance = placed(observed.board, poses, observed.pose)[:, 2]
    return np.asarray(z / (b - distance * f / (distance - f)))


# Points of a lens along each axis, positions of a micro-image along each axis, and how far beyond its rim these reach.
_POINTS = 42
_SAMPLES = 65


class CutBlur:
    """Mean positions that pixels show through the unblocked parts of their lenses, where the pupil cuts the blur."""

    def __init__(
        self,
        # The camera; its tilt and distortion change nothing that matters here.
        camera: PlenopticCamera,
    ):
        require_support(camera, Use.LENS_CENTRES)
        self._z = camera.detector_distance
        self._b = camera.mla_distance
        self._ratios = self._z / np.array(camera.mla_focal_lengths)
        reach = 1.25 * camera.micro_image_diameter / 2
        e = np.linspace(-reach, reach, _SAMPLES)
        d = camera.lattice.aperture_grid(_POINTS).T
        self._step = (e[1] - e[0]) / camera.pixel_size
        # Columns are real parts and rows imaginary ones.
        self._means = np.zeros((len(self._ratios), _SAMPLES, _SAMPLES), complex)
        for kind, ratio in enumerate(self._ratios):
            slope = 1 + self._b / self._z * (1 - ratio)
            for row, y in enumerate(e):
                px = slope * d[:, 0] - self._b / self._z * e[:, None]
                py = slope * d[:, 1] - self._b / self._z * y
                open_ = np.hypot(px, py) < camera.aperture_radius
                self._means[kind, row] = open_ @ (d @ [1, 1j]) / np.maximum(open_.sum(1), 1) / camera.pixel_size

    def defocus(self, kind: Array, disparity: Array) -> Array:
        r"""Return the relative blur :math:`\kappa = 1 - z/f + z/a` of points of given disparities (`boards`)."""
        over = self._z / self._b
        # From lens to lens a point moves by 1 + z/a in the array's plane, and micro-images by 1 + z/b.
        return 1 - self._ratios[kind] + over + disparity * (1 + over)

    def displaced(self, kind: Array, defocus: Array, arm: Array) -> Array:
        """Return the displacement, in pixels, from a pixel's position to the mean position that the pixel shows.

        Shapes: `kind` (n,), `defocus` (n,), `arm` (n, pixels, 2); the result (n, pixels, 2).
        """
        at = arm[:, :, ::-1] / self._step + (_SAMPLES - 1) / 2
        moved = np.zeros(arm.shape[:2], complex)
        for index, mean in enumerate(self._means):
            mine = kind == index
            moved[mine] = map_coordinates(mean, np.moveaxis(at[mine], 2, 0), order=1, mode="nearest")
        return -defocus[:, None, None] * moved.view(float).reshape(arm.shape)
