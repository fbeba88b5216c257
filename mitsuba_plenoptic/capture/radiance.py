"""The radiance along rays, as an integrator of Mitsuba estimates it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi


def random_numbers(seed: int, lanes: int) -> Any:
    """Return a sampler of independent random numbers."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, lanes)
    return sampler


def sample(integrator: Any, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any) -> Any:
    """Return the unpolarized radiance that an integrator estimates along rays; black where not active."""
    # The unbound method reaches integrators written in C++ and in Python alike.
    radiance, _, *_ = mi.SamplingIntegrator.sample(
        integrator, scene, sampler, mi.RayDifferential3f(ray), medium, active
    )
    return dr.select(active, mi.unpolarized_spectrum(radiance), 0)


def channels(radiance: Any) -> list[Any]:
    """Return the channels of a spectrum; lanes of wavelengths are all of one."""
    return [radiance[0]] if mi.is_spectral else list(radiance)
