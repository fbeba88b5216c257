r"""Incoherent radiators of a scene, found by rays, for the wave capture.

A ray through a point :math:`q` of the MLA plane and a point :math:`P` of the pupil meets the scene in a radiator
:math:`X`, and a child integrator tells its radiance towards the camera. The same pairs (place of q in its lens, P)
serve every lens, so that the capture of an even surface repeats from lens to lens, as it should, without noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..camera import PlenopticCamera
from ..optics import guards
from ..optics.fitted_lens import lens_of_waves
from ..optics.open_pupil import pupil_bound
from ..runtime.limits import require_memory
from . import scene_points
from .entrance import Front
from .lens_window import LensWindow
from .pair_tracing import Finds, PairTracer
from .pupil_weights import PupilWeights
from .sight import Sight
from .visibility import PUPIL_CELLS, sampled_fraction

RADIATOR_BYTES = 2 * (40 + PUPIL_CELLS**2 // 8)
"""Memory of a radiator with the bits of its visible cells, while the parts are put together."""

_CAUSTIC = 1e-3
"""Fraction of the light, the most strongly curved by glass and mirrors, that does not decide the size of patches."""

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
    return np.asarray((scene_points.sample_pairs(per_lens**2) + shift) % 1.0)


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
    traced = window if lenses is None else replace(window, index=window.index[lenses])
    tracer = PairTracer(sight, camera, front, traced, pairs, spp, occlusion, weight, dark)
    tracer.require_memory()
    parts: list[Finds] = []
    held = 0
    for start in range(0, len(traced.index), tracer.together):
        some = range(start, min(start + tracer.together, len(traced.index)))
        parts.append(tracer.trace(some, seed + start))
        # How many shine is known as they are found; the parts and their concatenation are alive at once.
        held += 2 * parts[-1].nbytes
        require_memory(held, f"{held // RADIATOR_BYTES} radiators or more in {some.stop} of {len(traced.index)} lenses")
    found = Finds.joined(parts)
    _judge_astigmatism(camera, found)
    positions = _flatten_caustics(found.positions, found.pupil, found.radiance.mean(axis=1), found.curved)
    weights = _pupil_weights(found, front.even_power(pupil_bound(camera), PUPIL_CELLS))
    # Which rays land in the window is asked of the light that rays follow.
    wavelength = 1.0 if camera.prescription is None else camera.prescription.wavelength
    fraction = sampled_fraction(positions, weights, lens_of_waves(camera, positions, wavelength), window)
    return Radiators(found.pupil, positions, found.radiance, found.variance, fraction, weights)


def _judge_astigmatism(camera: PlenopticCamera, found: Finds) -> None:
    """Tell of light whose two line images lie so far apart that it is blurred by more than a microlens."""
    power = found.radiance.mean(axis=1)
    blur = camera.pupil_radius * camera.pupil_distance * found.astigmatism
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


def _pupil_weights(found: Finds, even: np.ndarray | None) -> PupilWeights | None:
    """Gather what is visible, how slantwise and, of glossy radiators, the power over the pupil; None if all is even."""
    # Where no light path of the few has found light, all that is visible counts the same.
    lit = found.power.max(axis=(1, 2), initial=0) > 0
    which = np.flatnonzero(found.shiny)[lit]
    if even is None and not which.size and (found.visible == 255).all() and (np.abs(found.slant) < _LEVEL).all():
        return None
    masks = PupilWeights.from_bits(found.visible, PUPIL_CELLS)
    table, index = masks.table, masks.index.copy()
    if which.size:
        rows = found.power[lit] / found.power[lit].max(axis=(1, 2), keepdims=True)
        index[which] = len(table) + np.arange(len(which))
        table = np.concatenate([table, rows])
    return PupilWeights(table if even is None else table * even, index, found.slant, sampled=True)
