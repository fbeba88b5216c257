r"""Where rays from microlenses' centres go, and what the bank is asked for them; main lenses are thin or real.

Behind a real lens neighbouring rays are followed, too. With :math:`u = s + x / g` where a ray of slope s, which crosses
the plane z = 0 at x, meets the plane at the distance g; P its place on the exit pupil, and c that on the array: light
of the point that it meets comes from elsewhere on the pupil to other lenses, by

.. math:: \frac{dP}{dM} = - \left( \frac{\partial u}{\partial P} \right)^{-1} \frac{\partial u}{\partial c}.

Beyond the edges, from where light comes by diffraction alone, rays go on as they do there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr

from ..camera import PlenopticCamera
from ..optics.lens_system import LensSystem
from ..optics.open_pupil import pupil_bound
from ..optics.thin import ThinLens
from .bank import LensBank, at_pupil, local_point
from .pupil_edges import PupilEdges

Pair = tuple[Any, Any]

_RIM = 1.1
"""Distance from the axis in the pupil, in its radii, beyond which fewer rays are traced."""

_STEPS = 0.08, 0.02
"""Distances of neighbouring rays on the pupil and on the array, over the pupil's radius: single precision must do."""

_SLACK = 1.1
"""How much farther beyond the edges light may reach than by the mean blur."""


class Paths(Protocol):
    """Rays from the array through the main lens."""

    @property
    def pupil_distance(self) -> float:
        """Distance from the exit pupil to the array."""

    @property
    def widest(self) -> float:
        """Distance from the axis, in the pupil, beyond which no ray counts."""

    def lit(self, pupil: Pair, centre: Pair) -> tuple[Any, Any]:
        """Tell through which places of the pupil light comes to lenses, and through which others by diffraction."""

    def follow(self, pupil: Pair, centre: Pair, slope: Pair) -> Path:
        """Follow rays from the lenses' centres through places of the pupil."""


@dataclass(frozen=True)
class Path:
    """Rays towards the scene.

    Attributes
    ----------
    point : (Float, Float, Float)
        Where they start, in the camera frame.
    slope : (Float, Float)
        Their slopes.
    vergence : callable
        From distances that they go to the vergences of the images of what is there.
    reaches : callable
        From vergences to whether light of such a point comes to the lens.
    asked : callable
        From these distances and vergences to the pupil points and vergences for `LensBank.coefficients`.
    """

    point: tuple[Any, Any, Any]
    slope: Pair
    vergence: Callable[[Any], Any]
    reaches: Callable[[Any], Any]
    asked: Callable[[Any, Any], tuple[Any, Any, Any]]


class ThinPaths:
    """Rays through a thin lens; parameters as of `paths_of`."""

    def __init__(self, camera: PlenopticCamera, banks: Sequence[LensBank]) -> None:
        self._radius, self._reach = camera.aperture_radius, banks[0].reach
        self.pupil_distance = camera.mla_distance
        self.widest = max(bank.widest for bank in banks)
        # The aberrations of the parabolic phase that waves pass displace the spots.
        self._lens = ThinLens(camera.focal_length, camera.aperture_radius, camera.mla_distance, "parabolic")

    def lit(self, pupil: Pair, centre: Pair) -> tuple[Any, Any]:
        """Tell where light comes, and where by diffraction alone, as `Paths.lit` does."""
        square = pupil[0] * pupil[0] + pupil[1] * pupil[1]
        inner = square < min(_RIM * self._radius, self.widest) ** 2
        return inner, ~inner & (square < self.widest**2)

    def follow(self, pupil: Pair, centre: Pair, slope: Pair) -> Path:
        """Follow rays, as `Paths.follow` does."""
        point, slope, _ = self._lens.trace(centre, slope)

        def reaches(vergence: Any) -> Any:
            return dr.hypot(*pupil) < self._radius + self._reach(vergence)

        return Path(point, slope, self._lens.vergence, reaches, lambda _, vergence: (*pupil, vergence))


