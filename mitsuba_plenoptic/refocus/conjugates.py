r"""Propagation from the exit pupil to object planes: the path of waves from a point of the array to its conjugate.

Waves are propagated back to the plane of the main lens's exit pupil. Only the factor at the pupil depends on the lens:
the path from a scene point, and the part of the pupil that the point's light passes. Seen from behind, a real lens is a
thin lens in its exit pupil. With the pupils' magnification m and the entrance pupil at :math:`z_E`, the paraxial image
of a point at the distance g is that of a thin lens at the distance :math:`m^2 (g - z_E)` (Welford, "Aberrations of
Optical Systems", section 2.6), so that sampling up to the pupil is that behind this thin lens, in directions of chief
rays. The real lens's aberrations are in the path and its vignetting in the edge; its distortion is corrected at the
end, see `undistorted`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
import numpy as np
from scipy import ndimage

from ..camera import PlenopticCamera
from ..errors import InputError, argument
from ..fields import OpticalSystem, is_paraxial
from ..lenses import FAR, FittedLens, Light, Pupils, RealLens, ThinLens
from ..optics import in_millimetres
from ..runtime import Doubles, Pair, Sizes, Triple, array_module

_MARGIN = 4
"""Lenses beyond the corner of the bins up to which the lens is fitted."""


@dataclass(frozen=True)
class Conjugate:
    """The passage through the exit pupil of light from one point of the array, or from one point per lane."""

    light: Any
    point: Triple
    wavelength: float
    tilt: Pair = (0.0, 0.0)

    def path(self, pupil: Pair) -> Any:
        """Return the path in waves from the object plane to pupil points, less a tilt."""
        waves = self.light.path(pupil, self.point, self.wavelength)
        if not any(self.tilt):
            return waves
        return waves - (pupil[0] * self.tilt[0] + pupil[1] * self.tilt[1]) * (1 / in_millimetres(self.wavelength))

    def inside(self, pupil: Pair) -> Any:
        """Return the distance in millimetres by which a point lies inside the pupil's edge."""
        return self.light.inside(pupil)


@dataclass(frozen=True)
class FieldZone:
    """Part of the field whose light passes the pupil like light at the part's middle, apart from a tilt.

    `bounds` are the part's limits as fractions of the bins' width and height; None is the whole field. If `is_cut`,
    light is limited by the conjugate's own edge as well as by the circle around the pupil.
    """

    light: Conjugate
    bounds: tuple[Pair, Pair] | None = None
    is_cut: bool = False

    def part(self, shape: Sizes) -> tuple[slice, ...]:
        """Return the slices of rows and columns of bins in the zone."""
        if self.bounds is None:
            return ()
        return tuple(
            slice(*(round(end * size) for end in ends)) for ends, size in zip(self.bounds[::-1], shape, strict=True)
        )


@dataclass(frozen=True)
class ParaxialLight:
    """Phase of an ideal thin main lens for all points at one distance, without tilts."""

    lens: ThinLens

    def path(self, pupil: Pair, point: Triple, wavelength: float) -> Any:
        """Return the path in waves from pupil points to a point at the distance of `point`."""
        return self.lens.paraxial_path(pupil, point[2], wavelength)

    def inside(self, pupil: Pair) -> Any:
        """Return the distance in millimetres by which a point lies inside the pupil's edge."""
        return self.lens.inside(pupil)


@dataclass(frozen=True)
class ThinConjugates:
    """Conjugates behind a thin main lens."""

    system: OpticalSystem

    @property
    def camera(self) -> PlenopticCamera:
        """The camera."""
        return self.system.camera

    def at(self, x: Any, y: Any, positions: Doubles, lens: Any, distance: float) -> Conjugate:
        """Return the conjugates of some lenses' centres, for an object plane before the thin lens of `camera`.

        Each lane has its lens's centre (x, y) and its index in `positions`, the centres as a float64 array (n, 2).
        """
        # Infinity is so far that nothing changes with the distance.
        b, g = (dr.opaque(type(x), length) for length in (self.camera.mla_distance, min(distance, FAR)))
        return self._light((-x * g / b, -y * g / b, g))

    def zones(self, distance: float) -> Iterator[FieldZone]:
        """Yield the whole field as one zone; behind a parabolic lens, changes over the field are neglected."""
        yield FieldZone(self._light((0.0, 0.0, distance)))

    def _light(self, point: Triple) -> Conjugate:
        lens = cast(ThinLens, self.system.lens)
        light = ParaxialLight(lens) if is_paraxial(self.camera) else lens
        return Conjugate(light, point, self.system.wavelength)


