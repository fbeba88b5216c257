r"""Where the light of a camera ray comes from: the first vertex at which it is scattered, emitted, or leaves the scene.

From the camera a ray is followed along null and delta lobes (cut-outs, panes, mirrors, glass): they change the place
from which light seems to come, but its light is still that of one place. Mitsuba's integrators cannot leave lobes out.
So where a surface has lobes of both kinds (plastic, a half-open mask), what the others send is estimated here as a path
tracer does (Veach, "Robust Monte Carlo methods for light transport simulation", chapter 9), and a child integrator is
asked for all that comes from farther off. Of several places on one light path one is drawn by its light (reservoir
sampling), and stands for the light of all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .bundle import Bundle
from .chains import Chain, Optics, intersect, start_offset
from .media import fly

_BEFORE = 1e-4
"""Part of the way to a surface, in a medium that has been passed, that is left for the child."""


@dataclass
class Place:
    """From where light seems to come, and from where it comes.

    Attributes
    ----------
    distance : Float
        Distance, along the ray that has found it, of the place from which it seems to come: infinite where that is at
        infinity, negative where the light converges to a place behind the ray's start.
    astigmatism : Float
        Difference of the reciprocal distances in the two principal sections.
    curved : Bool
        Whether it has come through refracting or curved surfaces.
    point : Point3f
        Where it comes from, in the world.
    normal : Normal3f
        The surface's normal there.
    escaped : Bool
        Whether it comes from infinity instead.
    scattered : Bool
        Whether it has been scattered by a medium there.
    signature : UInt32
        Equal for equal chains.
    """

    distance: Any
    astigmatism: Any
    curved: Any
    point: Any
    normal: Any
    escaped: Any
    scattered: Any
    signature: Any


@dataclass
class Vertex:
    """The first vertex of each of many rays.

    Attributes
    ----------
    radiance : UnpolarizedSpectrum
        Its mean is the radiance that the child finds along the ray.
    place : Place
        Where it comes from.
    key : UInt32
        The key of the chain that leads there.
    """

    radiance: Any
    place: Place
    key: Any


@dataclass
class _Kept:
    """A place drawn among those of a light path, each with a chance proportional to its radiance."""

    place: Place
    radiance: Any
    total: Any

    def offer(self, place: Place, radiance: Any, number: Any) -> _Kept:
        """Add a place; `number` is random."""
        power = dr.mean(radiance)
        total = self.total + power
        taken = number * total < power
        return _Kept(dr.select(taken, place, self.place), dr.select(taken, radiance, self.radiance), total)


@dataclass
class _Scattered:
    """The last surface at which a lobe was sampled, for the weight of the emitter that its ray may meet."""

    surface: Any
    pdf: Any
    valid: Any


@dataclass
class _State:
    """What changes while rays are followed."""

    chain: Chain
    bundle: Bundle
    throughput: Any
    curved: Any
    place: Place
    kept: _Kept
    last: _Scattered
    longer: Any
    asked: Any
    going: Any
    sampler: Any


def first_vertex(optics: Optics, sampler: Any, ray: Any, active: Any = True) -> Vertex:
    """Sample the radiance along rays and the places from which it comes.

    Light is unpolarized between the events of a chain. For integrators that are not Mitsuba's own, `max_depth` counts
    from the last vertex of the chain.

    Parameters
    ----------
    optics : Optics
        Scene and child.
    sampler : mitsuba.Sampler
        Random numbers, a lane a ray.
    ray : Ray3f
        Rays from the camera.
    active : Bool
        Lanes to look at.

    Returns
    -------
    Vertex
    """
    child = optics.child
    key = mi.UInt32(sampler.next_1d() * 2.0**24) + (mi.UInt32(sampler.next_1d() * 256.0) << 24)
    channel = mi.UInt32(dr.minimum(sampler.next_1d() * 3, 2)) if mi.is_rgb else mi.UInt32(0)
    nowhere = seen_directly(dr.zeros(mi.SurfaceInteraction3f))
    start = _State(
        Chain.start(ray, key, optics.start),
        Bundle.start(ray.d),
        mi.UnpolarizedSpectrum(1),
        mi.Bool(False),
        nowhere,
        _Kept(nowhere, mi.UnpolarizedSpectrum(0), mi.Float(0)),
        _Scattered(dr.zeros(mi.Interaction3f), mi.Float(0), mi.Bool(False)),
        mi.UInt32(0),
        mi.Bool(False),
        mi.Bool(active) & child.allows(mi.UInt32(0)),
        sampler,
    )
    (end,) = dr.while_loop(
        (start,), lambda state: state.going, lambda state: (_step(state, optics, channel),), label="first vertex"
    )
    if not child.uniform:
        # The child is asked in parts, which must not follow the rays anew.
        dr.eval(end)
    kept = end.kept.offer(end.place, end.throughput * _ask(end, optics), sampler.next_1d())
    power = dr.mean(kept.radiance)
    return Vertex(dr.select(power > 0, kept.radiance * (kept.total / power), 0), kept.place, key)


def seen_directly(si: Any) -> Place:
    """Return the places that rays have met, where nothing branches."""
    distance = dr.select(si.is_valid(), si.t, dr.inf)
    no = mi.Bool(False)
    return Place(distance, mi.Float(0), no, si.p, si.n, ~si.is_valid(), no, mi.UInt32(0))


def _step(state: _State, optics: Optics, channel: Any) -> _State:
    """Follow rays to the next surface or place in a medium, and see whether they go on from there unscattered."""
    chain, child, scene, sampler = state.chain, optics.child, optics.scene, state.sampler
    ray, throughput = chain.ray, state.throughput
    si = intersect(scene, ray, state.going)
    distance, stopped, scattered = si.t, mi.Bool(False), mi.Bool(False)
    if optics.media:
        flight = fly(chain.medium, ray, si, sampler, channel, state.going)
        throughput = throughput * flight.weight
        distance = dr.select(flight.stopped, flight.mei.t, si.t)
        stopped, scattered = flight.stopped, flight.scattered
    arrives, escapes = ~stopped & si.is_valid(), ~stopped & ~si.is_valid()
    hidden = arrives & chain.passes_lamp(si, child)
    branches = arrives & ~hidden & chain.branches(si)
    ends = (arrives & ~hidden & ~branches) | escapes | scattered

    bundle = state.bundle.transfer(dr.select(escapes, 0, distance))
    place = _place(state, bundle, si.n, distance, escapes, scattered)
    sent, number = _sent(state, si, branches, optics), sampler.next_1d()
    kept = state.kept.offer(place, throughput * sent, number)

    # The surface's own lobes: null and delta ones are followed, the others are the child's.
    sample, weight = chain.sample(si, branches)
    passes = branches & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    leaves = branches & ~passes
    throughput = dr.select(branches, throughput * weight, throughput)
    alive = dr.max(throughput) > 0
    straight = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
    turned = chain.turn(si, sample)
    bent = bundle.bend(si, ray.d, turned.ray.d, sample.eta)
    flat = dr.squared_norm(si.dn_du) + dr.squared_norm(si.dn_dv) == 0
    curved = state.curved | (passes & ~straight & ~(flat & (sample.eta == 1)))

    onward = dr.select(passes, turned, dr.select(hidden, chain.pass_on(si), chain))
    next_bundle = dr.select(passes & ~straight, bent, dr.select(hidden | passes, bundle, state.bundle))
    next_bundle = next_bundle.transfer(dr.select(hidden | passes, start_offset(onward.ray, si), 0))
    asked_ray = dr.select(leaves, si.spawn_ray(si.to_world(sample.wo)), ray)
    if optics.media:
        mei = flight.mei
        phase = mei.medium.phase_function()
        context = mi.PhaseFunctionContext(sampler)
        wo, phase_weight, _ = phase.sample(context, mei, sampler.next_1d(), sampler.next_2d(), scattered)
        throughput = dr.select(scattered, throughput * mi.unpolarized_spectrum(phase_weight), throughput)
        # Matter that the ray has passed must not weaken its light once more.
        inside = ends & arrives & (chain.medium != None)  # noqa: E711
        near, scattered_ray, along = mi.Ray3f(ray), mei.spawn_ray(wo), mi.Ray3f(ray)
        near.o = ray(si.t * (1 - _BEFORE))
        along.o = mei.p
        asked_ray = dr.select(scattered, scattered_ray, dr.select(inside, near, asked_ray))
        collided = flight.collided
        onward.ray = dr.select(collided, along, onward.ray)
        onward.length = dr.select(collided, chain.length + distance, onward.length)
        next_bundle = dr.select(collided, bundle, next_bundle)
        onward.medium = dr.select(escapes, dr.zeros(mi.MediumPtr), onward.medium)
        onward.medium = dr.select(leaves & si.is_medium_transition(), si.target_medium(asked_ray.d), onward.medium)
    onward.ray = dr.select(ends | leaves, asked_ray, onward.ray)
    done = ends | leaves
    longer = dr.select(leaves | scattered, 1, state.longer)
    asked = done & alive & ~(escapes & child.sky_hidden(chain.events, chain.null_events))
    last = _Scattered(
        dr.select(leaves, mi.Interaction3f(si), state.last.surface),
        dr.select(leaves, sample.pdf, state.last.pdf),
        leaves,
    )
    going = ~done & alive & child.allows(onward.used(child))
    return _State(
        onward, next_bundle, throughput, curved, place, kept, last, longer, state.asked | asked, going, sampler
    )


def _place(state: _State, bundle: Bundle, normal: Any, distance: Any, escaped: Any, scattered: Any) -> Place:
    """Return the place at the end of a way."""
    ray = state.chain.ray
    mean, difference = bundle.vergence(ray.d, escaped)
    plane = dr.select(escaped, dr.inf, state.chain.length + distance)
    return Place(
        dr.select(state.curved, dr.rcp(mean), plane),
        dr.select(state.curved, difference, 0),
        state.curved,
        dr.select(escaped, ray.o, ray(distance)),
        normal,
        escaped,
        scattered,
        state.chain.signature,
    )


def _sent(state: _State, si: Any, active: Any, optics: Optics) -> Any:
    """Return what a surface with null or delta lobes emits, and scatters of the emitters' light by its other lobes."""
    chain, child, scene = state.chain, optics.child, optics.scene
    own = mi.unpolarized_spectrum(si.emitter(scene, active).eval(si, active))
    bsdf = si.bsdf(chain.ray)
    smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) & child.allows(chain.used(child) + 1)
    ds, light = scene.sample_emitter_direction(si, state.sampler.next_2d(), True, smooth)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), smooth)
    lit = smooth & (ds.pdf != 0)
    weight = dr.select(ds.delta, 1, dr.select(_in_medium(si, chain.medium, ds.d), 0, _mis(ds.pdf, pdf)))
    scattered = mi.unpolarized_spectrum(value) * mi.unpolarized_spectrum(light) * weight
    return dr.select(active, own, 0) + dr.select(lit, scattered, 0)


