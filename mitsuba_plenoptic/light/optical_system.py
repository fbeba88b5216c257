"""A camera at one wavelength: its lattice, microlenses and main lens, and the pupil that rays from its detector see."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..camera.plenoptic_camera import require_ideal
from ..lattice import Lattice
from ..lenses.common import main_lens
from ..lenses.main_lens import MainLens, PointLight
from ..optics import rays
from ..prescription.glass import LINE_D
from ..runtime.backend import drjit_array
from .microlens_orders import MicrolensArray, microlens_array
from .microlenses import upright


def is_paraxial(camera: PlenopticCamera) -> bool:
    """Return whether a field of many points moves by slopes in a camera, as the camera's rays do.

    Behind an ideal thin main lens a single point's light converges to its image, by direction cosines as light does. No
    phase does that to the light of all points together, except where light moves by slopes: a parabola.
    """
    return camera.main_lens is None and camera.lens_model == "ideal"


@dataclass(frozen=True)
class OpticalSystem:
    """The part that captures, operators and reconstructions of one camera share at one wavelength.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    lens_model : {"ideal", "parabolic"}, optional
        Model of a thin main lens. Default: that of the camera.
    """

    camera: PlenopticCamera
    wavelength: float
    lens_model: str | None = None

    @classmethod
    def by_design(cls, camera: PlenopticCamera) -> OpticalSystem:
        """Return the optical system at the design wavelength of the main lens, for rays without a wavelength."""
        return cls(camera, getattr(camera.main_lens, "wavelength", LINE_D))

    @cached_property
    def lattice(self) -> Lattice:
        """The microlens lattice."""
        return self.camera.lattice

    @cached_property
    def microlenses(self) -> MicrolensArray:
        """The transmission of the microlenses, in the frame of the camera."""
        return microlens_array(self.camera, self.wavelength)

    @cached_property
    def upright_microlenses(self) -> MicrolensArray:
        """The transmission of the microlenses, in the frame that is rotated with their lattice about the axis."""
        turned = self.camera.mla_rotation != 0
        return microlens_array(upright(self.camera), self.wavelength) if turned else self.microlenses

    @cached_property
    def lens(self) -> MainLens:
        """The main lens, for waves and for rays; see `MainLens` for its methods."""
        return _wave_lens(self.camera, self.wavelength, self.lens_model or self.camera.lens_model)

    def waves_of(self, points: NDArray[np.float64]) -> MainLens:
        """Return the main lens for wave propagation from scene points (n, 3).

        Parameters
        ----------
        points : float64 array (n, 3)
            Scene points in the camera frame.

        Raises
        ------
        InputError
            If the wave model does not support the camera, or a point is not before the lens or lies outside its field.
        PhysicsError
            If the path through a real lens cannot be fitted.
        """
        require_ideal(self.camera, in_full=True)
        return self.lens.waves_of(points)

    def waves_of_one(self, point: NDArray[np.float64]) -> PointLight:
        """Return the light of a scene point (3,) on the exit pupil, as exactly as the lens can represent it."""
        require_ideal(self.camera, in_full=True)
        return self.lens.waves_of_one(point)


@functools.lru_cache(maxsize=4)
def _wave_lens(camera: PlenopticCamera, wavelength: float, lens_model: str) -> MainLens:
    """Return the main lens of a camera for waves; the last few are remembered, with their slow fits."""
    return main_lens(camera, wavelength, model=lens_model)


Pair = tuple[Any, ...]


@dataclass(frozen=True)
class RayPupil:
    """The exit pupil of a camera, and the rays through it."""

    # The camera and its wavelength, which affects main lenses with surfaces.
    system: OpticalSystem

    def seen(self, detector: Pair, centre: Pair, detector_distance: float, height: Any) -> Pair:
        """Return the points of the pupil that the detector sees through the centres of lenses.

        The centres lie by a height nearer to the main lens than `detector_distance` before the detector.
        """
        offset = tuple(c - p for c, p in zip(centre, detector, strict=True))
        slopes, _ = self._slopes(offset, detector_distance + height)
        lens = self.system.lens
        return tuple(lens.pupil_point(c, slope, height) for c, slope in zip(centre, slopes, strict=True))

    def evenness(self, detector: Pair, distance: Any) -> Any:
        """Return the weights by which rays from everywhere on the detector are even over the pupil; see `optics.rays`.

        The detector points are relative to the lenses' centres, and the lenses at a distance before them.
        """
        before, behind = self._slopes(tuple(-p for p in detector), distance)
        return rays.evenness(before, behind, None, self.system.camera.mla_medium)

    def _slopes(self, offset: Pair, distance: Any) -> tuple[Pair, Pair]:
        """Return the slopes before the array, and in the medium behind it, of rays through the centres of lenses."""
        behind, n = tuple(value / distance for value in offset), self.system.camera.mla_medium
        return (behind if n == 1 else rays.refracted(behind, n)), behind

    def trace(self, place: Pair, pupil: Pair, height: Any) -> tuple[tuple[Any, Any, Any], Pair]:
        """Return start points and slopes in the scene of rays from positions on the array through points of the pupil.

        The positions lie by a height nearer to the main lens than the array on the axis.
        """
        lens = self.system.lens
        x, y = (lens.slope_to(P, m, height) for P, m in zip(pupil, place, strict=True))
        start = tuple(m - height * t for m, t in zip(place, (x, y), strict=True))
        point, slope, _ = lens.trace((start[0], start[1]), (x, y))
        return point, slope

    def inner(self, pupil: Pair, centre: Pair) -> Pair:
        """Map points of the pupil, seen from lenses, to the round pupil; points outside map to points outside."""
        found = self.system.lens.round_map
        if found is None:
            return pupil
        (x, y), (cx, cy) = pupil, centre
        field = dr.sqrt(cx * cx + cy * cy)
        # The map is defined for fields along x.
        c, s = dr.select(field > 0, cx / field, 1), dr.select(field > 0, cy / field, 0)
        fields, across, _, _ = found.points.shape
        u, v = x * c + y * s, y * c - x * s
        at = [(value / found.half + 1) * ((across - 1) / (2 * across)) + 0.5 / across for value in (u, v)]
        u, v = self._map.eval(mi.Point3f(*at, field / found.field * ((fields - 1) / fields) + 0.5 / fields))
        return u * c - v * s, u * s + v * c

    @functools.cached_property
    def _map(self) -> Any:
        found = self.system.lens.round_map
        assert found is not None
        # Outside its border the map continues with the border's values, which lie outside the pupil.
        return mi.Texture3f(
            drjit_array(mi.TensorXf, found.points),
            filter_mode=dr.FilterMode.Linear,
            wrap_mode=dr.WrapMode.Clamp,
        )