@dataclass(frozen=True, eq=False)
class RealConjugates:
    """Conjugates behind a real main lens."""

    camera: PlenopticCamera
    lens: FittedLens
    wavelength: float
    blur: float

    @classmethod
    def of(cls, system: OpticalSystem, distances: list[float], oversample: int) -> RealConjugates:
        """Return conjugates for object planes at some distances, with the main lens fitted over its field."""
        camera = system.camera
        real = cast(RealLens, system.lens)
        pupils = Pupils.of(real)
        front = real.entrance.front
        for distance in distances:
            if not distance > max(front, pupils.entrance):
                raise InputError(
                    f"distance = {distance:g}: it must lie before the main_lens, beyond "
                    f"{max(front, pupils.entrance):.6g}"
                )
        b = camera.mla_distance
        behind = float(real.pupil.distance)
        corner = math.hypot(*camera.bin_count) / 2 * camera.row_pitch + _MARGIN * camera.row_pitch
        inverse_distance = [1 / (min(distance, FAR) - pupils.entrance) for distance in distances]
        fields = [abs(pupils.magnification) / behind]
        fields += [min(g, FAR) * near / b for g, near in zip(distances, inverse_distance, strict=True)]
        lens = real.over_field(corner * max(fields), (min(inverse_distance), max(inverse_distance)))
        behind_thin = behind_thin_lens(system)
        wider = max(1.0, *(float(lens.image_stretch(camera, distance).ratio.max()) for distance in distances))
        # Pixels on each side that are not recorded.
        more = math.ceil((wider - 1) / 2 * max(behind_thin.resolution) - 1e-6)
        behind_thin = behind_thin.replace(
            detector_width=behind_thin.detector_width + 2 * more * behind_thin.pixel_size,
            resolution=tuple(size + 2 * more for size in behind_thin.resolution),
            crop_offset=tuple(first + more for first in behind_thin.crop_offset),
            crop_size=behind_thin.crop_size,
        )
        # Part of a bin by which the path of the middle of a zone may lead a ray from the pupil's rim astray at its
        # corners.
        return cls(behind_thin, lens, system.wavelength, 0.2 * camera.row_pitch / oversample)

    def distance(self, distance: float) -> float:
        """Return the distance of an object plane from the thin lens of `camera`."""
        pupils = self.lens.fitted.pupils
        return math.inf if math.isinf(distance) else pupils.magnification**2 * (distance - pupils.entrance)

    def _bound(self, positions: Doubles, distance: float, index: Any = None) -> Light:
        """Return the light of the conjugates of points on the MLA; points beyond the field receive no light."""
        inverse_distance = self.lens.fitted.pupils.magnification**2 / min(distance, FAR)
        points = self.lens.points(self.lens.within(positions), np.full(len(positions), inverse_distance))
        return self.lens.bind(points, index)

    def at(self, x: Any, y: Any, positions: Doubles, lens: Any, distance: float) -> Conjugate:
        """Return the conjugates of the centres of some lenses, as `ThinConjugates.at` does."""
        return Conjugate(self._bound(positions, distance, lens), _NO_POINT, self.wavelength)

    def zones(self, distance: float) -> Iterator[FieldZone]:
        """Yield zones so small that the path of light at a zone's middle serves the whole zone."""
        bins = np.array(self.camera.bin_count) * self.camera.row_pitch
        # Zones of the field along each axis, at most.
        for count in range(1, 9):
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
            yield FieldZone(Conjugate(light, _NO_POINT, self.wavelength, (tilt[0], tilt[1])), bounds, is_cut=True)  # type: ignore[arg-type]

    def _blur(self, width: Doubles, count: int, distance: float) -> float:
        """Return the displacement in mm, on the MLA, of zones' corner rays by the path of the zone's middle."""
        offset = (np.arange(count) + 0.5) / count - 0.5
        x, y = (values.ravel() * count for values in np.meshgrid(offset * width[0], offset * width[1]))
        middles = np.stack([x, y], axis=-1)
        angle = np.pi * np.arange(8) / 4
        pupil = tuple(self.camera.pupil_radius * f(angle)[None] for f in (np.cos, np.sin))
        worst = 0.0
        at_middle = self._astray(middles, pupil, distance)
        for side in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
            corner = self._astray(middles + np.array(side) * width / 2, pupil, distance)
            worst = max(worst, float(np.hypot(*(corner - at_middle)).max()))
        return worst * self.camera.pupil_distance

    def _astray(self, positions: Doubles, pupil: Any, distance: float) -> Doubles:
        """Return the directions of rays from pupil points, relative to the chief ray, (2, n, rays)."""
        light = self._bound(positions, distance)
        rim, chief = (np.stack(light.cosines(where, _NO_POINT)) for where in (pupil, _MIDDLE))
        return np.asarray(rim - chief)


Conjugates = ThinConjugates | RealConjugates

_MIDDLE = (np.zeros((1, 1)), np.zeros((1, 1)))
_NO_POINT = (0.0, 0.0, 0.0)


def behind_thin_lens(system: OpticalSystem) -> PlenopticCamera:
    """Return a camera with a thin main lens in the exit pupil of the real one.

    Its light propagates by direction cosines, as the path through a real lens is a function of them.
    """
    lens = cast(RealLens, system.lens)
    return system.camera.replace(
        main_lens=None,
        lens_model="parabolic",
        focal_length=1 / Pupils.of(lens).at_infinity,
        aperture_radius=lens.reach,
        mla_distance=float(lens.pupil.distance),
    )


def undistorted(
    power: Doubles, conjugates: RealConjugates, camera: PlenopticCamera, distance: float, fine: int
) -> tuple[Doubles, float]:
    """Return power moved from bins of chief rays on the array to bins of the object plane."""
    stretched = conjugates.lens.image_stretch(camera, distance)
    columns, rows = (count * fine for count in camera.bin_count)
    step = camera.row_pitch / fine
    x, y = ((np.arange(count) - (count - 1) / 2) * step for count in (columns, rows))
    away = np.hypot(x, y[:, None])
    stretch = np.interp(away, stretched.places, stretched.ratio) / step
    at = [y[:, None] * stretch + (power.shape[0] - 1) / 2, x * stretch + (power.shape[1] - 1) / 2]
    moved = ndimage.map_coordinates(power, at, order=1, mode="constant") * np.interp(
        away, stretched.places, stretched.area
    )
    return np.where(away <= stretched.places[-1], moved, 0), 1 / float(stretched.ratio[0])
