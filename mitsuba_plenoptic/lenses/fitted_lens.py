r"""A real main lens for the waves of many points: its exit pupil as polynomials over pupil, field and distance.

`ExitPupil` traces and fits the light of one point. Here rays of points all over the field and all distances in question
are fitted together, so that the light of any number of points costs no more rays. Of the path the polynomial is what
differs from a pupils around the paraxial image (the wave aberration, distortion included: Welford, "Aberrations of
Optical Systems", chapters 7 and 8); others are the amplitude, and what each surface that cuts beams leaves of them.
Rays of points in between judge the fit.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import guards
from ..optics.phase import in_millimetres
from ..runtime.limits import single_threaded_blas
from .finite_pupil import FinitePupil
from .lens_system import LensSystem
from .main_lens import MainLens, UniformLens, main_lens
from .open_pupil import pupil_bound
from .pupil_fit import PupilFit, Pupils, covered, fit_pupil, trace
from .pupil_polynomials import LensLight, Place, Polynomial
from .wave_cameras import require_ideal

_FIELD_STEP, _NEARNESS_STEP = 1.1, 0.02
"""Steps of the fitted range: of fields, by factors, and of nearnesses, over the power of the lens. Fits are kept."""

_NARROWEST = 0.1
"""Range of fields that is fitted at least, over that of the detector."""

FAR = 1e13
"""Distance in millimetres at which light counts as collimated."""

WITHIN = 0.999
"""Part of the fitted field that is asked for: the last digits of a place may lie beyond."""

_INVERSIONS = 12
"""Steps by which scene points of given images are found: each takes away the error but for the distortion's part."""

_HEIGHTS, _ANGLES, _RADII = 33, 16, 8
"""Fields and places on the pupil at which wavefronts are compared."""

_RIM = 0.999
"""Largest of these places, over the pupil's radius: what lies on the very edge may count as outside."""

_AS_TOLD = 2.0
"""What changes of the path count for.

With the closed form of the thin lens the bounds of sharing have been chosen, and it tells as much more than its path.
"""

_WIDER = 1.1
"""Field that is asked for over that of the detector's corner: the lens may distort, and light is blurred."""

_NEAR_EDGE = 0.15
"""Distance, over the pupil's radius, up to which places feel by how much an edge moves."""

_EDGE_WEIGHT = 1 / 4
"""Waves of a wavefront that is as unlike as light whose edge moves by what one wave's tilt across a lens does."""


