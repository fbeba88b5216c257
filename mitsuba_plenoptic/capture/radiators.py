r"""Incoherent radiators of a scene, found by rays, for the wave capture.

A ray through a point :math:`q` of the MLA plane and a point :math:`P` of the pupil meets the scene in a radiator
:math:`X`, and a child integrator tells its radiance towards the camera. The same pairs (place of q in its lens, P)
serve every lens, so that the capture of an even surface repeats from lens to lens, as it should, without noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..lattice import Lattice
from ..optics import rays
from ..runtime.limits import largest_fitting, require_memory

# Cells of the pupil's bounding square, along an axis, whose visibility is found by one shadow ray each.
PUPIL_CELLS = 16

# Lenses beyond the recorded ones whose radiators count: diffraction at the microlenses' edges, which falls with the
# inverse square of the distance, brings 1 % of a white scene's light from lenses farther off than the next one.
_MARGIN = 3

# How far, relatively, two ways to compute a place may be apart.
_ROUNDING = 1e-9

# Child light paths or shadow rays traced at once.
_LANES = 2**22

# Bytes of a light path on its way, and of a radiator with its mask.
_LANE_BYTES = 256
_RADIATOR_BYTES = 2 * (40 + PUPIL_CELLS**2 // 8)

# Where the radiator of a ray that leaves the scene is put, in focal lengths: far enough to be collimated.
_INFINITY = 1e6


@dataclass(frozen=True)
class Radiators:
    """Incoherent point sources in the camera frame, only those that shine.

    Attributes
    ----------
    positions : (n, 3) float64 array
        Places.
    radiance : (n, channels) float64 array
        Radiance towards the pupil.
    share : (n,) float64 array
        Share of the visible pupil whose rays from the radiator land in the sampled part of the MLA plane: those
        are the rays that could have found it.
    packed_masks : (n, PUPIL_CELLS**2 // 8) uint8 array, or None
        Bits of `masks`: the radiators of all passes are held at once, and their masks are the most of them.
    """

    positions: np.ndarray
    radiance: np.ndarray
    share: np.ndarray
    packed_masks: np.ndarray | None

    @property
    def masks(self) -> np.ndarray | None:
        """Which cells of the pupil's bounding square each radiator sees, or None if all see all.

        (n, PUPIL_CELLS, PUPIL_CELLS) bool array, rows along y.
        """
        return None if self.packed_masks is None else _unpacked(self.packed_masks)


@dataclass(frozen=True)
class LensWindow:
    """The lenses whose cells are sampled: those of the recorded pixels and a few more on each side.

    A cell is here the parallelogram that the two lattice vectors span around a lens's centre.

    Attributes
    ----------
    lattice : Lattice
        The microlens lattice.
    index : (n, 2) int array
        Indices of the lenses.
    recorded : (2, 2) float64 array
        Lower and upper corner of the part of the MLA plane that the recorded pixels belong to.
    """

    lattice: Lattice
    index: np.ndarray
    recorded: np.ndarray

    @classmethod
    def of(cls, camera: PlenopticCamera) -> LensWindow:
        """Find the window of a camera's recorded pixels."""
        edges = np.array([[0, 0], camera.crop_size]) + camera.crop_offset - np.array(camera.resolution) / 2
        recorded = rays.chief_point(edges * camera.pixel_size, camera.mla_distance, camera.detector_distance)
        margin = (_MARGIN + 0.5) * camera.mla_pitch
        # A lens of whose cell no more than the lower edge is recorded counts as well.
        low, high = recorded[0] - margin * (1 - _ROUNDING), recorded[1] + margin * (1 + _ROUNDING)
        return cls(camera.lattice, camera.lattice.lenses_within(tuple(low), tuple(high)), recorded)

    def place(self, i: Any, j: Any) -> tuple[Any, Any]:
        """Point of the MLA plane at i and j steps along the lattice vectors from the first corner of cell (0, 0)."""
        (ax, ay), (bx, by) = self.lattice.basis
        cx, cy = self.lattice.centre(0.0, 0.0)
        return i * ax + j * bx + (cx - (ax + bx) / 2), i * ay + j * by + (cy - (ay + by) / 2)

    def holds(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Whether points lie in the cells of the window."""
        first, last = self.index.min(0), self.index.max(0)
        sampled = np.zeros(last - first + 3, dtype=bool)
        sampled[tuple((self.index - first + 1).T)] = True
        (ax, ay), (bx, by) = self.lattice.basis
        ox, oy = self.place(0.0, 0.0)
        x, y, area = x - ox, y - oy, ax * by - ay * bx
        i, j = (
            np.clip(np.floor(steps).astype(int) - low, -1, high - low + 1) + 1
            for steps, low, high in zip(((x * by - y * bx) / area, (y * ax - x * ay) / area), first, last, strict=True)
        )
        return np.asarray(sampled[i, j])


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
    scene: Any,
    sensor: Any,
    child: Any,
    camera: PlenopticCamera,
    pairs: np.ndarray,
    *,
    spp: int,
    seed: int,
    wavelength: float | None,
    occlusion: bool,
) -> Radiators:
    """Trace the pairs of every lens into the scene and keep what shines.

    Parameters
    ----------
    scene, sensor, child
        Mitsuba scene, plenoptic sensor and the integrator that finds the radiance.
    camera : PlenopticCamera
        The sensor's numbers.
    pairs : (n, 4) array
        As from `sample_pairs`.
    spp : int
        Light paths averaged per radiator.
    seed : int
        Seed of the child's random numbers.
    wavelength : float, optional
        For spectral variants: the wavelength of all light, in nanometres.
    occlusion : bool
        Whether to find by shadow rays which part of the pupil each radiator sees.
    """
    window = LensWindow.of(camera)
    camera.require_resolved()
    _require_memory(window, len(pairs), spp)
    lenses = max(1, _LANES // (len(pairs) * spp))
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    held = 0
    for start in range(0, len(window.index), lenses):
        some = range(start, min(start + lenses, len(window.index)))
        positions, radiance, masks = _trace_lenses(
            scene, sensor, child, camera, window, pairs, some, spp, seed + start, wavelength, occlusion
        )
        found.append((positions, radiance, np.packbits(masks.reshape(len(masks), PUPIL_CELLS**2), axis=1)))
        # How many shine is known as they are found; the parts and their concatenation are alive at once.
        held += 2 * sum(array.nbytes for array in found[-1])
        require_memory(
            held, f"{held // _RADIATOR_BYTES} radiators or more in {some.stop} of {len(window.index)} lenses"
        )
    positions = np.concatenate([part[0] for part in found])
    radiance = np.concatenate([part[1] for part in found])
    packed = np.concatenate([part[2] for part in found]) if occlusion else None
    if packed is not None and (packed == 255).all():
        packed = None
    return Radiators(positions, radiance, _sampled_share(positions, packed, camera, window), packed)


def _unpacked(masks: np.ndarray) -> np.ndarray:
    return np.unpackbits(masks, axis=1).view(bool).reshape(-1, PUPIL_CELLS, PUPIL_CELLS)


def _require_memory(window: LensWindow, pairs: int, spp: int) -> None:
    """Refuse light paths that do not fit: a batch holds those of one lens or more."""

    def memory(per_lens: int) -> float:
        paths = float(per_lens) ** 2 * spp
        return _LANE_BYTES * max(min(_LANES, paths * len(window.index)), paths)

    def fitting(limit: float) -> str | None:
        largest = largest_fitting(memory, limit, per_lens)
        return f"radiators_per_lens = {largest}" if largest else None

    per_lens = math.isqrt(pairs)
    require_memory(memory(per_lens), f"{per_lens} x {per_lens} radiators of {spp} light paths in a lens", fitting)


def _trace_lenses(
    scene: Any,
    sensor: Any,
    child: Any,
    camera: PlenopticCamera,
    window: LensWindow,
    pairs: np.ndarray,
    lenses: range,
    spp: int,
    seed: int,
    wavelength: float | None,
    occlusion: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, radiance and masks of the shining radiators of some lenses."""
    count = len(lenses) * len(pairs)
    lane = dr.arange(mi.UInt32, count * spp)
    radiator = lane // spp
    lens, pair = radiator // len(pairs) + lenses.start, radiator % len(pairs)
    place = [dr.gather(mi.Float, mi.Float(pairs[:, i].astype(np.float32)), pair) for i in range(4)]
    P = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(place[2], place[3])) * camera.aperture_radius
    i, j = (dr.gather(mi.Float, mi.Float(index.astype(np.float32)), lens) for index in window.index.T)
    q = mi.Point2f(*window.place(i + place[0], j + place[1]))
    slope = rays.main_lens_slope((P - q) / camera.mla_distance, P, camera.focal_length)
    direction = dr.normalize(mi.Vector3f(slope.x, slope.y, 1))

    to_world = sensor.world_transform()
    ray = mi.RayDifferential3f(to_world @ mi.Point3f(P.x, P.y, 0), to_world @ direction)
    ray.time = sensor.shutter_open() + 0.5 * sensor.shutter_open_time()
    if wavelength is not None:
        ray.wavelengths = dr.full(type(ray.wavelengths), wavelength)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count * spp)
    # The unbound method reaches integrators written in C++ and in Python alike.
    radiance, _, _ = mi.SamplingIntegrator.sample(child, scene, sampler, ray, None, True)
    channels = [radiance[0]] if wavelength is not None else list(radiance)
    means = np.stack([dr.block_sum(channel, spp).numpy() / spp for channel in channels], axis=-1)

    bad = int(np.count_nonzero(~np.isfinite(means).all(axis=-1)))
    if bad:
        raise InputError(f"scene: the radiance of {bad} radiators is NaN or infinite: all must be finite")
    shining = np.flatnonzero(means.max(axis=-1) > 0).astype(np.uint32)
    if shining.size == 0:
        return np.empty((0, 3)), np.empty((0, means.shape[1])), np.empty((0, PUPIL_CELLS, PUPIL_CELLS), bool)
    first = mi.UInt32(shining) * spp
    si = scene.ray_intersect(dr.gather(mi.Ray3f, mi.Ray3f(ray), first))
    depth = (
        dr.select(si.is_valid(), si.t * dr.gather(mi.Float, direction.z, first), _INFINITY * camera.focal_length)
        .numpy()
        .astype(np.float64)
    )
    P, slope = (dr.gather(mi.Point2f, mi.Point2f(v), first).numpy().astype(np.float64).T for v in (P, slope))
    positions = np.column_stack([P + slope * depth[:, None], depth])
    masks = _pupil_masks(scene, to_world, si, P, camera) if occlusion else np.empty((0, PUPIL_CELLS, PUPIL_CELLS), bool)
    return positions, means[shining].astype(np.float64), masks


