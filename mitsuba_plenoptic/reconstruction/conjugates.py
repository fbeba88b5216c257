r"""From the exit pupil to object planes: the path that brings waves from a place on the array to its conjugate.

Waves are followed back to the plane of the main lens's exit pupil, and only what multiplies them there knows the lens:
the path from a scene point, and which part of the pupil its light passes. A real lens is seen from behind as a thin one
in its exit pupil. With the pupils' magnification m and the entrance pupil at :math:`z_E`, the paraxial image of a point
at the distance g is that of a thin lens at the distance :math:`m^2 (g - z_E)` (Welford, "Aberrations of Optical
Systems", section 2.6), so that everything up to the pupil is sampled as behind this thin lens, in directions of chief
rays. What the real one differs by, aberrations and vignetting, is in the path and in the edge; its distortion is undone
at the end, see `undistorted`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, cast

import drjit as dr
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..camera import PlenopticCamera
from ..errors import InputError, argument
from ..lenses.base import Light
from ..lenses.fitted_lens import FAR, FittedLens
from ..lenses.pupil_fit import Pupils
from ..lenses.real_lens import RealLens
from ..optics.phase import in_millimetres
from ..runtime.backend import array_module
from ..system.optical_system import OpticalSystem

_MARGIN = 4
"""Lenses beyond the corner of the bins up to which the lens is fitted."""

_MOST_ZONES = 8
"""Zones of the field along each axis, at most."""

_ZONE_BLUR = 0.2
"""Part of a bin by which the path of the middle of a zone may lead a ray from the pupil's rim astray at its corners."""

Place = tuple[Any, Any]


class Conjugate(Protocol):
    """How the light of one place on the array, or of one for each lane, passes the exit pupil."""

    def path(self, pupil: Place) -> Any:
        """Return the path from the object plane in waves."""

    def inside(self, pupil: Place) -> Any:
        """Return how far within the pupil's edge a place lies, in millimetres."""


@dataclass(frozen=True)
class Zone:
    """A part of the field whose light is taken to pass the pupil in one way.

    Attributes
    ----------
    light : Conjugate
        The way of its middle, less the tilt.
    bounds : ((float, float), (float, float)), or None
        Parts of the width and of the height of the bins between which it lies; None: it is the whole field.
    is_cut : bool
        Whether light is ended by the conjugate's own edge, besides that of the circle around the pupil.
    """

    light: Conjugate
    bounds: tuple[tuple[float, float], tuple[float, float]] | None = None
    is_cut: bool = False


class Conjugates(Protocol):
    """The main lens of a reconstruction."""

    @property
    def camera(self) -> PlenopticCamera:
        """The camera, or one whose thin main lens is in the exit pupil."""

    def at(self, x: Any, y: Any, places: NDArray[np.float64], lens: Any, distance: float) -> Conjugate:
        """Return the conjugates of the centres of some lenses.

        Parameters
        ----------
        x, y : Dr.Jit arrays
            The centre of each lane's lens in millimetres.
        places : float64 array (n, 2)
            The centres.
        lens : UInt32 array of Dr.Jit
            Which of them each lane's is.
        distance : float
            Distance of the object plane before the thin lens of `camera`; may be infinite.
        """

    def zones(self, distance: float) -> Iterator[Zone]:
        """Yield the zones that one path each serves."""


@dataclass(frozen=True)
class _ThinLight:
    lens: Any
    point: tuple[Any, Any, Any]
    wavelength: float

    def path(self, pupil: Place) -> Any:
        return self.lens.path(pupil, self.point, self.wavelength)

    def inside(self, pupil: Place) -> Any:
        return self.lens.inside(pupil)


@dataclass(frozen=True)
class ThinConjugates:
    """Those of a thin main lens.

    Attributes
    ----------
    system : OpticalSystem
        The camera, at one wavelength.
    """

    system: OpticalSystem

    @property
    def camera(self) -> PlenopticCamera:
        """The camera."""
        return self.system.camera

    def at(self, x: Any, y: Any, places: NDArray[np.float64], lens: Any, distance: float) -> Conjugate:
        """Return the conjugates of the centres of some lenses, as `Conjugates.at` does."""
        # Infinity is so far that nothing changes with the distance.
        b, g = (dr.opaque(type(x), length) for length in (self.camera.mla_distance, min(distance, FAR)))
        return self._light((-x * g / b, -y * g / b, g))

    def zones(self, distance: float) -> Iterator[Zone]:
        """Yield the whole field: what changes over it is neglected, see `planning`."""
        yield Zone(self._light((0.0, 0.0, distance)))

    def _light(self, point: tuple[Any, Any, Any]) -> _ThinLight:
        return _ThinLight(self.system.lens, point, self.system.wavelength)


