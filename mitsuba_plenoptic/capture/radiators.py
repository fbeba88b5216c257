r"""Incoherent radiators of a scene, found by rays, for the wave capture.

A ray through a point :math:`q` of the MLA plane and a point :math:`P` of the pupil meets the scene in a radiator
:math:`X`, and a child integrator tells its radiance towards the camera. The same pairs (place of q in its lens, P)
serve every lens, so that the capture of an even surface repeats from lens to lens, as it should, without noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics import guards
from ..optics.fitted_lens import lens_of_rays, lens_of_waves
from ..optics.lens_system import LensSystem
from ..optics.main_lens import UniformLens
from ..optics.open_pupil import open_fraction, pupil_bound
from ..optics.telecentric import TelecentricLens
from ..runtime.limits import largest_fitting, require_memory
from .chains import Optics
from .draws import Found, channels, draw
from .entrance import Entrances, Front
from .gloss import glossy, pupil_radiance
from .lens_window import LensWindow
from .places import Vertex
from .pupil_weights import PupilWeights
from .sight import Sight
from .visibility import LANES, PUPIL_CELLS, sampled_fraction, visible_cells

_LANE_BYTES = 256
"""Memory of a light path on its way."""

_CHAIN_BYTES = 1024
"""The same where null and delta lobes are followed."""

RADIATOR_BYTES = 2 * (40 + PUPIL_CELLS**2 // 8)
"""Memory of a radiator with the bits of its visible cells, while the parts are put together."""

_CAUSTIC = 1e-3
"""Fraction of the light, the most strongly curved by glass and mirrors, that does not decide the size of patches."""

_INFINITY = 1e6
"""Where the radiator of a ray that leaves the scene is put, in main lens images: far enough to be collimated."""

_LEVEL = 1e-3
"""Slants below which surfaces face the lens."""


@dataclass(frozen=True)
class Radiators:
    """Incoherent point sources in the camera frame.

    Attributes
    ----------
    pupil : (n, 2) float64 array
        Where the rays that have found them, or the lines that these lie on, pass the plane z = 0 of the camera frame.
    positions : (n, 3) float64 array
        Places.
    radiance : (n, channels) float64 array
        Radiance towards the pupil.
    variance : (n, channels) float64 array
        Variance of `radiance`, estimated from its light paths as if they were independent: an upper bound where they
        choose lobes or free paths, which are spread evenly. NaN where there is but one.
    fraction : (n,) float64 array
        Fraction of the visible pupil whose rays from the radiator land in the sampled part of the MLA plane: those
        are the rays that could have found it.
    pupil_weights : PupilWeights, or None
        How the light of each fills the pupil: what it sees of it, and how slantwise; None if all fill all evenly.
    """

    pupil: np.ndarray
    positions: np.ndarray
    radiance: np.ndarray
    variance: np.ndarray
    fraction: np.ndarray
    pupil_weights: PupilWeights | None

    def take(self, which: np.ndarray) -> Radiators:
        """Return some of them."""
        weights = self.pupil_weights
        return Radiators(
            self.pupil[which],
            self.positions[which],
            self.radiance[which],
            self.variance[which],
            self.fraction[which],
            None if weights is None else weights.take(which),
        )


def sample_pairs(per_lens: int, shift: np.ndarray) -> np.ndarray:
    """Low-discrepancy places in the unit 4-cube: place in the lens cell (2), place in the pupil (2).

    Parameters
    ----------
    per_lens : int
        Radiators per lens and axis.
    shift : (4,) array
        Toroidal shift of the whole set.

    Returns
    -------
    (per_lens**2, 4) float64 array
        The first n points of a Sobol sequence with one fixed scrambling; for powers of two the places in the lens
        are stratified.
    """
    # It takes a third of the package's loading time, which commands that render no waves need not wait for.
    from scipy.stats import qmc

    count = per_lens**2
    # The sequence is drawn to the next power of two, where it is balanced.
    points = qmc.Sobol(4, scramble=True, rng=0).random_base2(math.ceil(math.log2(max(count, 1))))
    return np.asarray((points[:count] + shift) % 1.0)


def find_radiators(
    sight: Sight,
    camera: PlenopticCamera,
    pairs: np.ndarray,
    *,
    spp: int,
    seed: int,
    occlusion: bool,
    weight: Callable[[np.ndarray], np.ndarray] | None = None,
    lenses: np.ndarray | None = None,
    dark: bool = False,
) -> Radiators:
    """Trace the pairs of every lens into the scene and keep what shines.

    Parameters
    ----------
    sight : Sight
        The scene, and the integrator that finds the radiance.
    camera : PlenopticCamera
        The sensor's numbers.
    pairs : (n, 4) array
        As from `sample_pairs`.
    spp : int
        Light paths averaged per radiator.
    seed : int
        Seed of the child's random numbers.
    occlusion : bool
        Whether to find by shadow rays which part of the pupil each radiator sees.
    weight : callable, optional
        Returns, for the vergences of the radiators' images, what fraction of their light counts.
    lenses : int array, optional
        Numbers, in `LensWindow.index`, of the lenses whose pairs are traced. Default: all.
    dark : bool
        Whether to keep what a ray meets though it does not shine: it could.
    """
    window, front = LensWindow.of(camera), Front.of(camera)
    camera.require_resolved()
    optics = sight.optics
    traced = window if lenses is None else replace(window, index=window.index[lenses])
    _require_memory(traced, len(pairs), spp, optics)
    together = max(1, _lanes(optics) // (len(pairs) * spp))
    found: list[tuple[np.ndarray, ...]] = []
    held = 0
    for start in range(0, len(traced.index), together):
        some = range(start, min(start + together, len(traced.index)))
        found.append(
            _trace_lenses(sight, camera, front, traced, pairs, some, spp, seed + start, occlusion, weight, dark)
        )
        # How many shine is known as they are found; the parts and their concatenation are alive at once.
        held += 2 * sum(array.nbytes for array in found[-1])
        require_memory(held, f"{held // RADIATOR_BYTES} radiators or more in {some.stop} of {len(traced.index)} lenses")
    P, positions, radiance, variance, curved, astigmatism, slant, bits, shiny, power = (
        np.concatenate(parts) for parts in zip(*found, strict=True)
    )
    _judge_astigmatism(camera, astigmatism, radiance)
    positions = _flatten_caustics(positions, P, radiance.mean(axis=1), curved)
    weights = _pupil_weights(slant, bits, shiny, power, front.even_power(pupil_bound(camera), PUPIL_CELLS))
    # Which rays land in the window is asked of the light that rays follow.
    wavelength = 1.0 if camera.prescription is None else camera.prescription.wavelength
    fraction = sampled_fraction(positions, weights, lens_of_waves(camera, positions, wavelength), window)
    return Radiators(P, positions, radiance, variance, fraction, weights)


def _judge_astigmatism(camera: PlenopticCamera, astigmatism: np.ndarray, radiance: np.ndarray) -> None:
    """Tell of light whose two line images lie so far apart that it is blurred by more than a microlens."""
    power = radiance.mean(axis=1)
    blur = camera.pupil_radius * camera.pupil_distance * astigmatism
    if power.sum() > 0:
        guards.judge(guards.ASTIGMATISM, float(power[blur > min(camera.mla_pitches)].sum() / power.sum()))


def _flatten_caustics(positions: np.ndarray, P: np.ndarray, power: np.ndarray, curved: np.ndarray) -> np.ndarray:
    """Move the most strongly curved light, along its rays, to where the rest seems to come from.

    Through glass a few light paths seem to come from places anywhere, even in the main lens itself, and patches and
    grid would have to hold the light of the worst.

    Parameters
    ----------
    positions : (n, 3) array
        Places.
    P : (n, 2) array
        Where the lines of the rays that have found them pass the plane z = 0.
    power : (n,) array
        Their radiance.
    curved : (n,) bool array
        Which have come through refracting or curved surfaces.
    """
    if not curved.any():
        return positions
    near = 1 / positions[:, 2]
    order = np.argsort(near[curved])
    upto = np.cumsum(power[curved][order])
    margin = _CAUSTIC / 2 * power.sum()
    first, last = np.searchsorted(upto, [margin, upto[-1] - margin])
    bounds = near[curved][order][[min(first, len(order) - 1), last]]
    straight = near[~curved]
    kept = np.clip(near, straight.min(initial=bounds[0]), straight.max(initial=bounds[1]))
    moved = kept != near
    result, P, kept = positions.copy(), P[moved], kept[moved, None]
    result[moved] = np.hstack([P + (positions[moved, :2] - P) * (near[moved, None] / kept), 1 / kept])
    return result


def _lanes(optics: Optics) -> int:
    """Return how many light paths are followed at once."""
    return LANES if optics.plain else LANES // 16


def _require_memory(window: LensWindow, pairs: int, spp: int, optics: Optics) -> None:
    """Refuse light paths that do not fit: a batch holds those of one lens or more."""

    def memory(per_lens: int) -> float:
        paths = float(per_lens) ** 2 * spp
        each = _LANE_BYTES if optics.plain else _CHAIN_BYTES
        return each * max(min(_lanes(optics), paths * len(window.index)), paths)

    def fitting(limit: float) -> str | None:
        largest = largest_fitting(memory, limit, per_lens)
        return f"radiators_per_lens = {largest}" if largest else None

    per_lens = math.isqrt(pairs)
    require_memory(memory(per_lens), f"{per_lens} x {per_lens} radiators of {spp} light paths in a lens", fitting)


def _trace_lenses(
    sight: Sight,
    camera: PlenopticCamera,
    front: Front,
    window: LensWindow,
    pairs: np.ndarray,
    lenses: range,
    spp: int,
    seed: int,
    occlusion: bool,
    weight: Callable[[np.ndarray], np.ndarray] | None,
    dark: bool,
) -> tuple[np.ndarray, ...]:
    """Find the radiators of some lenses.

    Returns
    -------
    tuple of arrays
        Where rays pass the plane z = 0; positions, radiance, its variance; which are curved, and by how much each
        is astigmatic; slants; the bits of the visible cells; which are glossy, and the power of those over the pupil.
    """
    lens, radius = lens_of_rays(camera), pupil_bound(camera)

    def primary(radiator: Any) -> tuple[Any, Any, Any, Any]:
        # A literal would be compiled anew into the kernels of every batch.
        cell = radiator // len(pairs) + dr.opaque(mi.UInt32, lenses.start)
        pair = radiator % len(pairs)
        place = [dr.gather(mi.Float, mi.Float(pairs[:, i].astype(np.float32)), pair) for i in range(4)]
        P = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(place[2], place[3])) * radius
        i, j = (dr.gather(mi.Float, mi.Float(index.astype(np.float32)), cell) for index in window.index.T)
        q = mi.Point2f(*window.place(i + place[0], j + place[1]))
        point, slope, is_open = lens.ray((P.x, P.y), (q.x, q.y))
        # As wide as the others: a thin lens's rays all start from the same plane.
        z = point[2] + dr.zeros(mi.Float, dr.width(radiator))
        return P, mi.Point3f(point[0], point[1], z), mi.Point2f(*slope), is_open

    kept, open_rays = dr.arange(mi.UInt32, len(lenses) * len(pairs)), None
    if camera.prescription is not None:
        kept = dr.compress(primary(kept)[3])
        open_rays = kept.numpy()
        if not open_rays.size:
            return _nothing(len(channels(dr.zeros(mi.UnpolarizedSpectrum, 1))))
    lane = dr.arange(mi.UInt32, dr.width(kept) * spp)
    P, point, slope, _ = primary(dr.gather(mi.UInt32, kept, lane // spp))
    ray, cosine = sight.ray(tuple(point), (slope.x, slope.y))
    found = draw(sight, seed, ray, spp, dark)
    bad = int(np.count_nonzero(~np.isfinite(found.radiance).all(axis=-1)))
    if bad:
        raise InputError(f"scene: the radiance of {bad} radiators is NaN or infinite: all must be finite")
    if not found.lane.size:
        return _nothing(found.radiance.shape[1])
    if open_rays is not None:
        factor = _evened(camera, window, open_rays // len(pairs), lenses, len(pairs))
        found = found.weighted(factor[found.lane // spp])
    depth = _depth(found, cosine, point.z, lens)
    if weight is not None:
        factor = weight(lens.vergence(depth))
        if not factor.any():
            return _nothing(found.radiance.shape[1])
        found, depth = found.weighted(factor), depth[factor > 0]
    first = mi.UInt32(found.lane)
    P, slope = (dr.gather(mi.Point2f, mi.Point2f(v), first).numpy().astype(np.float64).T for v in (P, slope))
    point = dr.gather(mi.Point3f, point, first).numpy().astype(np.float64).T
    through = point[:, :2] - slope * point[:, 2:]
    positions = np.column_stack([through + slope * depth[:, None], depth])
    bits, shiny, power = _over_pupil(len(P))
    entrances = Entrances(front, P, positions, slope)
    to_world = sight.sensor.world_transform()
    if occlusion:
        rays = dr.gather(mi.Ray3f, ray, first)
        bits = visible_cells(sight.optics, to_world, found.vertex, rays, entrances, radius)
        shiny = glossy(sight.optics, found.vertex, rays, radius)
    if shiny.any():
        some = mi.UInt32(np.flatnonzero(shiny).astype(np.uint32))
        vertex, rays = dr.gather(Vertex, found.vertex, some), dr.gather(mi.Ray3f, rays, some)
        power = pupil_radiance(sight.optics, to_world, vertex, rays, entrances.take(shiny), radius, seed)
    place = found.vertex.place
    curved, astigmatism = (np.broadcast_to(part.numpy(), len(P)) for part in (place.curved, place.astigmatism))
    normals = to_world.inverse() @ mi.Normal3f(place.apparent)
    slant = front.slants(np.broadcast_to(normals.numpy().T, positions.shape), positions, radius)
    return through, positions, found.radiance, found.variance, curved, astigmatism, slant, bits, shiny, power


def _evened(camera: PlenopticCamera, window: LensWindow, lens: np.ndarray, lenses: range, pairs: int) -> np.ndarray:
    """Return factors on the light of rays that get through, by which each lens has that of its open pupil.

    Of few rays to a lens, a fraction gets through that is the open fraction of the pupil to some percent only.

    Parameters
    ----------
    lens : int array (n,)
        Number of each ray's lens within `lenses`.
    lenses : range
        Numbers of the lenses in the window.
    pairs : int
        Rays of each lens that have been tried.
    """
    counts = np.bincount(lens, minlength=len(lenses))
    x, y = window.place(*(window.index[lenses.start : lenses.stop] + 0.5).T)
    return (pairs * open_fraction(camera, x, y) / np.maximum(counts, 1))[lens]


def _nothing(channels: int) -> tuple[np.ndarray, ...]:
    """Return what is found where nothing shines."""
    nothing = np.empty(0)
    places = np.empty((0, 2)), np.empty((0, 3))
    return *places, *np.empty((2, 0, channels)), nothing > 0, nothing, places[0], *_over_pupil(0)


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


def _pupil_weights(
    slant: np.ndarray, bits: np.ndarray, shiny: np.ndarray, power: np.ndarray, even: np.ndarray | None
) -> PupilWeights | None:
    """Gather what is visible, how slantwise and, of glossy radiators, the power over the pupil; None if all is even."""
    # Where no light path of the few has found light, all that is visible counts the same.
    lit = power.max(axis=(1, 2), initial=0) > 0
    which = np.flatnonzero(shiny)[lit]
    if even is None and not which.size and (bits == 255).all() and (np.abs(slant) < _LEVEL).all():
        return None
    masks = PupilWeights.from_bits(bits, PUPIL_CELLS)
    table, index = masks.table, masks.index.copy()
    if which.size:
        rows = power[lit] / power[lit].max(axis=(1, 2), keepdims=True)
        index[which] = len(table) + np.arange(len(which))
        table = np.concatenate([table, rows])
    return PupilWeights(table if even is None else table * even, index, slant, sampled=True)
