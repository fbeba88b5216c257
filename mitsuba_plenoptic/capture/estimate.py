"""Estimates of the time and memory of a capture, from a fraction of its work."""

from __future__ import annotations

import functools
import time
from typing import Any

import drjit as dr
import mitsuba as mi

from ..camera import PlenopticCamera
from ..errors import suggest_keywords
from ..operator.patch_plan import Cost
from ..runtime.backend import one_at_a_time
from ..runtime.batches import BatchMap
from ..runtime.jobs import Job
from .render import chosen_integrator, film_memory, plenoptic_sensor, require_taken, sample_count
from .scene import GONE_PARAMETERS, KNOWN_PARAMETERS

_RAYS = 2**20
"""Largest count of rays from the detector that are traced at once."""

_SECONDS = 0.6
"""Approximate time in seconds for which light paths are traced."""

_FEW_PATHS = 16
"""Largest count of samples that are traced for a pixel at once."""


@functools.partial(suggest_keywords, others=(*KNOWN_PARAMETERS["plenoptic_wave"], *GONE_PARAMETERS))
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
    """Estimate the time and memory that `render_capture` would take with the same arguments.

    Some of the rays are traced. For method ``points``, all points are found and some of their spreads are computed.

    Parameters
    ----------
    scene, sensor, model, spp, seed, batch_map, **wave
        As in `render_capture`.

    Returns
    -------
    Cost
        Points and point spreads (0 except for method ``points``), seconds, and bytes.

    Raises
    ------
    InputError
        If `render_capture` would refuse the arguments, or the capture would not fit into memory.
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
    """Time rays of rows of pixels that are evenly spaced on the detector, in the order in which Mitsuba traces them."""
    rows, columns = shape
    together = min(spp, _FEW_PATHS)
    lines = min(rows, max(1, _RAYS // (columns * together)))
    count = lines * columns * together
    sampler = mi.load_dict({"type": "independent"})
    pixel = dr.arange(mi.UInt32, count) // together
    column, row = mi.Float(pixel % columns), mi.Float(pixel // columns * (rows // lines))

    def trace() -> float:
        # Seeded for each pass; otherwise Dr.Jit would trace its state from the first pass through all others.
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
