"""Ray captures in passes, whose bits do not depend on threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..camera import PlenopticCamera
from .noise import PARTS, PassSpread

RAYS_PER_PASS = 2**24
"""Rays traced at once. Their random states take 16 bytes each, so that the paper's 4096 x 4096 pixels with one sample
each need 0.25 GiB in addition to the film."""

_SAMPLES_PER_PASS = 2**14
"""Dr.Jit gives blocks of so many rays to its threads; pixels of more samples would be shared by two of them."""


def render_passes(
    scene: Any,
    sensor: Any,
    integrator: Any,
    camera: PlenopticCamera,
    spp: int,
    seed: int,
    progress: Callable[[int, int], None] | None,
    noise: bool,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Render in passes, whose memory does not grow with the sample count; return the image and the requested noise."""
    most = max(1, RAYS_PER_PASS // (camera.shape[0] * camera.shape[1]))
    if noise:
        most = min(most, 1 << (-(-spp // PARTS) - 1).bit_length())
    counts = pass_counts(sensor, spp, most)
    if noise and len(counts) == 1:
        counts *= 2
    # Runs with neighbouring seeds must not share passes, or their average would be no better than either of them.
    seeds = np.random.SeedSequence(seed).generate_state(len(counts))
    image, spread = np.zeros(()), PassSpread()
    for index, (pass_seed, count) in enumerate(zip(seeds.tolist(), counts, strict=True)):
        # `integrator.render` rather than `mi.render`, which hides the cause of an error.
        part = np.array(integrator.render(scene, sensor, seed=pass_seed, spp=count, develop=True))
        if noise:
            spread.add(part, count)
        else:
            part *= count / sum(counts)
            image = np.add(image, part, out=image) if index else part
        if progress:
            progress(min(sum(counts[: index + 1]), spp), spp)
    return (spread.image, spread.deviation()) if noise else (image, None)


def pass_counts(sensor: Any, spp: int, most: int) -> list[int]:
    """Return the sizes of passes, powers of two of at most `most`, that add up to the samples per pixel.

    Otherwise two threads may share a pixel, and the order in which they add its samples varies. Samplers other than
    ``independent`` do not draw every count; the smallest that they draw is their least.
    """
    sampler = sensor.sampler().clone()

    def is_drawn(count: int) -> bool:
        sampler.set_sample_count(count)
        return bool(sampler.sample_count() == count)

    most = min(most, _SAMPLES_PER_PASS, spp)
    sizes = [size for size in (2**k for k in reversed(range(_SAMPLES_PER_PASS.bit_length()))) if is_drawn(size)]
    counts: list[int] = []
    for size in [size for size in sizes if size <= most] or sizes[-1:]:
        counts += [size] * ((spp - sum(counts)) // size)
    # Samplers round up.
    return counts if sum(counts) == spp else [*counts, sizes[-1]]