class RealPaths:
    """Rays through a real main lens; parameters as of `paths_of`."""

    def __init__(self, camera: PlenopticCamera, banks: Sequence[LensBank], wavelength: float) -> None:
        self._camera = camera
        # Near focus is what the radiators' rays call so, at the lens's own wavelength.
        self._lens, self._own = LensSystem.of(camera, wavelength), LensSystem.of(camera)
        self._radius = camera.pupil_radius
        self._beyond = _SLACK * (max(bank.widest for bank in banks) - self._radius)
        self._reach = banks[0].reach
        self._edges = PupilEdges.of(camera)
        self.pupil_distance = camera.pupil_distance
        self.widest = pupil_bound(camera) + self._beyond

    def lit(self, pupil: Pair, centre: Pair) -> tuple[Any, Any]:
        """Tell where light comes, and where by diffraction alone, as `Paths.lit` does."""
        away = _distance(pupil, self._edges.within(pupil, centre))
        inner = away < min((_RIM - 1) * self._radius, self._beyond)
        return inner, ~inner & (away < self._beyond)

    def follow(self, pupil: Pair, centre: Pair, slope: Pair) -> Path:
        """Follow rays, as `Paths.follow` does."""
        within = self._edges.within(pupil, centre)
        beyond = pupil[0] - within[0], pupil[1] - within[1]
        away = _distance(pupil, within)
        here = self._ray(within, centre)
        by_pupil, by_centre = (step * self._radius for step in _STEPS)
        changes = []
        for axis in (0, 1):
            moved = tuple(P + (by_pupil if k == axis else 0) for k, P in enumerate(within))
            changes.append(here.change(self._ray(moved, centre), by_pupil))
        for axis in (0, 1):
            moved = tuple(c + (by_centre if k == axis else 0) for k, c in enumerate(centre))
            changes.append(here.change(self._ray(within, moved), by_centre))
        there = here.plus(changes[0], beyond[0]).plus(changes[1], beyond[1])
        z = here.start
        point = tuple(x + s * z for x, s in zip(there.place, there.slope, strict=True))

        def vergence(distance: Any) -> Any:
            return self._own.vergence(z + distance)

        def reaches(vergence: Any) -> Any:
            return away < _SLACK * self._reach(at_pupil(self._camera, vergence))

        def asked(distance: Any, _: Any) -> tuple[Any, Any, Any]:
            nearness = 1 / (z + distance)
            (ax, ay), (bx, by), (cx, cy), (dx, dy) = (change.towards(nearness) for change in changes)
            # dP/dM = -S^-1 T with S = ((ax, bx), (ay, by)) and T = ((cx, dx), (cy, dy))
            scale = -1 / (ax * by - bx * ay)
            xx, xy = (by * cx - bx * cy) * scale, (by * dx - bx * dy) * scale
            yx, yy = (ax * cy - ay * cx) * scale, (ax * dy - ay * dx) * scale
            edges = []
            for value, ea, eb, ec, ed in zip(there.edges, *(change.edges for change in changes), strict=True):
                edges.append((value, (ec + ea * xx + eb * yx, ed + ea * xy + eb * yy)))
            return local_point(self._camera, ((xx, xy), (yx, yy)), edges)

        return Path((*point, z), there.slope, vergence, reaches, asked)

    def _ray(self, pupil: Pair, centre: Pair) -> _Ray:
        (x, y, z), slope, edges = self._lens.ray_and_edges(pupil, centre, self._edges.surfaces)
        return _Ray((x - z * slope[0], y - z * slope[1]), slope, edges, z)


@dataclass(frozen=True)
class _Ray:
    """A ray towards the scene, or by how much it changes.

    Attributes
    ----------
    place : (Float, Float)
        Where it crosses the plane z = 0.
    slope : (Float, Float)
        Its slope.
    edges : list of Float
        How far from the axis it meets surfaces, over their edges.
    start : Float
        Distance at which it leaves the lens.
    """

    place: Pair
    slope: Pair
    edges: list[Any]
    start: Any

    def change(self, other: _Ray, step: float) -> _Ray:
        """Return by how much another one is different, over the step to it."""
        return self._with(other, lambda mine, its: (its - mine) * (1 / step))

    def plus(self, change: _Ray, step: Any) -> _Ray:
        """Return the ray that is some steps of a change farther."""
        return self._with(change, lambda mine, its: mine + step * its)

    def _with(self, other: _Ray, combine: Callable[[Any, Any], Any]) -> _Ray:
        pairs = (zip(getattr(self, name), getattr(other, name), strict=True) for name in ("place", "slope", "edges"))
        place, slope, edges = ([combine(a, b) for a, b in pair] for pair in pairs)
        return _Ray((place[0], place[1]), (slope[0], slope[1]), edges, self.start)

    def towards(self, nearness: Any) -> Pair:
        """Return where it meets a plane, over the plane's distance, whose reciprocal is given."""
        x, y = (s + m * nearness for s, m in zip(self.slope, self.place, strict=True))
        return x, y


def _distance(a: Pair, b: Pair) -> Any:
    return dr.hypot(a[0] - b[0], a[1] - b[1])


def paths_of(camera: PlenopticCamera, banks: Sequence[LensBank], wavelength: float) -> Paths:
    """Return the paths through a camera's main lens.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    banks : sequence of LensBank
        Those that rays are for.
    wavelength : float
        Wavelength in nanometres.
    """
    return ThinPaths(camera, banks) if camera.prescription is None else RealPaths(camera, banks, wavelength)