@dataclass(frozen=True)
class _RealLight:
    light: Light
    wavelength: float
    tilt: tuple[float, float] = (0.0, 0.0)

    def path(self, pupil: Place) -> Any:
        waves = self.light.path(pupil, (0.0, 0.0, 0.0), self.wavelength)
        if not any(self.tilt):
            return waves
        return waves - (pupil[0] * self.tilt[0] + pupil[1] * self.tilt[1]) * (1 / in_millimetres(self.wavelength))

    def inside(self, pupil: Place) -> Any:
        return self.light.inside(pupil)


@dataclass(frozen=True, eq=False)
class RealConjugates:
    """Those of a real main lens.

    Attributes
    ----------
    camera : PlenopticCamera
        A camera with a thin main lens in the exit pupil.
    lens : FittedLens
        The lens.
    wavelength : float
        Wavelength in nanometres.
    blur : float
        What the path of another place may blur a place on the MLA by, in millimetres.
    """

    camera: PlenopticCamera
    lens: FittedLens
    wavelength: float
    blur: float

    @classmethod
    def of(cls, system: OpticalSystem, distances: list[float], oversample: int) -> RealConjugates:
        """Fit the main lens of a camera over its field, for object planes at some distances.

        Parameters
        ----------
        system : OpticalSystem
            The camera, with a real main lens, at one wavelength.
        distances : list of float
            Distances of the object planes; may be infinite.
        oversample : int
            Bins per lens along each axis.

        Raises
        ------
        InputError
            If an object plane does not lie before the lens, or it distorts so that the image folds.
        PhysicsError
            If its path cannot be fitted.
        """
        camera, real = system.camera, cast(RealLens, system.lens)
        pupils, front = Pupils.of(real), real.entrance.front
        for distance in distances:
            if not distance > max(front, pupils.entrance):
                raise InputError(
                    f"distance = {distance:g}: it must lie before the main_lens, beyond "
                    f"{max(front, pupils.entrance):.6g}"
                )
        b, behind = camera.mla_distance, float(real.pupil_distance)
        corner = math.hypot(*camera.bin_count) / 2 * camera.mla_pitch + _MARGIN * camera.mla_pitch
        nearness = [1 / (min(distance, FAR) - pupils.entrance) for distance in distances]
        fields = [abs(pupils.magnification) / behind]
        fields += [min(g, FAR) * near / b for g, near in zip(distances, nearness, strict=True)]
        lens = real.over_field(corner * max(fields), (min(nearness), max(nearness)))
        seen = behind_thin_lens(system)
        wider = max(1.0, *(float(lens.image_stretch(camera, distance).ratio.max()) for distance in distances))
        more = math.ceil((wider - 1) / 2 * max(seen.resolution) - 1e-6)
        return cls(_widened(seen, more), lens, system.wavelength, _ZONE_BLUR * camera.mla_pitch / oversample)

    def distance(self, distance: float) -> float:
        """Return the distance of an object plane before the thin lens of `camera`."""
        pupils = self.lens.fitted.pupils
        return math.inf if math.isinf(distance) else pupils.magnification**2 * (distance - pupils.entrance)

    def _nearness(self, distance: float) -> float:
        return self.lens.fitted.pupils.magnification**2 / min(distance, FAR)

    def _bound(self, places: NDArray[np.float64], distance: float, which: Any = None) -> Light:
        """Return the light of the conjugates of places on the MLA; no light comes to those farther out."""
        points = self.lens.points(self.lens.within(places), np.full(len(places), self._nearness(distance)))
        return self.lens.bind(points, which)

    def at(self, x: Any, y: Any, places: NDArray[np.float64], lens: Any, distance: float) -> Conjugate:
        """Return the conjugates of the centres of some lenses, as `Conjugates.at` does."""
        return _RealLight(self._bound(places, distance, lens), self.wavelength)

    def zones(self, distance: float) -> Iterator[Zone]:
        """Yield zones so small that the path of the middle of each serves all of it.

        Raises
        ------
        InputError
            If there would be too many.
        """
        bins = np.array(self.camera.bin_count) * self.camera.mla_pitch
        for count in range(1, _MOST_ZONES + 1):
            if self._blur(bins / count, count, distance) <= self.blur:
                break
        else:
            raise InputError(
                f"distance = {distance:g}: the aberrations of the main_lens change too much over the field for whole "
                f"fields; use {argument('method')} partial with {argument('interleave')} auto"
            )
        middle_only = array_module().UInt32(0)
        for row, column in np.ndindex(count, count):
            middle = ((np.array([column, row]) + 0.5) / count - 0.5) * bins
            tilt = [float(c[0, 0]) for c in self._bound(middle[None], distance).cosines(_MIDDLE, _NO_POINT)]
            light = self._bound(middle[None], distance, middle_only)
            bounds = None if count == 1 else tuple((i / count, (i + 1) / count) for i in (column, row))
            yield Zone(_RealLight(light, self.wavelength, (tilt[0], tilt[1])), bounds, is_cut=True)  # type: ignore[arg-type]

    def _blur(self, width: NDArray[np.float64], count: int, distance: float) -> float:
        """Return how far, on the MLA, rays of the corners of zones go astray by the path of the zone's middle."""
        number = (np.arange(count) + 0.5) / count - 0.5
        x, y = (values.ravel() * count for values in np.meshgrid(number * width[0], number * width[1]))
        middles = np.stack([x, y], axis=-1)
        angle = np.pi * np.arange(8) / 4
        pupil = tuple(self.camera.pupil_radius * f(angle)[None] for f in (np.cos, np.sin))
        worst = 0.0
        at_middle = self._astray(middles, pupil, distance)
        for side in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            corner = self._astray(middles + np.array(side) * width / 2, pupil, distance)
            worst = max(worst, float(np.hypot(*(corner - at_middle)).max()))
        return worst * self.camera.pupil_distance

    def _astray(self, places: NDArray[np.float64], pupil: Any, distance: float) -> NDArray[np.float64]:
        """Return the directions of rays from places of the pupil, less that of the chief ray; (2, n, rays)."""
        light = self._bound(places, distance)
        rim, chief = (np.stack(light.cosines(where, _NO_POINT)) for where in (pupil, _MIDDLE))
        return np.asarray(rim - chief)


