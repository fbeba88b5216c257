"""The radiance along rays from the main lens into a scene, and its derivatives.

The scene's integrator takes derivatives of radiance to those of parameters by path replay backpropagation (Vicini,
Speierer and Jakob, "Path replay backpropagation: differentiating light paths using constant memory and linear time",
2021), which follows each ray once for its radiance and once more for the derivative.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import InputError

Pair = tuple[Any, Any]

_REPLAYED = {"PathIntegrator": "prb", "VolumetricPathIntegrator": "prbvolpath"}
"""Plugins that find the same radiance as others, and its derivatives; the latter by the names of their classes."""

_ENDLESS = 2**31
"""Lengths of light paths from here on mean that there is no limit."""

_REVERSE_ONLY = "PRBVolpathIntegrator"
"""The class of an integrator that Mitsuba does not differentiate forward."""

_UNATTACHED = "not attached to the AD graph"
"""What Mitsuba says where no parameter that has a gradient counts."""


@dataclass(frozen=True)
class SceneLight:
    """The radiance along rays from the main lens into a scene."""

    # The scene, and the plenoptic sensor that says where the main lens is and when the shutter is open.
    scene: Any
    sensor: Any
    integrator: Any
    # For spectral variants, in nanometres.
    wavelength: float | None = None

    def __call__(
        self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int, wavelengths: list[Any] | None = None
    ) -> list[Any]:
        """Return the radiance along rays from points of the camera frame, by channel or at wavelengths of theirs."""
        sampler, ray = self.rays(point, slope, active, seed, wavelengths)
        found = sample(self.integrator, self.scene, sampler, ray, self.sensor.get_medium(), active)
        return channels(found) if wavelengths is None else list(found)

    def rays(
        self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int, wavelengths: list[Any] | None
    ) -> tuple[Any, Any]:
        """Return random numbers, and rays from points of the camera frame as the scene's integrators take them."""
        to_world = self.sensor.world_transform()
        ray = mi.Ray3f(to_world @ mi.Point3f(*point), to_world @ dr.normalize(mi.Vector3f(*slope, 1)))
        if wavelengths is not None:
            ray.wavelengths = type(ray.wavelengths)(*wavelengths)
        elif self.wavelength is not None:
            ray.wavelengths = self.wavelength
        sampler = random_numbers(seed, dr.width(ray))
        ray.time = self.sensor.shutter_open()
        if self.sensor.shutter_open_time() > 0:
            ray.time += sampler.next_1d(active) * self.sensor.shutter_open_time()
        return sampler, ray


def require_finite(radiance: list[Any], *others: Any) -> None:
    """Evaluate radiances, and others too; refuse radiances of which some are no numbers."""
    finite = dr.all([dr.isfinite(light) for light in radiance], axis=0)
    dr.eval(finite, radiance, others)
    if not dr.all(finite):
        raise InputError("scene: the radiance of some rays is NaN or infinite: all must be finite")


@dataclass(frozen=True)
class LightDerivatives(SceneLight):
    """The derivatives of the radiance along rays; called, it returns those along the tangents of parameters."""

    @classmethod
    def of(cls, light: SceneLight, forward: bool) -> LightDerivatives:
        """Return those of some light."""
        integrator = _differentiable(light.integrator)
        name = type(integrator).__name__
        if forward and (name == _REVERSE_ONLY or mi.is_spectral):
            kind = f"nested {name}" if name == _REVERSE_ONLY else f"variant {mi.variant()}"
            raise InputError(f"{kind}: Mitsuba differentiates it in reverse alone; use dr.backward")
        if name == _REVERSE_ONLY and light.sensor.get_medium() is not None:
            raise InputError(f"nested {name}: it differentiates no light of cameras in a medium")
        return cls(light.scene, light.sensor, integrator, light.wavelength)

    def __call__(
        self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int, wavelengths: list[Any] | None = None
    ) -> list[Any]:
        """Return the change of the radiance along rays; see `SceneLight`."""
        change = self.replay(point, slope, active, seed, wavelengths).differentiate(dr.ADMode.Forward, None)
        change = dr.select(active, change, 0)
        return channels(change) if wavelengths is None else list(change)

    def replay(
        self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int, wavelengths: list[Any] | None = None
    ) -> Replay:
        """Follow rays for their radiance; see `SceneLight`."""
        sampler, ray = self.rays(point, slope, active, seed, wavelengths)
        if self.scene.environment() is None and self.sensor.get_medium() is None:
            active = active & self.scene.ray_test(ray, active)
        dr.eval(active)
        radiance, *_, state = self.integrator.sample(
            mode=dr.ADMode.Primal, sampler=sampler.clone(), state_in=None, δL=None, **_options(self.scene, ray, active)
        )
        require_finite(list(radiance), state)
        return Replay(self.scene, self.integrator, sampler, ray, active, state)


@dataclass(frozen=True)
class Replay:
    """Rays whose light paths are known."""

    # As the integrator has taken them.
    scene: Any
    integrator: Any
    sampler: Any
    ray: Any
    # Which of them meet anything: others bring no light.
    active: Any
    # What the integrator has found.
    state: Any

    def differentiate(self, mode: Any, cotangent: Any) -> Any:
        """Follow the same light paths once more; return, forward, the change of their radiance."""
        try:
            change, *_ = self.integrator.sample(
                mode=mode,
                sampler=self.sampler,
                state_in=self.state,
                δL=cotangent,
                **_options(self.scene, self.ray, self.active),
            )
        except Exception as error:
            # Loops wrap what is raised in them.
            if _UNATTACHED in f"{error} {error.__cause__}":
                raise InputError("scene: its light does not depend on the parameters with a gradient") from None
            raise
        # Gradients are added before the next rays start.
        dr.eval(change)
        return change


def _options(scene: Any, ray: Any, active: Any) -> dict[str, Any]:
    """Return what integrators take for all ways to follow rays."""
    return {"scene": scene, "ray": ray, "active": active, "depth": mi.UInt32(0), "δaovs": None}


def _differentiable(integrator: Any) -> Any:
    """Return the integrator that differentiates the radiance which another one finds."""
    if mi.is_polarized:
        raise InputError(f"variant {mi.variant()}: scene parameters have no gradients in polarized variants")
    if isinstance(integrator, mi.ad.integrators.common.RBIntegrator):
        return integrator
    name = type(integrator).__name__ if type(integrator).__module__ != "mitsuba" else integrator.class_name()
    if name not in _REPLAYED:
        raise InputError(f"nested {name}: scene parameters have no gradients through it; use path, volpath or prb")
    # What is written in C++ has these parameters in words alone.
    depths = {key: int(value) for key, value in re.findall(r"\b(max_depth|rr_depth) = (\d+)", str(integrator))}
    if depths["max_depth"] >= _ENDLESS:
        depths["max_depth"] = -1
    return mi.load_dict({"type": _REPLAYED[name], **depths, "hide_emitters": integrator.hide_emitters})


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
