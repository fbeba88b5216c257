"""Point spreads of single points, and gradients of what is made of them by the camera's numbers."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..bounds import require_wavelength
from ..camera import PlenopticCamera
from ..errors import InputError
from ..operator.accuracy import check_accuracy
from ..operator.operator import CaptureOperator
from ..system.optical_system import OpticalSystem
from ..system.sampling import check_positions

DESIGN_ACCURACY = 0.02
"""Allowed error of the point spreads unless told: designs differ by more."""

Gradient = dict[str, NDArray[np.float64]]


class Spreads:
    """The point spreads of points that a figure looks at, each by itself."""

    def __init__(self, points: Any, wavelength: float, accuracy: float, method: str) -> None:
        # Where they may lie depends on the camera, and is checked with it.
        self.points, self.wavelength = check_positions(points, virtual=True), require_wavelength(wavelength)
        self._accuracy, self._method = check_accuracy(accuracy), method
        self._system: OpticalSystem | None = None

    def images(self, camera: PlenopticCamera, points: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return the spreads (n, rows, columns) of the points, or of others in their place."""
        # One by one: points so near each other must not share a spread.
        return np.stack([operator.forward([1.0]) for operator in self._operators(camera, points)]).astype(np.float64)

    def gradient(
        self,
        camera: PlenopticCamera,
        images: NDArray[np.float64],
        names: Iterable[str],
        points: NDArray[np.float64] | None = None,
    ) -> Gradient:
        """Take the gradient by the spreads (n, rows, columns) back to numbers of the camera."""
        total: Gradient = {}
        for operator, image in zip(self._operators(camera, points), images, strict=True):
            found = operator.gradient([1.0], image.astype(np.float32), tuple(names))
            total = {name: part + total.get(name, 0.0) for name, part in found.items()}
        return total

    def _operators(self, camera: PlenopticCamera, points: NDArray[np.float64] | None) -> Iterable[CaptureOperator]:
        if self._system is None or self._system.camera != camera:
            self._system = OpticalSystem(camera.at_wavelength(self.wavelength), self.wavelength)
        # A step from a point far away may lead across infinity.
        options: dict[str, Any] = {"accuracy": self._accuracy, "method": self._method, "virtual": points is not None}
        for point in self.points if points is None else points:
            yield CaptureOperator(camera, [point], wavelength=self.wavelength, system=self._system, **options)


def require_held(camera: PlenopticCamera, other: PlenopticCamera, held: Iterable[str]) -> None:
    """Refuse a camera of which numbers differ that a figure holds."""
    mine, its = camera.to_dict(), other.to_dict()
    for name in held:
        if mine[name] != its[name]:
            raise InputError(f"{name} = {its[name]}: this figure is of cameras with {mine[name]}")
