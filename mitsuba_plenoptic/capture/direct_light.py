"""Light of emitters that a surface with null or delta lobes emits itself, or scatters by its other lobes.

Emitters are sampled, and met by rays along sampled lobes; both ways are weighed as by Mitsuba's path tracer (Veach,
"Robust Monte Carlo methods for light transport simulation", section 9.2.4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .chains import Chain, Optics


@dataclass
class Scattered:
    """The last surface at which a lobe was sampled, for the weight of the emitter that its ray may meet."""

    surface: Any
    pdf: Any
    valid: Any


def sent(optics: Optics, chain: Chain, si: Any, sampler: Any, active: Any) -> Any:
    """Return what surfaces emit along rays, and scatter of the emitters' light by lobes neither null nor delta.

    Parameters
    ----------
    optics : Optics
        Scene and child.
    chain : Chain
        Chains that arrive at the surfaces.
    si : SurfaceInteraction3f
        The surfaces.
    sampler : mitsuba.Sampler
        Random numbers.
    active : Bool
        Lanes to look at.

    Returns
    -------
    UnpolarizedSpectrum
    """
    child, scene = optics.child, optics.scene
    own = mi.unpolarized_spectrum(si.emitter(scene, active).eval(si, active))
    bsdf = si.bsdf(chain.ray)
    smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & child.allows(chain.used(child) + 1)
    ds, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, smooth)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), smooth)
    lit = smooth & (ds.pdf != 0)
    weight = dr.select(ds.delta, 1, dr.select(_in_medium(si, chain.medium, ds.d), 0, _power_heuristic(ds.pdf, pdf)))
    scattered = mi.unpolarized_spectrum(value) * mi.unpolarized_spectrum(light) * weight
    return dr.select(active, own, 0) + dr.select(lit, scattered, 0)


def weigh_emitters(optics: Optics, chain: Chain, last: Scattered, radiance: Any, active: Any) -> Any:
    """Weigh, in the radiance along rays, the emitters that they meet and that `sent` has sampled, too.

    Parameters
    ----------
    optics : Optics
        Scene and child.
    chain : Chain
        Chains with the rays.
    last : Scattered
        Where the rays have been sampled.
    radiance : UnpolarizedSpectrum
        What the child finds along them.
    active : Bool
        Lanes to look at.

    Returns
    -------
    UnpolarizedSpectrum
    """
    scene = optics.scene
    met = active & last.valid & (chain.medium == None)  # noqa: E711
    si = scene.ray_intersect(chain.ray, met)
    emitter = si.emitter(scene, met)
    emitted = mi.unpolarized_spectrum(emitter.eval(si, met))
    ds = mi.DirectionSample3f(scene, si, last.surface)
    weight = _power_heuristic(last.pdf, scene.pdf_emitter_direction(last.surface, ds, met))
    corrected = dr.maximum(radiance - emitted, 0) + weight * emitted
    return dr.select(met & (emitter != None), corrected, radiance)  # noqa: E711


def _in_medium(si: Any, medium: Any, direction: Any) -> Any:
    """Whether a ray from a surface starts in a medium: emitters are then met by the child's rays alone."""
    return dr.select(si.is_medium_transition(), si.target_medium(direction), medium) != None  # noqa: E711


def _power_heuristic(pdf: Any, other: Any) -> Any:
    own = pdf * pdf
    return dr.select(own > 0, own / (own + other * other), 0)
