"""The time that a capture takes, from a small part of its rays and, for waves, what these took for known scenes.

The plan of a camera's diffraction takes longer than a small capture's rays, so estimates make no plan. Wave captures of
the built-in scenes take a fixed part of the time of their ray captures, and times for each ray and each pixel that hold
for all scenes. These are counted in the time that the machine's Fourier transforms take for a sample.
"""

from __future__ import annotations

import time
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..runtime import active_backend, fft, on_all_cores

_RAYS = 2**20
"""Largest count of rays from the detector that are traced at once."""

_SECONDS = 0.6
_PART = 64
"""Approximate time in seconds for which light paths are traced, but no more than about this part of the capture."""

_TRACED = 0.8
_OF_RAY = 0.7
_OF_PIXEL = 10.0
_OF_PLAN = 1e8
"""Time of a wave capture: its rays' over that of a ray capture's, and what each ray and each pixel of each wavelength
takes, and the plan of a wavelength, over that of a sample of a Fourier transform."""

_TRANSFORM = 512
"""Samples across the Fourier transform that is timed."""


def seconds_by_rays(scene: Any, sensor: Any, integrator: Any, *, seed: int, spp: int) -> float:
    """Return the estimated seconds of a ray capture: evenly spaced rows of pixels are traced in Mitsuba's order."""
    columns, rows = (int(size) for size in sensor.film().crop_size())
    samples = rows * columns * spp
    # 16: Largest count of samples that are traced for a pixel at once.
    together = min(spp, 16)
    lines = min(rows, max(1, min(_RAYS, samples // _PART) // (columns * together)))
    count = lines * columns * together
    sampler = mi.load_dict({"type": "independent"})
    pixel = dr.arange(mi.UInt32, count) // together
    column = mi.Float(pixel % columns)
    row = mi.Float(pixel // columns * (rows // lines))

    def trace() -> float:
        # Seeded for each pass; otherwise Dr.Jit would trace its state from the first pass through all others.
        sampler.seed(seed, count)
        dr.sync_thread()
        start = time.perf_counter()
        offset = sampler.next_2d()
        position = mi.Point2f((column + offset.x) / columns, (row + offset.y) / rows)
        ray, weight = sensor.sample_ray_differential(0.0, sampler.next_1d(), position, sampler.next_2d())
        radiance = mi.SamplingIntegrator.sample(integrator, scene, sampler, ray, sensor.get_medium(), True)[0]
        dr.eval(mi.unpolarized_spectrum(radiance) * mi.unpolarized_spectrum(weight))
        dr.sync_thread()
        return time.perf_counter() - start

    dr.eval(column, row)
    trace()  # compiles the kernels
    seconds = trace()
    traced = count
    while seconds < _SECONDS and traced * _PART < samples:
        seconds += trace()
        traced += count
    return seconds * samples / traced


def seconds_by_waves(by_rays: float, rays: float, pixels: float, images: int) -> float:
    """Return the estimated seconds of a wave capture from those of equally many rays of a ray capture.

    `images` are those of all wavelengths and channels together.
    """
    # The seconds that a Fourier transform takes for a sample, with one transform on each core.
    libraries = active_backend()
    workers = 1 if active_backend().is_cuda else fft.worker_count()
    image = libraries.arrays.ones((_TRANSFORM, _TRANSFORM), np.float32)
    seconds = []
    for _ in range(2):
        libraries.synchronize()
        start = time.perf_counter()
        on_all_cores(libraries.transforms.rfft2, [image] * workers)
        libraries.synchronize()
        seconds.append(time.perf_counter() - start)
    sample = min(seconds) / (workers * _TRANSFORM**2)
    return _TRACED * by_rays + sample * images * (_OF_RAY * rays + _OF_PIXEL * pixels + _OF_PLAN)
