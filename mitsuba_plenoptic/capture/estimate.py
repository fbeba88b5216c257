"""What a capture takes: time and memory, from a fraction of its work."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import suggest_keywords
from ..optics.rays import conjugate_coordinate
from ..runtime.backend import one_at_a_time
from ..runtime.batches import BatchMap
from ..runtime.jobs import Job
from .lens_window import LensWindow
from .operator import CaptureOperator
from .patch_plan import Cost
from .radiators import RADIATOR_BYTES, Radiators
from .render import chosen_integrator, film_memory, plenoptic_sensor, require_taken, sample_count
from .scene import KNOWN_PARAMETERS

_BLOCK = 16
"""Lenses along an axis that are sampled together: as many as share point spreads at most."""

_RAYS = 2**20
"""Rays from the detector that are traced at a time."""

_SECONDS = 0.6
"""How long light paths are traced for an estimate, about."""

_PATHS, _FEW_PATHS = 2**19, 16
"""Light paths by which the radiators are counted, and for each of them at most."""


@functools.partial(suggest_keywords, others=KNOWN_PARAMETERS["plenoptic_wave"])
@one_at_a_time
def estimate_capture(
    scene: Any,
    *,
    sensor: int | Any = 0,
    model: str | None = None,
    spp: int | None = None,
    seed: int = 0,
    batch_map: BatchMap | None = None,
    **wave: Any,
) -> Cost:
    """Estimate what `render_capture` would take with the same arguments, by doing a fraction of it.

    By rays some of the rays are traced; by waves the radiators of some lenses are found, and some of their point
    spreads computed. It takes a few seconds, whatever the size of the capture.

    Parameters
    ----------
    scene, sensor, model, spp, seed, batch_map, **wave
        As of `render_capture`.

    Returns
    -------
    Cost
        Radiators and point spreads (0 by rays), seconds, and bytes.

    Raises
    ------
    InputError
        Where `render_capture` raises it before it begins, also because memory would not do.
    PhysicsError
        If too much of the light would be lost.
    """
    sensor = plenoptic_sensor(scene, sensor)
    camera = PlenopticCamera.from_sensor(sensor)
    integrator = chosen_integrator(scene, model, wave)
    require_taken(integrator, batch_map=batch_map)
    spp = sample_count(sensor, spp)
    if hasattr(integrator, "wavelengths"):
        return integrator.estimate(scene, sensor, seed=seed, spp=spp, job=Job(batch_map=batch_map))
    rate = _rays_per_second(scene, sensor, integrator, camera.shape, spp, seed)
    return Cost(0, 0, float(camera.shape[0]) * camera.shape[1] * spp / rate, film_memory(camera, spp))


def _rays_per_second(scene: Any, sensor: Any, integrator: Any, shape: tuple[int, int], spp: int, seed: int) -> float:
    """Time the rays of some rows of pixels, evenly over the detector and in the order in which Mitsuba traces them."""
    rows, columns = shape
    together = min(spp, _FEW_PATHS)
    lines = min(rows, max(1, _RAYS // (columns * together)))
    count = lines * columns * together
    sampler = mi.load_dict({"type": "independent"})
    pixel = dr.arange(mi.UInt32, count) // together
    column, row = mi.Float(pixel % columns), mi.Float(pixel // columns * (rows // lines))

    def trace() -> float:
        # Anew each time, or its state would be traced from the first pass on.
        sampler.seed(seed, count)
        dr.sync_thread()
        start = time.perf_counter()
        offset = sampler.next_2d()
        place = mi.Point2f((column + offset.x) / columns, (row + offset.y) / rows)
        ray, weight = sensor.sample_ray_differential(0.0, sampler.next_1d(), place, sampler.next_2d())
        radiance = mi.SamplingIntegrator.sample(integrator, scene, sampler, ray, None, True)[0]
        dr.eval(mi.unpolarized_spectrum(radiance) * mi.unpolarized_spectrum(weight))
        dr.sync_thread()
        return time.perf_counter() - start

    dr.eval(column, row)
    trace()  # compiles the kernels
    seconds, passes = 0.0, 0
    while seconds < _SECONDS:
        seconds += trace()
        passes += 1
    return passes * count / seconds


def estimate_waves(
    camera: PlenopticCamera,
    find: Callable[..., Radiators],
    operator: Callable[[Radiators], CaptureOperator],
    job: Job,
    *,
    pairs: NDArray[np.float64],
    spp: int,
    occlusion: bool,
) -> Cost:
    """Estimate one pass of a capture by waves.

    A few radiators of every lens tell how many there are and where; blocks of lenses tell what they take.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera.
    find : callable
        `find_radiators` of this scene; takes the pairs and all that is named.
    operator : callable
        Makes the operator that sums the radiators' point spreads.
    job : Job
        Who would compute.
    pairs, spp, occlusion
        As of `find_radiators`.
    """
    index = LensWindow.of(camera).index
    paths = min(spp, _FEW_PATHS)
    few = pairs[: max(1, _PATHS // (len(index) * paths))]
    everywhere = find(few, spp=paths, occlusion=False)
    lit = _lenses(camera, everywhere.positions)
    blocks = _blocks(index, lit)
    find(pairs[:1], spp=spp, occlusion=occlusion, lenses=blocks[0])  # compiles the kernels
    seconds, count = 0.0, max(1, _PATHS // (len(pairs) * spp * _BLOCK**2))
    while seconds < _SECONDS / 2:
        lenses = np.concatenate(blocks[:count])
        start = time.perf_counter()
        radiators = find(pairs, spp=spp, occlusion=occlusion, lenses=lenses)
        seconds = time.perf_counter() - start
        if count >= len(blocks):
            break
        count *= 2
    found, scale = len(lit) * len(pairs) // len(few), 1.0
    if count < len(blocks):
        # Point spreads are shared by the lens that the image is on, to which blur brings as much as it carries away.
        radiators = radiators.take(_among(_lenses(camera, radiators.positions), index[lenses]))
        scale = len(lit) / max(1, int(np.count_nonzero(_among(lit, index[lenses]))))
    cost = operator(radiators).estimate(job)
    return replace(
        cost,
        radiators=found,
        patterns=round(scale * cost.patterns),
        seconds=float(seconds * len(index) / len(lenses) + scale * cost.seconds),
        memory=cost.memory + (found - len(radiators.positions)) * RADIATOR_BYTES,
    )


def _blocks(index: NDArray[np.int64], lit: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Cut lenses into square blocks; return the numbers of each one's lenses, those that have light in random order."""
    members: dict[tuple[int, ...], list[int]] = {}
    for number, block in enumerate((index // _BLOCK).tolist()):
        members.setdefault(tuple(block), []).append(number)
    shining = {tuple(block) for block in np.unique(lit // _BLOCK, axis=0).tolist()}
    chosen = [np.array(numbers) for block, numbers in members.items() if block in shining] or [np.arange(len(index))]
    return [chosen[i] for i in np.random.default_rng(0).permutation(len(chosen))]


def _lenses(camera: PlenopticCamera, positions: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the lenses that points are imaged on."""
    place = conjugate_coordinate(positions[:, :2], positions[:, 2:], camera.mla_distance)
    return np.stack(camera.lattice.cell(*place.T), -1).astype(np.int64)


def _among(lenses: NDArray[np.int64], some: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether lenses are among some others."""
    width = int(np.ptp(np.vstack([lenses, some])[:, 1])) + 1
    return np.isin(lenses @ np.array([width, 1]), some @ np.array([width, 1]))
