"""What a camera of other numbers would record by rays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..capture.point_rays import PointRays
from ..capture.pupil_weights import PupilWeights
from ..capture.units import brightness_at
from ..errors import InputError
from .light import View
from .model import Number, changed, scales, values

_STEP = 1e-4
"""Change of a number to either side for its derivative, in `scales`: less than what bright captures tell.

Over longer ones dark pixels beside edges of the light seem to change with a number that does not light them.
"""


def check_numbers(numbers: Sequence[Number]) -> None:
    """Refuse numbers of which rays from points know nothing."""
    if any(number.name == "mla_fill" for number in numbers):
        raise InputError("mla_fill: rays from points know no gaps between lenses; fit it by waves")


class RayModels:
    """Cameras near one for which the counts of rays are planned.

    Parameters
    ----------
    camera : PlenopticCamera
        That camera.
    views : sequence of View
        The light.
    wavelength : float
        In nanometres.

    Raises
    ------
    InputError
        As of `PointRays`.
    """

    def __init__(self, camera: PlenopticCamera, views: Sequence[View], wavelength: float) -> None:
        self._views, self._wavelength = views, wavelength
        self._rays = [
            PointRays(camera, view.points, wavelength, PupilWeights.of(view.pupil_weights, len(view.points)))
            for view in views
        ]

    def at(self, camera: PlenopticCamera) -> RayModel:
        """Return what one of them records."""
        return RayModel(self, camera)

    def images(self, camera: PlenopticCamera) -> NDArray[np.float64]:
        """Return the expected pixels of all views, (views, rows, columns)."""
        return np.stack(
            [
                rays.image(camera, brightness_at(camera, view.points, self._wavelength) * view.weights)
                for rays, view in zip(self._rays, self._views, strict=True)
            ]
        )


class RayModel:
    """What a camera is expected to record of some views by rays; see `RayModels.at`."""

    def __init__(self, models: RayModels, camera: PlenopticCamera) -> None:
        self._models, self._camera = models, camera

    def images(self) -> NDArray[np.float64]:
        """Return the expected pixels of all views, (views, rows, columns)."""
        return self._models.images(self._camera)

    def derivatives(self, numbers: list[Number], images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of `images` by numbers, (numbers, views, rows, columns): central differences."""
        x, steps = values(self._camera, numbers), _STEP * scales(self._camera, numbers)
        rows = np.empty((len(numbers), *images.shape))
        for number, step in enumerate(steps.tolist()):
            sides = (x + side * step * (np.arange(len(x)) == number) for side in (1, -1))
            more, less = (self._models.images(changed(self._camera, numbers, side)) for side in sides)
            rows[number] = (more - less) / (2 * step)
        return rows