def _ask(end: _State, optics: Optics) -> Any:
    """Ask the child for the radiance from where rays have been followed to."""
    chain, child, scene = end.chain, optics.child, optics.scene
    hidden = child.lamps_hidden(chain.events, chain.null_events) & (end.longer == 0)
    used = chain.used(child) + end.longer
    radiance = child.sample(scene, end.sampler, chain.ray, chain.medium, used, hidden, end.asked, optics.media)
    # Emitters that a sampled ray meets have been sampled, too: they get the other part of the weight.
    met = end.asked & end.last.valid & (chain.medium == None) & child.allows(used)  # noqa: E711
    si = scene.ray_intersect(chain.ray, met)
    emitter = si.emitter(scene, met)
    emitted = mi.unpolarized_spectrum(emitter.eval(si, met))
    ds = mi.DirectionSample3f(scene, si, end.last.surface)
    weight = _mis(end.last.pdf, scene.pdf_emitter_direction(end.last.surface, ds, met))
    corrected = dr.maximum(radiance - emitted, 0) + weight * emitted
    return dr.select(met & (emitter != None), corrected, radiance)  # noqa: E711


def _in_medium(si: Any, medium: Any, direction: Any) -> Any:
    """Whether a ray from a surface starts in a medium: emitters are then met by the child's rays alone."""
    return dr.select(si.is_medium_transition(), si.target_medium(direction), medium) != None  # noqa: E711


def _mis(pdf: Any, other: Any) -> Any:
    """Return the power heuristic's weight of a sample (Veach, section 9.2.4)."""
    own = pdf * pdf
    return dr.select(own > 0, own / (own + other * other), 0)