_MIDDLE, _NO_POINT = (np.zeros((1, 1)), np.zeros((1, 1))), (0.0, 0.0, 0.0)


def behind_thin_lens(system: OpticalSystem, radius: float | None = None) -> PlenopticCamera:
    """Return a camera with a thin main lens in the exit pupil, as the array sees the real one.

    Parameters
    ----------
    system : OpticalSystem
        The camera, with a real main lens, at one wavelength.
    radius : float, optional
        Radius of its pupil in millimetres. Default: that of a circle that holds the light of all the field.
    """
    lens = cast(RealLens, system.lens)
    return system.camera.replace(
        main_lens=None,
        focal_length=1 / Pupils.of(lens).at_infinity,
        aperture_radius=lens.reach if radius is None else radius,
        mla_distance=float(lens.pupil_distance),
    )


def _widened(camera: PlenopticCamera, more: int) -> PlenopticCamera:
    """Return the camera with so many pixels more on each side, which it does not record."""
    columns, rows = camera.resolution
    return camera.replace(
        detector_width=camera.detector_width + 2 * more * camera.pixel_size,
        resolution=(columns + 2 * more, rows + 2 * more),
        crop_offset=(camera.crop_offset[0] + more, camera.crop_offset[1] + more),
        crop_size=camera.crop_size,
    )


def undistorted(
    power: NDArray[np.float64], conjugates: RealConjugates, camera: PlenopticCamera, distance: float, fine: int
) -> tuple[NDArray[np.float64], float]:
    """Move power from bins of chief rays on the array to bins of the object plane.

    Parameters
    ----------
    power : float64 array (rows, columns)
        In fine bins of the camera of the conjugates.
    conjugates : RealConjugates
        The main lens.
    camera : PlenopticCamera
        The camera itself.
    distance : float
        Of the object plane; may be infinite.
    fine : int
        Fine bins across a lens pitch.

    Returns
    -------
    moved : float64 array (rows, columns)
        In fine bins of the object plane, :math:`-X b / g`.
    scale : float
        Distances there, near the axis, over those on the array.
    """
    found = conjugates.lens.image_stretch(camera, distance)
    columns, rows = (count * fine for count in camera.bin_count)
    step = camera.mla_pitch / fine
    x, y = ((np.arange(count) - (count - 1) / 2) * step for count in (columns, rows))
    away = np.hypot(x, y[:, None])
    stretch = np.interp(away, found.places, found.ratio) / step
    at = [y[:, None] * stretch + (power.shape[0] - 1) / 2, x * stretch + (power.shape[1] - 1) / 2]
    moved = ndimage.map_coordinates(power, at, order=1, mode="constant") * np.interp(away, found.places, found.area)
    return np.where(away <= found.places[-1], moved, 0), 1 / float(found.ratio[0])
