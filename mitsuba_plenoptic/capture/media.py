"""Free flight of light through a participating medium, as Mitsuba's volumetric integrators sample it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .child import channel_mean


@dataclass
class Flight:
    """What has happened to light on its way to the next surface.

    Attributes
    ----------
    mei : MediumInteraction3f
        Where it has been stopped.
    weight : UnpolarizedSpectrum
        Factor on the radiance from there, or from the surface.
    scattered : Bool
        Whether it has been scattered; phase function and albedo are then part of the light's further way.
    collided : Bool
        Whether it has met fictitious matter that fills a heterogeneous medium up, and goes on.
    """

    mei: Any
    weight: Any
    scattered: Any
    collided: Any

    @property
    def stopped(self) -> Any:
        """Whether it has not come to the surface."""
        return self.scattered | self.collided


def fly(medium: Any, ray: Any, si: Any, number: Any, sampler: Any, channel: Any, active: Any) -> Flight:
    """Sample how far light comes in a medium before the next surface; an absorbing even medium is not left to chance.

    Parameters
    ----------
    medium : MediumPtr
        Where the rays are; null where nothing is.
    ray : Ray3f
        The rays.
    si : SurfaceInteraction3f
        The next surface.
    number : Float
        Random number that chooses how far.
    sampler : mitsuba.Sampler
        Other random numbers.
    channel : UInt32
        Channel of the spectrum by which distances are drawn.
    active : Bool
        Lanes to look at.
    """
    active = active & (medium != None)  # noqa: E711
    mei = medium.sample_interaction(ray, number, channel, active)
    absorbing = medium.is_homogeneous() & (dr.max(mei.sigma_s) == 0)
    mei.t = dr.select(absorbing | (si.t < mei.t), dr.inf, mei.t)
    transmittance, pdf = medium.transmittance_eval_pdf(mei, si, active)
    chance = _of_channel(pdf, channel)
    weight = dr.select(absorbing, transmittance, dr.select(chance > 0, transmittance / chance, 0))
    real = channel_mean(mei.sigma_t / mei.combined_extinction)
    met, is_real = active & mei.is_valid(), sampler.next_1d(active) < real
    scattered, collided = met & is_real, met & ~is_real
    weight = dr.select(scattered, weight * mei.sigma_s / real, weight)
    weight = dr.select(collided, weight * mei.sigma_n / (1 - real), weight)
    return Flight(mei, dr.select(active, weight, 1), scattered, collided)


def _of_channel(spectrum: Any, channel: Any) -> Any:
    """Return one channel of a spectrum."""
    value = spectrum[0]
    for i in range(1, len(spectrum) if mi.is_rgb else 1):
        value = dr.select(channel == i, spectrum[i], value)
    return value