def _cell_centres() -> np.ndarray:
    """Centres of the pupil cells along an axis, for a pupil of radius one."""
    return (np.arange(PUPIL_CELLS) + 0.5) * 2 / PUPIL_CELLS - 1


def _pupil_masks(scene: Any, to_world: Any, si: Any, P: np.ndarray, camera: PlenopticCamera) -> np.ndarray:
    """Find by one shadow ray a cell which cells of the pupil each hit sees.

    A cell whose centre lies beyond the pupil's edge is tested at the nearest point within. The cell that holds the
    ray which found the hit is open.
    """
    x, y = (axis.ravel() for axis in np.meshgrid(_cell_centres(), _cell_centres()))
    inward = np.minimum(1, 0.999 / np.hypot(x, y)) * camera.aperture_radius
    targets = to_world @ mi.Point3f(mi.Float(x * inward), mi.Float(y * inward), 0)
    hits = dr.width(si)
    cells = PUPIL_CELLS**2
    masks = np.empty((hits, cells), dtype=bool)
    batch = _LANES // cells
    for start in range(0, hits, batch):
        lane = dr.arange(mi.UInt32, min(batch, hits - start) * cells)
        hit = lane // cells + start
        point = dr.zeros(mi.SurfaceInteraction3f, dr.width(lane))
        point.p, point.n = dr.gather(mi.Point3f, si.p, hit), dr.gather(mi.Normal3f, si.n, hit)
        blocked = scene.ray_test(point.spawn_ray_to(dr.gather(mi.Point3f, targets, lane % cells)))
        # What is at infinity has no place to send shadow rays from, and is hidden by nothing here.
        blocked &= dr.gather(mi.Bool, si.is_valid(), hit)
        masks[start : start + batch] = ~blocked.numpy().reshape(-1, cells)
    column, row = (
        np.clip(((axis / camera.aperture_radius + 1) / 2 * PUPIL_CELLS).astype(int), 0, PUPIL_CELLS - 1) for axis in P.T
    )
    masks[np.arange(hits), row * PUPIL_CELLS + column] = True
    return masks.reshape(hits, PUPIL_CELLS, PUPIL_CELLS)


