"""A telescope with a collimator, for waves: the pupil is imaged, inverted, onto the array.

Such a camera is simulated only by full fields, which need only the methods of `MainLens` defined here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..prescription.collimator import Collimator
from .common import LensNumbers, UniformLens, builds
from .main_lens import Pair
from .thin import ThinLens

_NODES = 24
"""Nodes of the quadrature over the pupil, along its radius and around half of its circumference."""


@dataclass(frozen=True)
class CollimatedLens(UniformLens):
    """An objective with a collimator before a microlens array; `MainLens` documents its methods."""

    # The pupil as a lens without power, with the aberrations.
    pupil: ThinLens
    # Ratio of the pupil's image to the pupil.
    magnification: float
    pupil_radius: Any = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "pupil_radius", self.pupil.pupil_radius)

    @property
    def stop_scale(self) -> float:
        """Ratio of a coordinate on the pupil to the coordinate of its image on the array."""
        return -1 / self.magnification

    def path(self, pupil: Pair, point: tuple[Any, Any, Any], wavelength: float) -> Any:
        """Return the path in waves from a scene point to a point of the pupil, less the path to the pupil's centre."""
        return self.pupil.path(pupil, point, wavelength)

    def amplitude(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Any:
        """Return the amplitude behind a thin lens at a pupil point."""
        return self.pupil.amplitude(pupil, point)

    def power_through(self, point: NDArray[np.float64]) -> float:
        """Return the integral of the squared amplitude over the pupil, by Gauss's rule in radius, evenly in angle."""
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        radius = self.pupil_radius * np.sqrt((nodes + 1) / 2)[:, None]
        angle = math.pi * np.arange(2 * _NODES) / _NODES
        squares = self.amplitude((radius * np.cos(angle), radius * np.sin(angle)), tuple(point)) ** 2
        return float(math.pi * self.pupil_radius**2 * (weights / 2) @ squares.mean(1))

    def inside(self, pupil: Pair) -> Any:
        """Return the distance in mm of a point from the edge of the pupil, positive inside."""
        return self.pupil.inside(pupil)

    def is_open(self, pupil: Pair) -> Any:
        """Return whether a point lies inside the pupil or, up to rounding, on its edge."""
        return self.pupil.is_open(pupil)

    def cosines(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Pair:
        """Return the direction cosines, at the array, of light that passed a point of the pupil."""
        x, y = self.pupil.cosines(pupil, point)
        return x * self.stop_scale, y * self.stop_scale

    def land(self, pupil: Pair, point: tuple[Any, Any, Any]) -> Pair:
        """Return the position in mm of a pupil point's image on the array."""
        # Adding 0 broadcasts the result to the shape of the points.
        return pupil[0] / self.stop_scale + 0 * point[0], pupil[1] / self.stop_scale + 0 * point[0]

    def meet_array(self, pupil: Any, cosine: Any, point: tuple[Any, Any, Any]) -> Any:
        """Return the positions in mm where light from scene points meets the array."""
        return np.stack(np.broadcast_arrays(*self.land((pupil[0], pupil[1]), point)))


@builds(Collimator)
def collimated_lens(numbers: LensNumbers) -> CollimatedLens:
    """Return the main lens of a camera that has a collimator."""
    camera = numbers.camera
    pupil = ThinLens(
        focal_length=math.inf,
        pupil_radius=numbers.aperture_radius,
        pupil_distance=numbers.mla_distance,
        aberrations=numbers.wavefront,
        screen=camera.phase_screen,
    )
    return CollimatedLens(pupil, cast(Collimator, camera.main_lens).magnification(camera.focal_length))
