"""Chains of null and delta lobes, which light follows unscattered from where it starts to the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import InputError
from .child import Child

MOST_EVENTS = 32
"""Events of a chain at most; from there on the child is asked for all that comes."""

_GRAZING = 0.01
"""Cosine with the normal below which a ray's line leaves a surface too slowly."""


@dataclass(frozen=True)
class Optics:
    """What of a scene bends, splits or weakens light on its way to the camera.

    Attributes
    ----------
    scene : mitsuba.Scene
        The scene.
    child : Child
        The integrator, which tells what of this it sees.
    start : mitsuba.Medium, optional
        The medium in which rays start: the sensor's.
    media : list
        All media; empty for an integrator that sees none.
    plain : bool
        Whether all light that the child sees is scattered or emitted where a ray first hits.
    gloss : bool
        Whether anything has glossy lobes.
    """

    scene: Any
    child: Child
    start: Any
    media: list[Any]
    plain: bool
    gloss: bool

    @classmethod
    def of(cls, scene: Any, child: Child, sensor: Any) -> Optics:
        """Look for null and delta lobes, and for media, in a scene.

        Raises
        ------
        InputError
            If there is a scattering medium and an emitter without area: what that sends to the medium is not found.
        """
        media = []
        shapes = list(scene.shapes())
        if child.sees_media:
            found = [sensor.get_medium()]
            found += [medium for shape in shapes for medium in (shape.interior_medium(), shape.exterior_medium())]
            media = [medium for i, medium in enumerate(found) if medium is not None and medium not in found[:i]]
        points = [emitter for emitter in scene.emitters() if mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)]
        if points and any(map(_scatters, media)):
            kind = points[0].class_name()
            raise InputError(f"scene: it has a {kind} and a scattering medium: by waves its emitters need an area")
        lamps = child.hides and any(shape.is_emitter() for shape in shapes)
        plain = not media and not lamps and not any(_has(shape, mi.BSDFFlags.Delta) for shape in shapes)
        gloss = any(_has(shape, mi.BSDFFlags.Glossy) for shape in shapes)
        return cls(scene, child, sensor.get_medium() if media else None, media, plain, gloss)


@dataclass
class Chain:
    """How far rays have been followed: a lane a ray.

    Attributes
    ----------
    ray : Ray3f
        The ray that goes on.
    key : UInt32
        Number that decides between lobes: the same key takes the same ones.
    medium : MediumPtr
        Where it is.
    events, null_events : UInt32
        Number of reflections, refractions and null events; and of the latter.
    signature : UInt32
        What has happened but for null events: equal for equal chains.
    length : Float
        Length of the way.
    """

    ray: Any
    key: Any
    medium: Any
    events: Any
    null_events: Any
    signature: Any
    length: Any

    @classmethod
    def start(cls, ray: Any, key: Any, medium: Any) -> Chain:
        """Return chains of which nothing has been followed."""
        inside = dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)
        return cls(mi.Ray3f(ray), mi.UInt32(key), inside, mi.UInt32(0), mi.UInt32(0), mi.UInt32(0), mi.Float(0))

    def used(self, child: Child) -> Any:
        """Return how much of the child's `max_depth` the events take."""
        return child.used(self.events, self.null_events)

    def passes_lamp(self, si: Any, child: Child) -> Any:
        """Whether the ray has met an emitter that the child hides from it."""
        return child.lamps_hidden(self.events, self.null_events) & si.is_valid() & (si.shape.emitter() != None)  # noqa: E711

    def branches(self, si: Any) -> Any:
        """Whether light that comes along the ray may have been sent by a null or delta lobe of the surface."""
        return si.is_valid() & (self.events < MOST_EVENTS) & mi.has_flag(si.bsdf(self.ray).flags(), mi.BSDFFlags.Delta)

    def sample(self, si: Any, active: Any) -> tuple[Any, Any]:
        """Choose a lobe of the surface, by the key: a sample of the BSDF and its weight, unpolarized."""
        a, b, c = (mi.sample_tea_float32(self.key, 3 * self.events + i) for i in range(3))
        # Keys that are spread evenly choose the first lobe evenly.
        a = dr.select(self.events == 0, mi.Float(self.key >> 8) * 2**-24, a)
        sample, weight = si.bsdf(self.ray).sample(mi.BSDFContext(), si, a, mi.Point2f(b, c), active)
        return sample, mi.unpolarized_spectrum(weight)

    def pass_on(self, si: Any) -> Chain:
        """Go on behind a surface as if it were not there."""
        ray = go_on(si, self.ray.d)
        return replace(self, ray=ray, length=self.length + si.t + start_offset(ray, si))

    def turn(self, si: Any, sample: Any) -> Chain:
        """Go on along a null or delta lobe."""
        ray = go_on(si, si.to_world(sample.wo))
        null = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        # Fowler, Noll and Vo's hash, with the lobe in place of a byte
        mixed = (self.signature ^ (sample.sampled_component + 1)) * 16777619 + 1
        return Chain(
            ray,
            self.key,
            dr.select(si.is_medium_transition(), si.target_medium(ray.d), self.medium),
            self.events + 1,
            self.null_events + dr.select(null, 1, 0),
            dr.select(null, self.signature, mixed),
            self.length + si.t + start_offset(ray, si),
        )


