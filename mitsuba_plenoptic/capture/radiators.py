r"""Incoherent radiators of a scene, found by rays, for the wave capture.

A ray through a point :math:`q` of the MLA plane and a point :math:`P` of the pupil meets the scene in a radiator
:math:`X`, and a child integrator tells its radiance towards the camera. The same pairs (place of q in its lens, P)
serve every lens, so that the capture of an even surface repeats from lens to lens, as it should, without noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import PlenopticCamera
from ..errors import InputError
from ..optics.main_lens import MainLens, main_lens
from ..runtime.limits import largest_fitting, require_memory
from .lens_window import LensWindow
from .pupil_weights import PupilWeights
from .visibility import LANES, PUPIL_CELLS, sampled_fraction, visible_cells

_LANE_BYTES = 256
"""Memory of a light path on its way."""

RADIATOR_BYTES = 2 * (40 + PUPIL_CELLS**2 // 8)
"""Memory of a radiator with the bits of its visible cells, while the parts are put together."""

_ROUNDING = 1e-6
"""Relative deviation of a radiance that is none."""

_INFINITY = 1e6
"""Where the radiator of a ray that leaves the scene is put, in main lens images: far enough to be collimated."""


@dataclass(frozen=True)
class Radiators:
    """Incoherent point sources in the camera frame, only those that shine.

    Attributes
    ----------
    positions : (n, 3) float64 array
        Places.
    radiance : (n, channels) float64 array
        Radiance towards the pupil.
    variance : (n, channels) float64 array
        Variance of each radiance, as the mean of some light paths; 0 where there is only one.
    fraction : (n,) float64 array
        Fraction of the visible pupil whose rays from the radiator land in the sampled part of the MLA plane: those
        are the rays that could have found it.
    pupil_weights : PupilWeights, or None
        What each radiator sees of the pupil; None if all see all.
    """

    positions: np.ndarray
    radiance: np.ndarray
    variance: np.ndarray
    fraction: np.ndarray
    pupil_weights: PupilWeights | None

    def take(self, which: np.ndarray) -> Radiators:
        """Return some of them."""
        weights = self.pupil_weights
        return Radiators(
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
    lenses: np.ndarray | None = None,
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
    lenses : int array, optional
        Numbers, in `LensWindow.index`, of the lenses whose pairs are traced. Default: all.
    """
    window, lens = LensWindow.of(camera), main_lens(camera)
    camera.require_resolved()
    traced = window if lenses is None else replace(window, index=window.index[lenses])
    _require_memory(traced, len(pairs), spp)
    together = max(1, LANES // (len(pairs) * spp))
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    held = 0
    for start in range(0, len(traced.index), together):
        some = range(start, min(start + together, len(traced.index)))
        found.append(
            _trace_lenses(scene, sensor, child, lens, traced, pairs, some, spp, seed + start, wavelength, occlusion)
        )
        # How many shine is known as they are found; the parts and their concatenation are alive at once.
        held += 2 * sum(array.nbytes for array in found[-1])
        require_memory(held, f"{held // RADIATOR_BYTES} radiators or more in {some.stop} of {len(traced.index)} lenses")
    positions, radiance, variance, bits = (np.concatenate(parts) for parts in zip(*found, strict=True))
    weights = PupilWeights.from_bits(bits, PUPIL_CELLS) if occlusion and not (bits == 255).all() else None
    return Radiators(positions, radiance, variance, sampled_fraction(positions, weights, lens, window), weights)


def _require_memory(window: LensWindow, pairs: int, spp: int) -> None:
    """Refuse light paths that do not fit: a batch holds those of one lens or more."""

    def memory(per_lens: int) -> float:
        paths = float(per_lens) ** 2 * spp
        return _LANE_BYTES * max(min(LANES, paths * len(window.index)), paths)

    def fitting(limit: float) -> str | None:
        largest = largest_fitting(memory, limit, per_lens)
        return f"radiators_per_lens = {largest}" if largest else None

    per_lens = math.isqrt(pairs)
    require_memory(memory(per_lens), f"{per_lens} x {per_lens} radiators of {spp} light paths in a lens", fitting)


def _trace_lenses(
    scene: Any,
    sensor: Any,
    child: Any,
    lens: MainLens,
    window: LensWindow,
    pairs: np.ndarray,
    lenses: range,
    spp: int,
    seed: int,
    wavelength: float | None,
    occlusion: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, radiance, variance and bits of the visible cells of the shining radiators of some lenses."""
    count = len(lenses) * len(pairs)
    lane = dr.arange(mi.UInt32, count * spp)
    radiator = lane // spp
    cell, pair = radiator // len(pairs) + lenses.start, radiator % len(pairs)
    place = [dr.gather(mi.Float, mi.Float(pairs[:, i].astype(np.float32)), pair) for i in range(4)]
    P = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(place[2], place[3])) * lens.pupil_radius
    i, j = (dr.gather(mi.Float, mi.Float(index.astype(np.float32)), cell) for index in window.index.T)
    q = mi.Point2f(*window.place(i + place[0], j + place[1]))
    slope = mi.Point2f(*lens.aim((P.x, P.y), (q.x, q.y)))
    direction = dr.normalize(mi.Vector3f(slope.x, slope.y, 1))

    to_world = sensor.world_transform()
    ray = mi.RayDifferential3f(to_world @ mi.Point3f(P.x, P.y, 0), to_world @ direction)
    ray.time = sensor.shutter_open() + 0.5 * sensor.shutter_open_time()
    if wavelength is not None:
        ray.wavelengths = dr.full(type(ray.wavelengths), wavelength)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count * spp)
    # The unbound method reaches integrators written in C++ and in Python alike.
    radiance = mi.unpolarized_spectrum(mi.SamplingIntegrator.sample(child, scene, sampler, ray, None, True)[0])
    channels = [radiance[0]] if wavelength is not None else list(radiance)
    means, variances = np.stack([_mean(channel, spp) for channel in channels], axis=-1)

    bad = int(np.count_nonzero(~np.isfinite(means).all(axis=-1)))
    if bad:
        raise InputError(f"scene: the radiance of {bad} radiators is NaN or infinite: all must be finite")
    shining = np.flatnonzero(means.max(axis=-1) > 0).astype(np.uint32)
    if shining.size == 0:
        none = np.empty((0, means.shape[1]))
        return np.empty((0, 3)), none, none, np.empty((0, PUPIL_CELLS**2 // 8), np.uint8)
    first = mi.UInt32(shining) * spp
    si = scene.ray_intersect(dr.gather(mi.Ray3f, mi.Ray3f(ray), first))
    depth = (
        dr.select(si.is_valid(), si.t * dr.gather(mi.Float, direction.z, first), _INFINITY / lens.vergence(math.inf))
        .numpy()
        .astype(np.float64)
    )
    P, slope = (dr.gather(mi.Point2f, mi.Point2f(v), first).numpy().astype(np.float64).T for v in (P, slope))
    positions = np.column_stack([P + slope * depth[:, None], depth])
    bits = visible_cells(scene, to_world, si, P, lens) if occlusion else np.empty((0, PUPIL_CELLS**2 // 8), np.uint8)
    return positions, means[shining].astype(np.float64), variances[shining].astype(np.float64), bits


def _mean(values: Any, spp: int) -> tuple[np.ndarray, np.ndarray]:
    """Average each radiator's light paths, and return the variances of these means as well."""
    mean = dr.block_sum(values, spp) / spp
    squares = dr.block_sum(
        dr.square(values - dr.gather(type(values), mean, dr.arange(mi.UInt32, dr.width(values)) // spp)), spp
    )
    variance = squares / max(1, spp * (spp - 1))
    # What rounding leaves of paths that are all the same is no spread.
    return mean.numpy(), dr.select(variance > dr.square(_ROUNDING * mean), variance, 0).numpy()