@dataclass(frozen=True, eq=False)
class FittedLens(FinitePupil):
    """A real main lens at one wavelength, for scene points within a range of fields and distances.

    Attributes
    ----------
    system : LensSystem
        The lens, for rays.
    pupil_radius : float
        Radius of a circle about the axis that holds the open exit pupil wherever the detector looks, in millimetres.
    fitted : PupilFit
        The polynomials.
    """

    system: LensSystem
    pupil_radius: float
    fitted: PupilFit

    is_round = True

    @property
    def pupil_distance(self) -> float:
        """Distance from the exit pupil to the MLA in millimetres."""
        return float(self.system.pupil_distance)

    def vergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance, behind the rear principal plane, of an object plane's image."""
        return self.system.vergence(distance)

    def convergence(self, distance: Any) -> Any:
        """Return the reciprocal of the distance from the exit pupil to an object plane's image."""
        return self.fitted.pupils.convergence(1 / (distance - self.fitted.pupils.entrance))

    def trace(self, place: Place, slope: Place) -> tuple[tuple[Any, Any, Any], Place, Any]:
        """Follow a ray from a place on the MLA to the scene, as `MainLens.trace` does."""
        return self.system.trace(place, slope)

    def ray(self, pupil: Place, place: Place) -> tuple[tuple[Any, Any, Any], Place, Any]:
        """Return the ray that comes from a place on the MLA through a pupil point, as `MainLens.ray` does."""
        return self.system.ray(pupil, place)

    def bind(self, points: NDArray[np.float64], which: Any = None) -> LensLight:
        """Return the light of some points, as `MainLens.bind` does."""
        fitted, pupils = self.fitted, self.fitted.pupils
        field, nearness = pupils.field(points)

        def lanes(column: NDArray[np.float64]) -> Any:
            if which is None:
                return np.ascontiguousarray(column)[:, None]
            Float64 = dr.float64_array_t(type(which))
            return dr.gather(Float64, Float64(np.ascontiguousarray(column)), which)

        places = lanes(field[:, 0]), lanes(field[:, 1])

        def over_pupil(polynomial: Polynomial) -> Any:
            return polynomial.over_pupil([lanes(column) for column in polynomial.at(field, nearness).T], places)

        slope = pupils.slope(field)
        return LensLight(
            self.pupil_distance,
            (lanes(slope[:, 0]), lanes(slope[:, 1])),
            lanes(pupils.convergence(nearness)),
            over_pupil(fitted.aberration),
            over_pupil(fitted.brightness),
            [over_pupil(stop) for stop in fitted.stops],
        )

    def images(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where on the MLA the rays through the middle of the exit pupil come; (n, 2)."""
        zero = np.zeros((len(points), 1))
        return np.concatenate(self.bind(points).land((zero, zero), None), axis=1)

    def nearness(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the reciprocals of the distances of points from the entrance pupil; (n,)."""
        return self.fitted.pupils.field(points)[1]

    def points(self, images: NDArray[np.float64], nearness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the scene points that have these images and nearnesses, (n, 3)."""
        pupils, distance = self.fitted.pupils, 1 / nearness
        depth = distance + pupils.entrance
        field = -images * (pupils.magnification / self.pupil_distance)
        found = field
        for _ in range(_INVERSIONS):
            found = self.images(np.column_stack([field * distance[:, None], depth]))
            square = (found**2).sum(1)
            far = square > 0
            field = field * np.where(far, (found * images).sum(1) / np.where(far, square, 1), 1)[:, None]
        return np.column_stack([field * distance[:, None], depth])

    def within(self, images: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places on the MLA (..., 2), those to which no light comes moved towards the axis to where it does."""
        away = np.hypot(images[..., 0], images[..., 1])[..., None]
        return np.asarray(images * np.minimum(1, self._covered / np.maximum(away, 1e-12)))

    @functools.cached_property
    def _covered(self) -> float:
        """Distance from the axis up to which light comes to the array, whatever the distance of its points."""
        scales, entrance = self.fitted.aberration.scales, self.fitted.pupils.entrance
        distances = [
            min(1 / max(near, 1e-300), FAR) for near in (scales.middle - scales.half, scales.middle + scales.half)
        ]
        ends = [[0.0, scales.field * distance, distance + entrance] for distance in distances]
        return WITHIN * float(np.hypot(*self.images(np.array(ends)).T).min())

    def path_change(self, radius: Any, step: Any, wavelength: float) -> Any:
        """Return by how many waves wavefronts differ whose images lie a step apart, as `MainLens.path_change` does.

        Where edges cut beams, light that they let through or not counts, too.
        """
        places, paths, edges = self._changes
        path, edge = np.interp(radius, places, paths), np.interp(radius, places, edges)
        across = _EDGE_WEIGHT * edge * step / self.pupil_distance
        return (_AS_TOLD * path + across) * (step / in_millimetres(wavelength))

    @functools.cached_property
    def _changes(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Distances of images from the axis; there, for images that move outwards or aside, the most by which change.

        Over all distances, per millimetre: the path in millimetres, beyond the tilt of the middle, and the place of an
        edge on the pupil.
        """
        scales = self.fitted.aberration.scales
        angle = 2 * math.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
        circle = _RIM * self.pupil_radius * np.stack([np.cos(angle), np.sin(angle)])
        x, y = (circle[:, None] * (np.arange(1, _RADII + 1) / _RADII)[:, None]).reshape(2, 1, -1)
        heights, middle = np.linspace(0, scales.field, _HEIGHTS), (0.0, 0.0)
        places, paths, edges = np.zeros((3, _HEIGHTS))
        for nearness in scales.middle + scales.half * np.array([-1.0, 0.0, 1.0]):
            distance = 1 / (nearness or 1e-12)
            points = np.column_stack([0 * heights, heights * distance, np.full(_HEIGHTS, distance)])
            points[:, 2] += self.fitted.pupils.entrance
            images, here = self.images(points), self.bind(points)
            places = np.maximum(places, np.hypot(*images.T))
            step = 1e-3 * float(np.hypot(*images.T).max())
            edge = here.inside((x, y))
            for aside in (np.array([0.0, step]), np.array([step, 0.0])):
                there = self.bind(self.points(images + aside, np.full(_HEIGHTS, 1 / distance)))
                tilt = [b - a for a, b in zip(here.cosines(middle, None), there.cosines(middle, None), strict=True)]
                path = there.length((x, y)) - here.length((x, y)) - x * tilt[0] - y * tilt[1]
                paths = np.maximum(paths, np.abs(np.where(edge > 0, path, 0)).max(1) / step)
                moved = np.where(np.abs(edge) < _NEAR_EDGE * self.pupil_radius, there.inside((x, y)) - edge, 0)
                edges = np.maximum(edges, np.abs(moved).max(1) / step)
        return places, paths, edges


def lens_of_waves(camera: PlenopticCamera, points: NDArray[np.float64], wavelength: float) -> MainLens:
    """Return a camera's main lens as the waves of some points pass it.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    points : float64 array (n, 3)
        Scene points in the camera frame, or in one that is turned about the axis.
    wavelength : float
        Wavelength in nanometres.

    Raises
    ------
    InputError
        If a point does not lie before a real main lens, or not within the field that it covers, or the camera has what
        waves do not know.
    PhysicsError
        If the path cannot be fitted.
    """
    if camera.prescription is None:
        return main_lens(camera)
    system = LensSystem.of(camera, wavelength)
    front = max(system.front_bounds[1])
    within = (points[:, 2] > 0) & (points[:, 2] <= front)
    if within.any():
        raise InputError(
            f"position: g = {points[within][0, 2]:g}: it must lie before the main_lens, beyond {front:.6g}"
        )
    field, nearness = Pupils.of(system).field(points) if len(points) else (np.zeros((1, 2)), np.zeros(1))
    largest = np.hypot(*field.T)
    lens = _over_field(camera, wavelength, float(largest.max()), (float(nearness.min()), float(nearness.max())))
    beyond = largest > lens.fitted.aberration.scales.field
    if beyond.any():
        place = ", ".join(f"{c:g}" for c in points[beyond][0])
        raise InputError(f"position = ({place}): no light of it passes the main_lens")
    return _judged(lens)


def lens_over_field(
    camera: PlenopticCamera, wavelength: float, field: float, nearness: tuple[float, float]
) -> FittedLens:
    """Return a camera's real main lens, fitted up to a field or as far as it lets light through.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    field : float
        Slope, from the middle of the entrance pupil, of the scene points farthest from the axis.
    nearness : (float, float)
        Least and largest reciprocal of the distances of scene points from the entrance pupil, in 1/mm.

    Raises
    ------
    InputError
        If no light passes it.
    PhysicsError
        If the path cannot be fitted.
    """
    return _judged(_over_field(camera, wavelength, field, nearness))


def _over_field(camera: PlenopticCamera, wavelength: float, field: float, nearness: tuple[float, float]) -> FittedLens:
    """Return a lens that is fitted so far; fits are kept, and their ranges grow by steps."""
    least = _NARROWEST * math.hypot(camera.detector_width, camera.detector_height) / (2 * camera.mla_distance)
    steps = math.ceil(math.log(max(1, field / least)) / math.log(_FIELD_STEP))
    power = _NEARNESS_STEP / camera.focal_length
    low, high = math.floor(nearness[0] / power), math.ceil(nearness[1] / power)
    return _fitted(camera, wavelength, least * _FIELD_STEP**steps, low * power, max(high, low + 1) * power)


def _judged(lens: FittedLens) -> FittedLens:
    """Return a lens whose path is fitted well enough."""
    guards.judge(guards.MAIN_LENS, -math.expm1(-((2 * math.pi * lens.fitted.error) ** 2)))
    return lens


def farthest_points(camera: PlenopticCamera, wavelength: float, distances: Sequence[float]) -> NDArray[np.float64]:
    """Return points as far from the axis as a detector sees through a real main lens, one at each distance; (n, 3).

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    wavelength : float
        Wavelength in nanometres.
    distances : sequence of float
        Finite distances in millimetres.
    """
    entrance = Pupils.of(LensSystem.of(camera, wavelength)).entrance
    depths = np.array(distances)
    near = 1 / (depths - entrance)
    corner = _WIDER * math.hypot(camera.detector_width, camera.detector_height) / (2 * camera.mla_distance)
    field = corner * depths * near
    lens = lens_over_field(camera, wavelength, float(field.max()), (float(near.min()), float(near.max())))
    field = np.minimum(field, WITHIN * lens.fitted.aberration.scales.field)
    return np.column_stack([0 * depths, field / near, depths])


@functools.lru_cache(maxsize=16)
def _fitted(camera: PlenopticCamera, wavelength: float, field: float, low: float, high: float) -> FittedLens:
    """Fit a lens up to a field, or as far as it covers, for a range of nearnesses."""
    system = LensSystem.of(camera, wavelength)
    tracer = functools.partial(trace, system)
    radius, nearness = camera.aperture_radius, (low, high)
    field = covered(tracer, radius, field, nearness)
    if not field > 0:
        raise InputError("main_lens: no light of the scene points passes it")
    with single_threaded_blas():  # the matrices are narrow, and its threads wait for each other actively
        fitted = fit_pupil(tracer, Pupils.of(system), radius, field, nearness, wavelength)
    return FittedLens(system, pupil_bound(camera), fitted)


def lens_of_rays(camera: PlenopticCamera) -> UniformLens | LensSystem:
    """Return a camera's main lens as rays that look for points pass it.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.

    Raises
    ------
    InputError
        As of `lens_of_waves`.
    """
    require_ideal(camera)
    return main_lens(camera) if camera.prescription is None else LensSystem.of(camera)