def intersect(scene: Any, ray: Any, active: Any) -> Any:
    """Return the next surface, with the derivatives of its shading normal."""
    return scene.ray_intersect(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, False, active)


def go_on(si: Any, direction: Any) -> Any:
    """Return a ray that goes on from a surface and does not meet it again.

    Mitsuba moves such a ray's start along the normal, and so the ray sideways: surfaces that it then meets at grazing
    incidence would be met at another place. Here it stays on its line.
    """
    ray = si.spawn_ray(direction)
    cosine = dr.dot(direction, si.n)
    along = dr.dot(ray.o - si.p, si.n) / cosine
    ray.o = dr.select(dr.abs(cosine) > _GRAZING, si.p + direction * along, ray.o)
    return ray


def start_offset(ray: Any, si: Any) -> Any:
    """Return how far from a surface, along it, a ray starts that Mitsuba has kept from meeting the surface again."""
    return dr.dot(ray.o - si.p, ray.d)


@dataclass
class _Walk:
    """Chains on their way to a known end."""

    chain: Chain
    weight: Any
    arrived: Any
    going: Any


def leads_to(optics: Optics, ray: Any, key: Any, place: Any, tolerance: Any) -> tuple[Any, Chain, Any]:
    """Follow chains, by the same choices, to where others have ended.

    Parameters
    ----------
    optics : Optics
        Scene and child.
    ray : Ray3f
        Rays from the camera.
    key : UInt32
        The keys of the other chains.
    place : Place
        Where those have ended.
    tolerance : Float
        How far from there, over the length of the way, a ray may pass.

    Returns
    -------
    arrived : Bool
        Whether they end there, too.
    chain : Chain
        The chains, with the ray that arrives.
    weight : UnpolarizedSpectrum
        What the events on the way leave of the light.
    """

    def step(walk: _Walk) -> _Walk:
        chain, child = walk.chain, optics.child
        si = intersect(optics.scene, chain.ray, walk.going)
        ahead = dr.dot(place.point - chain.ray.o, chain.ray.d)
        margin = tolerance * (chain.length + ahead)
        meets = (ahead > 0) & (ahead <= si.t + margin) & (dr.norm(chain.ray(ahead) - place.point) <= margin)
        arrived = (chain.signature == place.signature) & dr.select(place.escaped, ~si.is_valid(), meets)
        hidden = ~arrived & chain.passes_lamp(si, child)
        branches = ~arrived & ~hidden & chain.branches(si)
        sample, weight = chain.sample(si, branches)
        passes = branches & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta) & (dr.max(weight) > 0)
        onward = dr.select(passes, chain.turn(si, sample), dr.select(hidden, chain.pass_on(si), chain))
        weight = dr.select(passes, walk.weight * weight, walk.weight)
        return _Walk(onward, weight, walk.arrived | arrived, passes | hidden)

    start = _Walk(Chain.start(ray, key, None), mi.UnpolarizedSpectrum(1), mi.Bool(False), mi.Bool(True))
    (end,) = dr.while_loop((start,), lambda walk: walk.going, lambda walk: (step(walk),), label="shadow rays")
    return end.arrived, end.chain, end.weight


def _has(shape: Any, lobes: Any) -> bool:
    """Whether a shape has some kind of lobes, or holds shapes of which that is not known."""
    # The BSDF that an instance itself tells is a dummy.
    bsdf, holds = shape.bsdf(), shape.class_name() == "Instance"
    return bsdf is None or holds or mi.has_flag(bsdf.flags(), lobes)


def _scatters(medium: Any) -> bool:
    """Whether a medium scatters, as far as is known."""
    if not medium.is_homogeneous():
        return True
    coefficients = medium.get_scattering_coefficients(dr.zeros(mi.MediumInteraction3f), mi.Bool(True))
    return bool(np.any(coefficients[0].numpy() > 0))
