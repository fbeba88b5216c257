"""The parameters of a camera that a fit varies, and the expected wave captures of a camera."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..camera.vector import CameraVector
from ..errors import InputError, short_repr
from ..operator.derivatives import NUMBERS, WAVELENGTH, check_names, light_slopes
from ..operator.operator import CaptureOperator
from ..operator.units import brightness_at
from ..system.optical_system import OpticalSystem
from .light import View


def vector_of(camera: PlenopticCamera, names: Iterable[str] | str) -> CameraVector:
    """Return the vector of the fitted parameters; the piston of aberrations is left out.

    Names of parameters without a derivative, or that do not apply to the camera, are refused.
    """
    given = (names,) if isinstance(names, str) else tuple(names)
    chosen = check_names(dict.fromkeys(given))
    if WAVELENGTH in chosen:
        raise InputError("wavelength: it is no parameter of a camera; give it, and fit the others")
    if not chosen:
        raise InputError(f"names = {short_repr(given)}: name at least one of {', '.join(NUMBERS)}")
    return CameraVector.by_names(camera, chosen)


class Model:
    """The captures of views that are expected of a camera by the wave model."""

    def __init__(
        self,
        camera: PlenopticCamera,
        views: list[View],
        wavelength: float,
        # Tolerance as in `CaptureOperator`.
        accuracy: float,
    ) -> None:
        self._camera, self._views = camera, views
        self._system = OpticalSystem(camera.at_wavelength(wavelength), wavelength)
        self._weights = [brightness_at(self._system, view.points) * view.weights for view in views]
        self._operators = [
            CaptureOperator(
                camera,
                view.points,
                wavelength=wavelength,
                accuracy=accuracy,
                pupil_weights=view.pupil_weights,
                virtual=view.virtual,
                system=self._system,
            )
            for view in views
        ]

    def images(self) -> NDArray[np.float64]:
        """Return the expected pixels of all views, (views, rows, columns)."""
        pairs = zip(self._operators, self._weights, strict=True)
        return np.stack([operator.forward(weights) for operator, weights in pairs]).astype(np.float64)

    def derivatives(self, vector: CameraVector, images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of `images`, an array (parameters, views, rows, columns)."""
        names, directions = vector.names, vector.of(self._camera).directions()
        rows = []
        for view, operator, weights, image in zip(self._views, self._operators, self._weights, images, strict=True):
            slopes = light_slopes(self._system, names, view.points)
            growth = [change @ slopes[name] for direction in directions for name, change in direction.items()]
            grown = [
                # If the weights of all points grow equally, the image is scaled; otherwise it is computed anew.
                each[0] * image if (each == each[0]).all() else operator.forward(each * weights)
                for each in growth
            ]
            rows.append(operator.jacobian(weights, directions) + np.stack(grown))
        return np.stack(rows, 1).astype(np.float64)
