"""The derivatives of the light of radiators by a scene's parameters: their light paths, replayed.

This is path replay backpropagation (Vicini, Speierer and Jakob, "Path replay backpropagation: differentiating light
paths using constant memory and linear time", 2021), Mitsuba's integrator ``prb``: the paths are followed once to find
their radiance, and once more to differentiate it. Rays from the camera, and hence the radiators' places, are held.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .child import Child, random_numbers
from .draws import channels
from .radiators import Radiators
from .sight import Sight

_LANES = 2**20
"""Light paths that are replayed at once."""

_UNATTACHED = "not attached to the AD graph"
"""What Mitsuba says where no parameter that has a gradient counts."""


def replaying(child: Child) -> Any:
    """Return the integrator that replays a child's light paths.

    Raises
    ------
    InputError
        If there is none.
    """
    if mi.is_polarized:
        raise InputError(f"variant {mi.variant()}: scene parameters have no gradients in polarized variants")
    if child.plugin == "prb":
        return child.integrator
    if child.plugin != "path":
        name = child.plugin or type(child.integrator).__name__
        raise InputError(f"nested {name}: scene parameters have no gradients through it; use path or prb")
    depth = -1 if child.max_depth is None else child.max_depth
    return mi.load_dict({"type": "prb", "max_depth": depth, "rr_depth": child.rr_depth, "hide_emitters": child.hides})


@dataclass(frozen=True)
class Replay:
    """Light paths of radiators that are differentiated, forward and in reverse.

    Attributes
    ----------
    sight : Sight
        The scene.
    integrator : mitsuba.SamplingIntegrator
        As from `replaying`.
    spp : int
        Light paths for each radiator.
    seed : int
        Of their random numbers.
    """

    sight: Sight
    integrator: Any
    spp: int
    seed: int

    @classmethod
    def of(cls, sight: Sight, spp: int, seed: int) -> Replay:
        """Prepare the replay of a scene's light paths.

        Raises
        ------
        InputError
            If the scene or its integrator has something that cannot be replayed.
        """
        if not sight.optics.plain:
            raise InputError(
                "scene: no gradients by its parameters with mirrors, glass, masks, media or hidden emitters"
            )
        return cls(sight, replaying(sight.optics.child), spp, seed)

    def forward(self, radiators: Radiators) -> NDArray[np.float64]:
        """Return the change (n, channels) of the radiance with the tangents of the scene's parameters."""
        changes = np.zeros(radiators.radiance.shape)
        for some, sampler, ray in self._batches(radiators):
            change = self._replay(dr.ADMode.Forward, sampler, ray, None)
            for column, value in enumerate(channels(mi.unpolarized_spectrum(change))):
                changes[some, column] = dr.block_sum(value, self.spp).numpy() / self.spp
        return changes

    def backward(self, radiators: Radiators, cotangents: NDArray[np.float64]) -> None:
        """Add to the gradients of the scene's parameters what follows from those (n, channels) of the radiance."""
        for some, sampler, ray in self._batches(radiators):
            values = np.repeat(cotangents[some] / self.spp, self.spp, axis=0).T.astype(np.float32)
            spectrum = dr.zeros(mi.Spectrum, values.shape[1])
            for column, value in enumerate(values):
                spectrum[column] = mi.Float(value)
            self._replay(dr.ADMode.Backward, sampler, ray, spectrum)

    def _batches(self, radiators: Radiators) -> Iterator[tuple[slice, Any, Any]]:
        """Yield radiators, random numbers and rays, `spp` neighbouring lanes for each."""
        count = max(1, _LANES // self.spp)
        for number, start in enumerate(range(0, len(radiators.pupil), count)):
            some = slice(start, min(start + count, len(radiators.pupil)))
            pupil, position = radiators.pupil[some], radiators.positions[some]
            slope = (position[:, :2] - pupil) / position[:, 2:]
            x, y, u, v = (
                mi.Float(np.repeat(part, self.spp).astype(np.float32)) for part in np.hstack([pupil, slope]).T
            )
            seed = int(np.random.SeedSequence([self.seed, number]).generate_state(1)[0])
            ray, _ = self.sight.ray((x, y, 0.0), (u, v))
            yield some, random_numbers(seed, dr.width(x)), ray

    def _replay(self, mode: Any, sampler: Any, ray: Any, cotangent: Any) -> Any:
        scene, active = self.sight.optics.scene, mi.Bool(True)
        options = {"scene": scene, "ray": ray, "active": active}
        with dr.suspend_grad():
            *_, state = self.integrator.sample(
                mode=dr.ADMode.Primal, sampler=sampler.clone(), state_in=None, δL=None, **options
            )
            try:
                change, *_ = self.integrator.sample(mode=mode, sampler=sampler, state_in=state, δL=cotangent, **options)
            except Exception as error:
                if _UNATTACHED in str(error):
                    raise InputError("scene: its light does not depend on the parameters with a gradient") from None
                raise
            # The next batch must not start before the gradients of this one have been added.
            dr.eval(change)
        return change
