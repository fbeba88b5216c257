"""Where rays to points of the exit pupil enter the main lens: what shadow rays go to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics.lens_system import LensSystem
from ..optics.pupil_fit import Pupils
from .pupil_weights import slants


@dataclass(frozen=True)
class Front:
    """The scene's side of a main lens.

    Attributes
    ----------
    entrance : float
        Place z of the entrance pupil in the camera frame, in millimetres.
    front : float
        Place z of a plane before all of the lens.
    magnification : float
        Places on the exit pupil over those on the entrance pupil.
    """

    entrance: float = 0.0
    front: float = 0.0
    magnification: float = 1.0

    @classmethod
    def of(cls, camera: PlenopticCamera) -> Front:
        """Take that of a camera; a thin lens is its own pupils."""
        if camera.prescription is None:
            return cls()
        system = LensSystem.of(camera)
        pupils = Pupils.of(system)
        return cls(pupils.entrance, max(system.front_bounds[1]), pupils.magnification)

    def slants(
        self, normals: NDArray[np.floating[Any]], positions: NDArray[np.float64], radius: float
    ) -> NDArray[np.float64]:
        """Return the slants of surfaces (see `pupil_weights.slants`) over an exit pupil of this radius."""
        return slants(normals, positions - np.array([0, 0, self.entrance]), radius / self.magnification)


@dataclass(frozen=True)
class Entrances:
    """Where the light of some points enters on its way to points of the exit pupil.

    From the ray that has found a point the others are found by the magnification of the pupils, which they miss by
    the pupils' own aberrations: what these are worth is small against the cells of the pupil that rays are asked for.

    Attributes
    ----------
    front : Front
        The scene's side of the lens.
    pupil : float64 array (n, 2)
        Where the rays that have found the points pass the exit pupil.
    line : float64 array (n, 3)
        Points in the camera frame.
    slope : float64 array (n, 2)
        Slopes of these rays towards the scene.
    """

    front: Front
    pupil: NDArray[np.float64]
    line: NDArray[np.float64]
    slope: NDArray[np.float64]

    def at(self, x: Any, y: Any, which: Any) -> Any:
        """Return points in the camera frame through which light goes to points (x, y) of the exit pupil.

        Parameters
        ----------
        x, y : Float
            On the exit pupil in millimetres.
        which : UInt32
            Numbers of the points.
        """
        front = self.front
        if front == Front():
            return mi.Point3f(x, y, 0)
        depth = self.line[:, 2] - front.entrance
        # Where the ray that has found the point passes the entrance pupil; how far from there the front plane is.
        own = self.line[:, :2] - self.slope * depth[:, None] - self.pupil / front.magnification
        part = (front.front - front.entrance) / depth

        def value(column: NDArray[np.float64]) -> Any:
            return dr.gather(mi.Float, mi.Float(np.ascontiguousarray(column, np.float32)), which)

        t = value(part)
        ends = [
            (1 - t) * (value(own[:, axis]) + P / front.magnification) + value(part * self.line[:, axis])
            for axis, P in ((0, x), (1, y))
        ]
        return mi.Point3f(*ends, front.front)
