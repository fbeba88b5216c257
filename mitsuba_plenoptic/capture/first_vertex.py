r"""Where the light of a camera ray comes from: the first vertex at which it is scattered, emitted, or leaves the scene.

From the camera a ray is followed along null and delta lobes (cut-outs, panes, mirrors, glass): they change the place
from which light seems to come, but its light is still that of one place. Mitsuba's integrators cannot leave lobes out.
So where a surface has lobes of both kinds (plastic, a half-open mask), what the others send is estimated here as a path
tracer does (Veach, "Robust Monte Carlo methods for light transport simulation", chapter 9), and a child integrator is
asked for all that comes from farther off. Of several places on one light path one is drawn by its light (reservoir
sampling), and stands for the light of all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .bundle import Bundle
from .chains import Chain, Optics, intersect, start_offset
from .child import random_numbers
from .direct_light import Scattered, sent, weigh_emitters
from .media import Flight, fly
from .places import Kept, Place, Vertex, seen_directly

_BEFORE = 1e-4
"""Part of the way to a surface, in a medium that has been passed, that is left for the child."""

_STEPS = (3242174889, 2447445414)
"""Steps of the R2 sequence (Roberts 2018) from lane to lane, in units of 2^-32."""


@dataclass
class _State:
    """What changes while rays are followed."""

    chain: Chain
    bundle: Bundle
    throughput: Any
    curved: Any
    place: Place
    kept: Kept
    start: Any
    last: Scattered
    longer: Any
    asked: Any
    going: Any
    free_path: Any
    sampler: Any


@dataclass
class _Met:
    """What rays have met, of which each lane has at most one."""

    si: Any
    distance: Any
    flight: Flight | None
    escapes: Any
    scattered: Any
    hidden: Any
    branches: Any
    ends: Any


def first_vertex(
    optics: Optics, seed: int, ray: Any, together: int = 1, counts: Callable[[Any], Any] | None = None
) -> Vertex:
    """Sample the radiance along rays and the places from which it comes.

    Light is unpolarized between the events of a chain. For integrators that are not Mitsuba's own, `max_depth` counts
    from the last vertex of the chain.

    Parameters
    ----------
    optics : Optics
        Scene and child.
    seed : int
        Of the random numbers.
    ray : Ray3f
        Rays from the camera.
    together : int
        Neighbouring lanes that are light paths of one ray: the numbers that choose their first lobe and first free path
        are spread evenly.
    counts : callable, optional
        Tells from the distances on which rays the light that the child is asked for counts; the rest is left out.

    Returns
    -------
    Vertex
    """
    child, sampler = optics.child, random_numbers(seed, dr.width(ray))
    key, free_path = _even_numbers(seed, dr.width(ray), together)
    channel = mi.UInt32(dr.minimum(sampler.next_1d() * 3, 2)) if mi.is_rgb else mi.UInt32(0)
    nowhere = seen_directly(dr.zeros(mi.SurfaceInteraction3f))
    start = _State(
        Chain.start(ray, key, optics.start),
        Bundle.start(ray.d),
        mi.UnpolarizedSpectrum(1),
        mi.Bool(False),
        nowhere,
        Kept(nowhere, mi.UnpolarizedSpectrum(0), mi.Float(0)),
        mi.Vector3f(ray.d),
        Scattered(dr.zeros(mi.Interaction3f), mi.Float(0), mi.Bool(False)),
        mi.UInt32(0),
        mi.Bool(False),
        child.allows(mi.UInt32(0)),
        mi.Float(free_path >> 8) * 2**-24,
        sampler,
    )
    (end,) = dr.while_loop(
        (start,), lambda state: state.going, lambda state: (_step(state, optics, channel),), label="first vertex"
    )
    if counts is not None:
        end.asked &= counts(end.place.distance)
    # The child is asked in parts, which must not follow the rays anew.
    dr.eval(end)
    number = end.sampler.next_1d()
    kept = end.kept.offer(end.place, end.throughput * _ask(end, optics, seed), number)
    return Vertex(kept.radiance_of_all(), kept.place, key)


def _even_numbers(seed: int, count: int, together: int) -> list[Any]:
    """Return two random whole numbers below 2^32 a lane, which fill the square evenly where lanes belong together."""
    lane = dr.arange(mi.UInt32, count)
    group = lane // together
    # Of the few rounds that are the default, numbers of neighbouring groups are biased by 5 %.
    shifts = mi.sample_tea_32(group, dr.opaque(mi.UInt32, seed), 16)
    return [(lane - group * together) * step + shift for step, shift in zip(_STEPS, shifts, strict=True)]


def _step(state: _State, optics: Optics, channel: Any) -> _State:
    """Follow rays to the next surface or place in a medium, and see whether they go on from there unscattered."""
    chain, child, sampler = state.chain, optics.child, state.sampler
    met, throughput = _meet(state, optics, channel)
    si = met.si
    bundle = state.bundle.transfer(dr.select(met.escapes, 0, met.distance))
    place = _place(state, bundle, met)
    light = sent(optics, chain, si, sampler, met.branches)
    kept = state.kept.offer(place, throughput * light, sampler.next_1d())

    # The surface's own lobes: null and delta ones are followed, the others are the child's.
    sample, weight = chain.sample(si, met.branches)
    passes = met.branches & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    leaves = met.branches & ~passes
    throughput = dr.select(met.branches, throughput * weight, throughput)
    alive = dr.max(throughput) > 0
    straight = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    turned = chain.turn(si, sample)
    onward = dr.select(passes, turned, dr.select(met.hidden, chain.pass_on(si), chain))
    bent = dr.select(passes & ~straight, bundle.bend(si, chain.ray.d, turned.ray.d, sample.eta), bundle)
    bundle_on = dr.select(met.hidden | passes, bent.transfer(start_offset(onward.ray, si)), state.bundle)
    onward.ray = dr.select(leaves, si.spawn_ray(si.to_world(sample.wo)), onward.ray)
    if met.flight is not None:
        onward, weight = _through_matter(chain, onward, met, met.flight, leaves, sampler)
        throughput = throughput * weight
        bundle_on = dr.select(met.flight.collided, bundle, bundle_on)
    flat = dr.squared_norm(si.dn_du) + dr.squared_norm(si.dn_dv) == 0
    done = met.ends | leaves
    return _State(
        onward,
        bundle_on,
        throughput,
        state.curved | (passes & ~straight & ~(flat & (sample.eta == 1))),
        place,
        kept,
        state.start,
        Scattered(
            dr.select(leaves, mi.Interaction3f(si), state.last.surface),
            dr.select(leaves, sample.pdf, state.last.pdf),
            leaves,
        ),
        dr.select(leaves | met.scattered, 1, state.longer),
        state.asked | (done & alive & ~(met.escapes & child.sky_hidden(chain.events, chain.null_events))),
        ~done & alive & child.allows(onward.used(child)),
        dr.select(chain.medium == None, state.free_path, sampler.next_1d()),  # noqa: E711
        sampler,
    )


def _meet(state: _State, optics: Optics, channel: Any) -> tuple[_Met, Any]:
    """Follow rays to what comes next, and return what is left of their throughput, too."""
    chain, child = state.chain, optics.child
    si = intersect(optics.scene, chain.ray, state.going)
    distance, stopped, scattered = si.t, mi.Bool(False), mi.Bool(False)
    flight, throughput = None, state.throughput
    if optics.media:
        flight = fly(chain.medium, chain.ray, si, state.free_path, state.sampler, channel, state.going)
        throughput = throughput * flight.weight
        distance = dr.select(flight.stopped, flight.mei.t, si.t)
        stopped, scattered = flight.stopped, flight.scattered
    arrives, escapes = ~stopped & si.is_valid(), ~stopped & ~si.is_valid()
    hidden = arrives & chain.passes_lamp(si, child)
    branches = arrives & ~hidden & chain.branches(si)
    ends = (arrives & ~hidden & ~branches) | escapes | scattered
    return _Met(si, distance, flight, escapes, scattered, hidden, branches, ends), throughput


def _through_matter(
    chain: Chain, onward: Chain, met: _Met, flight: Flight, leaves: Any, sampler: Any
) -> tuple[Chain, Any]:
    """Return how chains go on, and the weight of a new direction, where a medium has scattered or let them pass."""
    mei, si = flight.mei, met.si
    wo, phase_weight, _ = mei.medium.phase_function().sample(
        mi.PhaseFunctionContext(sampler), mei, sampler.next_1d(), sampler.next_2d(), met.scattered
    )
    # Matter that the ray has passed must not weaken its light once more.
    inside = met.ends & ~met.escapes & ~met.scattered & (chain.medium != None)  # noqa: E711
    near, along = mi.Ray3f(chain.ray), mi.Ray3f(chain.ray)
    near.o = chain.ray(si.t * (1 - _BEFORE))
    along.o = mei.p
    medium = dr.select(leaves & si.is_medium_transition(), si.target_medium(onward.ray.d), onward.medium)
    matter = replace(
        onward,
        ray=dr.select(met.scattered, mei.spawn_ray(wo), dr.select(inside, near, onward.ray)),
        medium=dr.select(met.escapes, dr.zeros(mi.MediumPtr), medium),
    )
    passed = replace(onward, ray=along, length=chain.length + met.distance)
    weight = dr.select(met.scattered, mi.unpolarized_spectrum(phase_weight), 1)
    return dr.select(flight.collided, passed, matter), weight


def _place(state: _State, bundle: Bundle, met: _Met) -> Place:
    """Return the place at the end of a way."""
    ray = state.chain.ray
    mean, difference = bundle.vergence(ray.d, met.escapes)
    plane = dr.select(met.escapes, dr.inf, state.chain.length + met.distance)
    return Place(
        dr.select(state.curved, dr.rcp(mean), plane),
        dr.select(state.curved, difference, 0),
        state.curved,
        dr.select(met.escapes, ray.o, ray(met.distance)),
        met.si.n,
        dr.select(met.escapes | met.scattered, 0, bundle.apparent(state.start, ray.d, mi.Vector3f(met.si.n))),
        met.escapes,
        met.scattered,
        state.chain.signature,
    )


def _ask(end: _State, optics: Optics, seed: int) -> Any:
    """Ask the child for the radiance from where rays have been followed to."""
    chain, child = end.chain, optics.child
    hidden = child.lamps_hidden(chain.events, chain.null_events) & (end.longer == 0)
    used = chain.used(child) + end.longer
    radiance = child.sample(optics.scene, seed, chain.ray, chain.medium, used, hidden, end.asked, optics.media)
    return weigh_emitters(optics, chain, end.last, radiance, end.asked & child.allows(used))
