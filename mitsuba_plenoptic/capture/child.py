"""What is known of a child integrator: how long its light paths are, what it hides, whether it sees media."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

_ENDLESS = 2**31
"""Lengths of light paths from here on mean that there is no limit."""

_NOT_ASKED = 2**32 - 1
"""Stands for lanes of which nothing is asked."""

_PLUGINS = {
    "PathIntegrator": "path",
    "DirectIntegrator": "direct",
    "VolumetricPathIntegrator": "volpath",
    "VolpathMisIntegratorImpl": "volpathmis",
    "PRBIntegrator": "prb",
    "BasicPRBIntegrator": "prb_basic",
    "PRBVolpathIntegrator": "prbvolpath",
    "PathProjectiveIntegrator": "prb_projective",
    "DirectProjectiveIntegrator": "direct_projective",
}
"""Plugins, by the names of their classes, whose parameters can be read."""

_VOLUMETRIC = ("volpath", "volpathmis", "prbvolpath")


@dataclass
class Child:
    """A child integrator that is asked for the radiance at a later vertex of its light path.

    Attributes
    ----------
    integrator : mitsuba.SamplingIntegrator
        The child.
    plugin : str, optional
        Its type; None if it is not one of Mitsuba's own. Such a one gets no shorter light paths than its own from
        later vertices.
    max_depth : int, optional
        Most vertices of a light path, beginning with the first surface; None: no limit that is known.
    hides : bool
        Whether emitters are hidden that the camera sees directly.
    sees_media : bool
        Whether it knows participating media.
    """

    integrator: Any
    plugin: str | None
    max_depth: int | None
    rr_depth: int
    hides: bool
    sees_media: bool
    _copies: dict[tuple[int, bool], Any] = field(default_factory=dict)

    @classmethod
    def of(cls, integrator: Any) -> Child:
        """Read a child's parameters."""
        plugin = _PLUGINS.get(integrator.class_name(), _PLUGINS.get(type(integrator).__name__))
        depth = 2 if plugin == "direct" else _number(integrator, "max_depth", _ENDLESS)
        return cls(
            integrator,
            plugin,
            depth if plugin and depth < _ENDLESS else None,
            _number(integrator, "rr_depth", 5),
            bool(getattr(integrator, "hide_emitters", False)),
            plugin in _VOLUMETRIC or plugin is None,
        )

    @property
    def uniform(self) -> bool:
        """Whether the child is the same for all later vertices."""
        return self.max_depth is None and not self.hides

    def used(self, events: Any, null_events: Any) -> Any:
        """Return how much of `max_depth` some events take: volumetric integrators do not count the null ones."""
        return events - null_events if self.plugin in _VOLUMETRIC else events

    def lamps_hidden(self, events: Any, null_events: Any) -> Any:
        """Whether area emitters are transparent after some events; volumetric integrators do not count null ones."""
        return (self.used(events, null_events) == 0) & self.hides

    def sky_hidden(self, events: Any, null_events: Any) -> Any:
        """Whether the environment is black after some events: for ``path``, too, what nothing but null ones precede."""
        if self.plugin == "path":
            return (events == null_events) & self.hides
        return self.lamps_hidden(events, null_events)

    def allows(self, used: Any) -> Any:
        """Whether a light path may have one more vertex."""
        return mi.Bool(True) if self.max_depth is None else used < self.max_depth

    def sample(
        self, scene: Any, seed: int, ray: Any, medium: Any, used: Any, hidden: Any, active: Any, media: list[Any]
    ) -> Any:
        """Estimate the radiance along rays from later vertices of light paths.

        Parameters
        ----------
        scene : mitsuba.Scene
            The scene.
        seed : int
            Of the random numbers.
        ray : Ray3f
            One lane a ray.
        medium : MediumPtr
            The medium in which each ray starts.
        used : UInt32
            How much of `max_depth` has been used up.
        hidden : Bool
            Whether emitters that the ray sees directly are hidden.
        active : Bool
            Lanes that are asked for.
        media : list
            All media in which rays may start.

        Returns
        -------
        UnpolarizedSpectrum
        """
        if self.uniform and not media:
            return sample(self.integrator, scene, random_numbers(seed, dr.width(ray)), ray, None, active)
        # An integrator is asked for one length, and in one medium, at a time: only for the lanes that have it.
        inside = mi.UInt32(0)
        for number, one in enumerate(media, 1):
            inside = dr.select(medium == mi.MediumPtr(one), number, inside)
        used = mi.UInt32(0) if self.max_depth is None else dr.minimum(used, self.max_depth)
        kinds = 2 * (1 + len(media))
        kind = dr.select(active, used * kinds + 2 * inside + dr.select(hidden, 1, 0), _NOT_ASKED)
        kind += dr.zeros(mi.UInt32, dr.width(ray))
        dr.eval(kind, ray)
        result = dr.zeros(mi.UnpolarizedSpectrum, dr.width(ray))
        numbers = kind.numpy()
        for value in np.flatnonzero(np.bincount(numbers[numbers != _NOT_ASKED])).tolist():
            used_up, own = divmod(value, kinds)
            if used_up == self.max_depth:
                continue
            some, own_medium = dr.compress(kind == value), own // 2
            taken = mi.Bool(True)
            if dr.width(some) == 1:
                # Dr.Jit writes the numbers of a single lane into the kernel: it is followed twice, and taken once.
                some, taken = mi.UInt32([some[0], some[0]]), mi.Bool([True, False])
            sampler = random_numbers(int(np.random.SeedSequence([seed, value]).generate_state(1)[0]), dr.width(some))
            light = sample(
                self._copy(used_up, bool(own % 2)),
                scene,
                sampler,
                dr.gather(mi.Ray3f, ray, some),
                media[own_medium - 1] if own_medium else None,
                mi.Bool(True),
            )
            dr.scatter(result, light, some, taken)
        return result

    def _copy(self, used: int, hides: bool) -> Any:
        """Return the integrator for light paths that go on from a later vertex."""
        if self.plugin is None or (used == 0 and hides == self.hides):
            return self.integrator
        key = used, hides
        if key not in self._copies:
            # What `direct` sees in a mirror are emitters: light paths of length one.
            plugin = "path" if self.plugin in ("direct", "direct_projective") else self.plugin
            depth = -1 if self.max_depth is None else self.max_depth - used
            parameters = {"max_depth": depth, "rr_depth": self.rr_depth, "hide_emitters": hides}
            self._copies[key] = mi.load_dict({"type": plugin, **parameters})
        return self._copies[key]


def random_numbers(seed: int, lanes: int) -> Any:
    """Return a sampler of independent random numbers."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, lanes)
    return sampler


def channel_mean(radiance: Any) -> Any:
    """Return the mean over the channels; `dr.mean` writes the count of lanes into the kernel, anew for every batch."""
    return dr.sum(radiance) / len(radiance)


def sample(integrator: Any, scene: Any, sampler: Any, ray: Any, medium: Any, active: Any) -> Any:
    """Return the unpolarized radiance that an integrator estimates along rays; black where not active."""
    # The unbound method reaches integrators written in C++ and in Python alike.
    radiance, _, *_ = mi.SamplingIntegrator.sample(
        integrator, scene, sampler, mi.RayDifferential3f(ray), medium, active
    )
    return dr.select(active, mi.unpolarized_spectrum(radiance), 0)


def _number(integrator: Any, name: str, default: int) -> int:
    """Read a whole number of an integrator; those written in C++ tell it in words only."""
    value = getattr(integrator, name, None)
    if value is None:
        found = re.search(rf"\b{name} = (\d+)", str(integrator))
        value = found[1] if found else default
    return int(value)