def _sampled_share(
    positions: np.ndarray, packed_masks: np.ndarray | None, camera: PlenopticCamera, window: LensWindow
) -> np.ndarray:
    """Share of the visible pupil that sends a radiator's light into the sampled lenses."""
    # No point that lies nearer to the recorded part than this is in the cell of a lens beyond the window.
    margin = (_MARGIN - 1) * camera.mla_pitch
    low, high = window.recorded[0] - margin, window.recorded[1] + margin
    b, f1 = camera.mla_distance, camera.focal_length
    X, g = positions[:, :2], positions[:, 2:]
    centre = rays.mla_point(X, 0.0, g, b, f1)
    blur = np.abs(rays.mla_point(0.0, camera.aperture_radius, g, b, f1))
    share = np.ones(len(positions))
    # Only where the blur leaves the sampled lenses is there anything to count.
    partial = np.flatnonzero(((centre - blur < low) | (centre + blur > high)).any(axis=1))

    fine = (np.arange(4 * PUPIL_CELLS) + 0.5) / (2 * PUPIL_CELLS) - 1
    x, y = (axis.ravel() for axis in np.meshgrid(fine, fine))
    inside = np.hypot(x, y) <= 1
    x, y = x[inside], y[inside]
    cell = ((y + 1) / 2 * PUPIL_CELLS).astype(int) * PUPIL_CELLS + ((x + 1) / 2 * PUPIL_CELLS).astype(int)
    for some in np.array_split(partial, max(1, partial.size * x.size // 2**24)):
        landed = window.holds(
            *(
                rays.mla_point(X[some, axis, None], pupil * camera.aperture_radius, g[some], b, f1)
                for axis, pupil in ((0, x), (1, y))
            )
        )
        seen = np.ones_like(landed)
        if packed_masks is not None:
            seen = _unpacked(packed_masks[some]).reshape(-1, PUPIL_CELLS**2)[:, cell]
        # The ray that found the radiator landed, so the share is never nothing.
        share[some] = np.maximum((landed & seen).sum(axis=1), 1) / np.maximum(seen.sum(axis=1), 1)
    return share
