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
from ..optics.telecentric import TelecentricLens
from .pupil_weights import slants

_MIDWAY = 0.8
"""Place in the stop, over its radius, where the slant of a surface is right."""


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
    telecentric : TelecentricLens, optional
        An objective, which has directions in place of an entrance pupil.
    """

    entrance: float = 0.0
    front: float = 0.0
    magnification: float = 1.0
    telecentric: TelecentricLens | None = None

    @classmethod
    def of(cls, camera: PlenopticCamera) -> Front:
        """Take that of a camera; a thin lens is its own pupils."""
        if camera.objective is not None:
            lens = TelecentricLens(camera.objective)
            return cls(front=lens.front, telecentric=lens)
        if camera.prescription is None:
            return cls()
        system = LensSystem.of(camera)
        pupils = Pupils.of(system)
        return cls(pupils.entrance, max(system.front_bounds[1]), pupils.magnification)

    def slants(
        self, normals: NDArray[np.floating[Any]], positions: NDArray[np.float64], radius: float
    ) -> NDArray[np.float64]:
        """Return the slants of surfaces (see `pupil_weights.slants`) over an exit pupil of this radius.

        Behind an objective the cosine is linear in the tangents of directions; it is taken as linear in their sines,
        with the factor that is right at `_MIDWAY` of the stop's radius.
        """
        if self.telecentric is None:
            return slants(normals, positions - np.array([0, 0, self.entrance]), radius / self.magnification)
        tangent = float(self.telecentric.aim((-_MIDWAY * radius, 0.0), (0.0, 0.0))[0]) / _MIDWAY
        return slants(normals, np.broadcast_to([0.0, 0.0, 1.0], positions.shape), tangent)

    def even_power(self, radius: float, cells: int) -> NDArray[np.float32] | None:
        """Return what makes the light of a surface even over the pupil, (cells, cells); None where it is so by itself.

        The lens's own amplitude is that of a point which radiates evenly in all directions. Behind an objective
        Lambert's law for surfaces takes the cosine from that.
        """
        if self.telecentric is None:
            return None
        place = ((np.arange(cells) + 0.5) * 2 / cells - 1) * radius
        x, y = np.meshgrid(place, place)
        beyond = np.maximum(np.hypot(x, y) / radius, 1)
        return np.asarray(self.telecentric.amplitude((x / beyond, y / beyond), (0.0, 0.0, 0.0)) ** -2, np.float32)


@dataclass(frozen=True)
class Entrances:
    """Where the light of some radiators enters on its way to points of the exit pupil.

    From the ray that has found a radiator the others are found by the magnification of the pupils, which they miss by
    the pupils' own aberrations: what these are worth is small against the cells of the pupil that rays are asked for.

    Attributes
    ----------
    front : Front
        The scene's side of the lens.
    pupil : float64 array (n, 2)
        Where the rays that have found the radiators pass the exit pupil.
    line : float64 array (n, 3)
        Radiators in the camera frame.
    slope : float64 array (n, 2)
        Slopes of these rays towards the scene.
    """

    front: Front
    pupil: NDArray[np.float64]
    line: NDArray[np.float64]
    slope: NDArray[np.float64]

    def take(self, which: NDArray[Any]) -> Entrances:
        """Return those of some radiators."""
        return Entrances(self.front, self.pupil[which], self.line[which], self.slope[which])

    def at(self, x: Any, y: Any, which: Any) -> Any:
        """Return points in the camera frame through which light goes to points (x, y) of the exit pupil.

        Parameters
        ----------
        x, y : Float
            On the exit pupil in millimetres.
        which : UInt32
            Numbers of the radiators.
        """
        front = self.front
        if front == Front():
            return mi.Point3f(x, y, 0)
        if front.telecentric is not None:
            slope = front.telecentric.aim((x, y), (0 * x, 0 * y))
            ahead = mi.Float((front.front - self.line[:, 2]).astype(np.float32))
            X, Y = (mi.Float(np.ascontiguousarray(self.line[:, axis], np.float32)) for axis in (0, 1))
            step = dr.gather(mi.Float, ahead, which)
            return mi.Point3f(
                dr.gather(mi.Float, X, which) + slope[0] * step,
                dr.gather(mi.Float, Y, which) + slope[1] * step,
                front.front,
            )
        depth = self.line[:, 2] - front.entrance
        # Where the ray that has found the radiator passes the entrance pupil; how far from there the front plane is.
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
