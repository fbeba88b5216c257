r"""What the main lens's pupil cuts off the blur that a microlens makes, and by how much that displaces what is seen.

A pixel at e from the centre of its micro-image is reached through the point d of its lens, both from their centres, by
a ray that crosses the pupil in

.. math:: P = -\frac{b}{z} e + \left(1 + \frac{b}{z} - \frac{b}{f}\right) d

(the formula of `design.crosstalk_neighbours`). A point whose image by the main lens lies the distance a before the
array, and that is seen at e through the lens's centre, is seen at :math:`e + \kappa d` through d, with
:math:`\kappa = 1 - z/f + z/a` as in `blur`. So the pixel shows on average what is seen through the lens's centre at
:math:`e - \kappa \bar d(e)`, with the mean :math:`\bar d` over the points of the lens through which rays reach the
pupil: 0 where all do.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from ..camera import PlenopticCamera

# Points of a lens along each axis, places of a micro-image along each axis, and how far beyond its rim these reach.
_POINTS = 42
_PLACES = 65
_BEYOND = 1.25


class CutBlur:
    """Where the pixels of a camera's micro-images see through their lenses, on average.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; its tilt and distortion change nothing that matters here.

    Raises
    ------
    InputError
        If its main lens is not thin.
    """

    def __init__(self, camera: PlenopticCamera) -> None:
        camera.require_thin("what the pupil cuts of blur is computed")
        self._z = camera.detector_distance
        self._b = camera.mla_distance
        self._ratios = self._z / np.array(camera.mla_focal_lengths)
        reach = _BEYOND * camera.micro_image_diameter / 2
        e = np.linspace(-reach, reach, _PLACES)
        unit = (np.arange(_POINTS) + 0.5) / _POINTS
        d = np.stack(camera.lattice.aperture_point(*np.meshgrid(unit, unit)), axis=-1).reshape(-1, 2)
        self._step = (e[1] - e[0]) / camera.pixel_size
        self._means = np.zeros((len(self._ratios), 2, _PLACES, _PLACES))
        for kind, ratio in enumerate(self._ratios):
            slope = 1 + self._b / self._z * (1 - ratio)
            for row, y in enumerate(e):
                px = slope * d[:, 0] - self._b / self._z * e[:, None]
                py = slope * d[:, 1] - self._b / self._z * y
                open_ = np.hypot(px, py) < camera.aperture_radius
                self._means[kind, :, row] = (open_ @ d / np.maximum(open_.sum(1), 1)[:, None]).T / camera.pixel_size

    def defocus(self, kind: np.ndarray, disparity: np.ndarray) -> np.ndarray:
        r"""Return :math:`\kappa` of lenses of these types and points of these disparities (`board_view`)."""
        over = self._z / self._b
        # From lens to lens a point moves by 1 + z/a in the array's plane, and micro-images by 1 + z/b.
        result: np.ndarray = 1 - self._ratios[kind] + over + disparity * (1 + over)
        return result

    def displaced(self, kind: np.ndarray, defocus: np.ndarray, arm: np.ndarray) -> np.ndarray:
        """Return by how much what pixels show lies from where they are.

        Parameters
        ----------
        kind : (n,) int array
            Types of their lenses.
        defocus : (n,) array
            As `defocus` gives it.
        arm : (n, pixels, 2) array
            Places of the pixels from the centres of their micro-images.

        Returns
        -------
        (n, pixels, 2) array
            In pixels.
        """
        at = arm[:, :, ::-1] / self._step + (_PLACES - 1) / 2
        moved = np.zeros(arm.shape)
        for number, mean in enumerate(self._means):
            mine = kind == number
            for axis in (0, 1):
                moved[mine, :, axis] = map_coordinates(mean[axis], np.moveaxis(at[mine], 2, 0), order=1, mode="nearest")
        result: np.ndarray = -defocus[:, None, None] * moved
        return result
