"""Rays of some lenses into the scene: what those that find light have found, and how that fills the pupil."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics.fitted_lens import lens_of_rays
from ..optics.lens_system import LensSystem
from ..optics.main_lens import UniformLens
from ..optics.open_pupil import open_fraction, pupil_bound
from ..optics.telecentric import TelecentricLens
from ..runtime.limits import largest_fitting, require_memory
from .draws import Found, channels, draw
from .entrance import Entrances, Front
from .gloss import glossy, pupil_radiance
from .lens_window import LensWindow
from .places import Vertex
from .sight import Sight
from .visibility import LANES, PUPIL_CELLS, visible_cells

_LANE_BYTES = 256
"""Memory of a light path on its way."""

_CHAIN_BYTES = 1024
"""The same where null and delta lobes are followed."""

_INFINITY = 1e6
"""Where the radiator of a ray that leaves the scene is put, in main lens images: far enough to be collimated."""


@dataclass(frozen=True)
class Finds:
    """What rays have found, each one radiator.

    Attributes
    ----------
    pupil : (n, 2) float64 array
        Where the rays, or the lines that these lie on, pass the plane z = 0 of the camera frame.
    positions, radiance, variance
        As of `Radiators`.
    curved : (n,) bool array
        Whether the light has come through refracting or curved surfaces.
    astigmatism : (n,) array
        By how much the reciprocal distances of its two line images differ.
    slant : (n, 2) array
        How slantwise its surface faces the lens, as `PupilWeights` takes it.
    visible : (n, bytes) uint8 array
        Bits of the cells of the pupil that it sees.
    shiny : (n,) bool array
        Whether its light is uneven over the pupil.
    power : (glossy, cells, cells) float32 array
        Of those, the radiance towards each cell.
    """

    pupil: np.ndarray
    positions: np.ndarray
    radiance: np.ndarray
    variance: np.ndarray
    curved: np.ndarray
    astigmatism: np.ndarray
    slant: np.ndarray
    visible: np.ndarray
    shiny: np.ndarray
    power: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Finds]) -> Finds:
        """Return all of several."""
        names = [each.name for each in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    @classmethod
    def nothing(cls, channels: int) -> Finds:
        """Return what is found where nothing shines."""
        nothing, places = np.empty(0), np.empty((0, 2))
        radiance, variance = np.empty((2, 0, channels))
        return cls(places, np.empty((0, 3)), radiance, variance, nothing > 0, nothing, places, *_over_pupil(0))

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        return sum(getattr(self, each.name).nbytes for each in fields(self))


@dataclass(frozen=True)
class PairTracer:
    """Traces the same pairs, places in the lens and in the pupil, from any lens of a window.

    Attributes
    ----------
    sight : Sight
        The scene, and the integrator that finds the radiance.
    camera : PlenopticCamera
        The sensor's numbers.
    front : Front
        The camera's pupil, seen from the scene.
    window : LensWindow
        The lenses.
    pairs : (n, 4) array
        The pairs, as from `sample_pairs`.
    spp : int
        Light paths averaged per radiator.
    occlusion : bool
        Whether to find by shadow rays which part of the pupil each radiator sees.
    weight : callable, or None
        Returns, for the vergences of the radiators' images, what fraction of their light counts.
    dark : bool
        Whether to keep what a ray meets though it does not shine.
    """

    sight: Sight
    camera: PlenopticCamera
    front: Front
    window: LensWindow
    pairs: np.ndarray
    spp: int
    occlusion: bool
    weight: Callable[[np.ndarray], np.ndarray] | None
    dark: bool

    @property
    def _lanes(self) -> int:
        """How many light paths are followed at once."""
        return LANES if self.sight.optics.plain else LANES // 16

    @property
    def together(self) -> int:
        """How many lenses are traced at once."""
        return max(1, self._lanes // (len(self.pairs) * self.spp))

    def require_memory(self) -> None:
        """Refuse light paths that do not fit: a batch holds those of one lens or more."""
        each = _LANE_BYTES if self.sight.optics.plain else _CHAIN_BYTES

        def memory(per_lens: int) -> float:
            paths = float(per_lens) ** 2 * self.spp
            return each * max(min(self._lanes, paths * len(self.window.index)), paths)

        def fitting(limit: float) -> str | None:
            largest = largest_fitting(memory, limit, per_lens)
            return f"radiators_per_lens = {largest}" if largest else None

        per_lens = math.isqrt(len(self.pairs))
        require_memory(
            memory(per_lens), f"{per_lens} x {per_lens} radiators of {self.spp} light paths in a lens", fitting
        )

    def trace(self, lenses: range, seed: int) -> Finds:
        """Find the radiators of some lenses.

        Parameters
        ----------
        lenses : range
            Numbers of the lenses in the window.
        seed : int
            Seed of the child's random numbers.
        """
        camera, sight, pairs, spp = self.camera, self.sight, self.pairs, self.spp
        lens, radius = lens_of_rays(camera), pupil_bound(camera)

        def primary(radiator: Any) -> tuple[Any, Any, Any, Any]:
            # A literal would be compiled anew into the kernels of every batch.
            cell = radiator // len(pairs) + dr.opaque(mi.UInt32, lenses.start)
            pair = radiator % len(pairs)
            place = [dr.gather(mi.Float, mi.Float(pairs[:, i].astype(np.float32)), pair) for i in range(4)]
            P = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(place[2], place[3])) * radius
            i, j = (dr.gather(mi.Float, mi.Float(index.astype(np.float32)), cell) for index in self.window.index.T)
            q = mi.Point2f(*self.window.place(i + place[0], j + place[1]))
            point, slope, is_open = lens.ray((P.x, P.y), (q.x, q.y))
            # As wide as the others: a thin lens's rays all start from the same plane.
            z = point[2] + dr.zeros(mi.Float, dr.width(radiator))
            return P, mi.Point3f(point[0], point[1], z), mi.Point2f(*slope), is_open

        kept, open_rays = dr.arange(mi.UInt32, len(lenses) * len(pairs)), None
        if camera.prescription is not None:
            kept = dr.compress(primary(kept)[3])
            open_rays = kept.numpy()
            if not open_rays.size:
                return Finds.nothing(len(channels(dr.zeros(mi.UnpolarizedSpectrum, 1))))
        lane = dr.arange(mi.UInt32, dr.width(kept) * spp)
        P, point, slope, _ = primary(dr.gather(mi.UInt32, kept, lane // spp))
        ray, cosine = sight.ray(tuple(point), (slope.x, slope.y))
        found = draw(sight, seed, ray, spp, self.dark)
        bad = int(np.count_nonzero(~np.isfinite(found.radiance).all(axis=-1)))
        if bad:
            raise InputError(f"scene: the radiance of {bad} radiators is NaN or infinite: all must be finite")
        if not found.lane.size:
            return Finds.nothing(found.radiance.shape[1])
        if open_rays is not None:
            factor = self._evened(open_rays // len(pairs), lenses)
            found = found.weighted(factor[found.lane // spp])
        depth = _depth(found, cosine, point.z, lens)
        if self.weight is not None:
            factor = self.weight(lens.vergence(depth))
            if not factor.any():
                return Finds.nothing(found.radiance.shape[1])
            found, depth = found.weighted(factor), depth[factor > 0]
        first = mi.UInt32(found.lane)
        P, slope = (dr.gather(mi.Point2f, mi.Point2f(v), first).numpy().astype(np.float64).T for v in (P, slope))
        point = dr.gather(mi.Point3f, point, first).numpy().astype(np.float64).T
        through = point[:, :2] - slope * point[:, 2:]
        positions = np.column_stack([through + slope * depth[:, None], depth])
        rays = dr.gather(mi.Ray3f, ray, first)
        visible, shiny, power = self._filled(found.vertex, rays, Entrances(self.front, P, positions, slope), seed)
        place = found.vertex.place
        curved, astigmatism = (np.broadcast_to(part.numpy(), len(P)) for part in (place.curved, place.astigmatism))
        normals = sight.sensor.world_transform().inverse() @ mi.Normal3f(place.apparent)
        slant = self.front.slants(np.broadcast_to(normals.numpy().T, positions.shape), positions, radius)
        return Finds(
            through, positions, found.radiance, found.variance, curved, astigmatism, slant, visible, shiny, power
        )

    def _filled(
        self, vertex: Vertex, rays: Any, entrances: Entrances, seed: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which cells of the pupil vertices see, which are glossy, and the power of those over the pupil."""
        optics, to_world = self.sight.optics, self.sight.sensor.world_transform()
        radius = pupil_bound(self.camera)
        visible, shiny, power = _over_pupil(dr.width(rays))
        if self.occlusion:
            visible = visible_cells(optics, to_world, vertex, rays, entrances, radius)
            shiny = glossy(optics, vertex, rays, radius)
        if shiny.any():
            some = mi.UInt32(np.flatnonzero(shiny).astype(np.uint32))
            vertex, rays = dr.gather(Vertex, vertex, some), dr.gather(mi.Ray3f, rays, some)
            power = pupil_radiance(optics, to_world, vertex, rays, entrances.take(shiny), radius, seed)
        return visible, shiny, power

    def _evened(self, lens: np.ndarray, lenses: range) -> np.ndarray:
        """Return factors on the light of rays that get through, by which each lens has that of its open pupil.

        Of few rays to a lens, a fraction gets through that is the open fraction of the pupil to some percent only.

        Parameters
        ----------
        lens : int array (n,)
            Number of each ray's lens within `lenses`.
        lenses : range
            Numbers of the lenses in the window.
        """
        counts = np.bincount(lens, minlength=len(lenses))
        x, y = self.window.place(*(self.window.index[lenses.start : lenses.stop] + 0.5).T)
        return (len(self.pairs) * open_fraction(self.camera, x, y) / np.maximum(counts, 1))[lens]


def _depth(found: Found, cosine: Any, start: Any, lens: UniformLens | LensSystem) -> np.ndarray:
    """Return the distances g of places; beyond some all wavefronts are flat."""
    first = mi.UInt32(found.lane)
    depth = found.vertex.place.distance * dr.gather(mi.Float, cosine, first) + dr.gather(mi.Float, start, first)
    numbers = depth.numpy().astype(np.float64)
    if isinstance(lens, TelecentricLens):
        return numbers
    farthest = _INFINITY / float(lens.vergence(math.inf))
    return np.where(np.abs(numbers) < farthest, numbers, farthest)


def _over_pupil(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bits, glossiness and power over the pupil of radiators of which all see all of it evenly."""
    bits = np.full((count, PUPIL_CELLS**2 // 8), 255, np.uint8)
    return bits, np.zeros(count, bool), np.empty((0, PUPIL_CELLS, PUPIL_CELLS), np.float32)
