"""The radiance along rays from the main lens into a scene, and its derivatives.

Radiance is differentiated with respect to scene parameters by path replay backpropagation (Vicini, Speierer and Jakob,
"Path replay backpropagation: differentiating light paths using constant memory and linear time", 2021), which traces
each ray once for its radiance and once more for the derivative.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

import drjit as dr
import mitsuba as mi
import numpy as np

from ..camera import micrometres
from ..design import depth_ranges
from ..errors import InputError, advice, refuse_if, warn
from ..runtime import Named, Pair, Triple

_REPLAYED = {"PathIntegrator": "prb", "VolumetricPathIntegrator": "prbvolpath"}
"""For the class names of integrators, the plugins that find the same radiance and its derivatives."""

_REVERSE_ONLY = "PRBVolpathIntegrator"
"""The class of an integrator that Mitsuba does not differentiate forward."""


_FILM_RULE = "a capture needs pixel_format 'luminance' or 'rgb'"


@dataclass(frozen=True)
class SceneLight:
    """The radiance along rays from the main lens into a scene."""

    # The scene, and the plenoptic sensor, whose transform and shutter times the rays have.
    scene: Any
    sensor: Any
    integrator: Any
    # Wavelength of all rays in nanometres, for spectral variants.
    wavelength: float | None = None

    is_radiance: ClassVar[bool] = True
    """Whether calls return the radiance of a scene, which is not negative."""

    def __call__(self, point: Triple, slope: Pair, active: Any, seed: int, wavelengths: list | None = None) -> list:
        """Return the radiance along rays from points in the camera frame, by channel or at each ray's wavelengths.

        It has no gradients, which `LightDerivatives` has.
        """
        with dr.suspend_grad():
            sampler, ray = self.rays(point, slope, active, seed, wavelengths)
            sampled = sample(self.integrator, self.scene, sampler, ray, self.sensor.get_medium(), active)
        return channels(sampled) if wavelengths is None else list(sampled)

    def rays(self, point: Triple, slope: Pair, active: Any, seed: int, wavelengths: list | None) -> Pair:
        """Return a sampler, and the rays from points in the camera frame as Mitsuba rays in the world frame."""
        ray = world_ray(self.sensor, point, slope)
        if wavelengths is not None:
            ray.wavelengths = type(ray.wavelengths)(*wavelengths)
        elif self.wavelength is not None:
            ray.wavelengths = self.wavelength
        sampler = random_numbers(seed, dr.width(ray))
        if self.sensor.shutter_open_time() > 0:
            ray.time += sampler.next_1d(active) * self.sensor.shutter_open_time()
        return sampler, ray


def require_seen(integrator: Any, sensor: mi.Sensor) -> None:
    """Refuse integrators that render nothing, or something else, by a plenoptic sensor, which Mitsuba finds too late.

    Scenes are refused as they are loaded, since Mitsuba hides what is raised while it renders.
    """
    nested = getattr(integrator, "child", integrator)
    if not isinstance(nested, mi.SamplingIntegrator):
        refuse_light_tracing()
    refuse_if(
        type(nested).__name__ == _REVERSE_ONLY and sensor.get_medium() is not None,
        f"nested {_REVERSE_ONLY}: Mitsuba's prbvolpath ignores the medium around the camera; use volpath",
    )
    film = sensor.film()
    if hasattr(film, "require_outputs"):
        film.require_outputs(nested.aov_names())
    if nested is not integrator:
        require_film(film)


def refuse_light_tracing() -> NoReturn:
    """Refuse integrators that trace light from the emitters to the sensor."""
    raise InputError(
        "plenoptic: light tracing (an integrator such as ptracer) cannot reach the detector through the lenses; use "
        "path or direct"
    )


def require_film(film: Any) -> None:
    """Refuse films with an alpha channel, or in colours other than red, green and blue."""
    channels = film.base_channels_count()
    refuse_if(channels not in (1, 3), f"film: it has {channels} channels; {_FILM_RULE}")
    # Films show their pixel format only in their description.
    refuse_if("pixel_format = xyz" in str(film) and channels == 3, f"film: pixel_format = xyz: {_FILM_RULE}")


def world_ray(sensor: Any, point: Triple, slope: Pair) -> Any:
    """Return rays from points in the camera frame as Mitsuba rays in the world frame, at the shutter's opening."""
    to_world = sensor.world_transform()
    ray = mi.Ray3f(to_world @ mi.Point3f(*point), to_world @ dr.normalize(mi.Vector3f(*slope, 1)))
    ray.time = sensor.shutter_open()
    return ray


def require_finite(radiance: list, *others: Any, signed: bool = True) -> None:
    """Evaluate radiances and other arrays together; refuse radiances that are NaN or infinite.

    Unless radiances are `signed`, a considerable negative part, which would be mistaken for noise, is refused, too.
    """
    finite = dr.all([dr.isfinite(light) for light in radiance], axis=0)
    sound = finite if signed else finite & dr.all([light >= 0 for light in radiance], axis=0)
    dr.eval(sound, radiance, others)
    if dr.all(sound):
        return
    refuse_if(not dr.all(finite), "scene: the radiance of some rays is NaN or infinite: all must be finite")
    lack = -sum(float(dr.sum(dr.minimum(value, 0))[0]) for value in radiance)
    refuse_negative(lack, sum(float(dr.sum(dr.abs(value))[0]) for value in radiance))


def refuse_negative(lack: float, light: float) -> None:
    """Refuse negative light, unless it is a small part of all light."""
    # Largest fraction of negative light, for interpolated environments and estimates that fall slightly below zero.
    refuse_if(
        lack > 0.01 * light,
        f"scene: {lack / max(light, 1e-300):.0%} of the light of some rays is negative: captures by waves need "
        "radiance of at least 0",
    )


@dataclass(frozen=True)
class LightDerivatives(SceneLight):
    """Derivatives of the radiance along rays; calling the object differentiates along the parameters' tangents."""

    is_radiance: ClassVar[bool] = False

    @classmethod
    def of(cls, light: SceneLight, forward: bool) -> LightDerivatives:
        """Return the derivatives of a light; refuse integrators and variants that Mitsuba cannot differentiate."""
        if mi.is_polarized:
            raise InputError(f"variant {mi.variant()}: scene parameters have no gradients in polarized variants")
        integrator = light.integrator
        if not isinstance(integrator, mi.ad.integrators.common.RBIntegrator):
            is_native = type(integrator).__module__ == "mitsuba"
            name = integrator.class_name() if is_native else type(integrator).__name__
            refuse_if(
                name not in _REPLAYED,
                f"nested {name}: scene parameters have no gradients through it; use path, volpath or prb",
            )
            # Integrators written in C++ show these parameters only in their description.
            depths = {key: int(value) for key, value in re.findall(r"\b(max_depth|rr_depth) = (\d+)", str(integrator))}
            # 2**31: Path depths from this value on mean that depth is not limited.
            if depths["max_depth"] >= 2**31:
                depths["max_depth"] = -1
            plugin = {"type": _REPLAYED[name], **depths, "hide_emitters": integrator.hide_emitters}
            integrator = mi.load_dict(plugin)
        name = type(integrator).__name__
        if forward and (name == _REVERSE_ONLY or mi.is_spectral):
            kind = f"nested {name}" if name == _REVERSE_ONLY else f"variant {mi.variant()}"
            raise InputError(f"{kind}: Mitsuba differentiates it in reverse alone; use dr.backward")
        if name == _REVERSE_ONLY and light.sensor.get_medium() is not None:
            raise InputError(f"nested {name}: it differentiates no light of cameras in a medium")
        return cls(light.scene, light.sensor, integrator, light.wavelength)

    def __call__(self, point: Triple, slope: Pair, active: Any, seed: int, wavelengths: list | None = None) -> list:
        """Return the change of the radiance along rays; see `SceneLight`."""
        change = self.replay(point, slope, active, seed, wavelengths).differentiate(dr.ADMode.Forward, None)
        change = dr.select(active, change, 0)
        return channels(change) if wavelengths is None else list(change)

    def replay(self, point: Triple, slope: Pair, active: Any, seed: int, wavelengths: list | None) -> Replay:
        """Trace rays for their radiance, and return their state for the derivatives; see `SceneLight`."""
        sampler, ray = self.rays(point, slope, active, seed, wavelengths)
        if self.scene.environment() is None and self.sensor.get_medium() is None:
            active = active & self.scene.ray_test(ray, active)
        dr.eval(active)
        radiance, *_, state = self.integrator.sample(
            mode=dr.ADMode.Primal, sampler=sampler.clone(), state_in=None, δL=None, **_options(self.scene, ray, active)
        )
        require_finite(list(radiance), state)
        growth = None
        if getattr(self.integrator, "srgb_primitives", False):
            # Primitives add up in sRGB, and the sum is converted, of which Mitsuba's derivatives know nothing.
            state = mi.math.linear_to_srgb(state)
            curve = (2.4 / 1.055) * ((dr.maximum(state, 0) + 0.055) / 1.055) ** 1.4
            growth = dr.select(state <= 0.04045, 1 / 12.92, curve)
            dr.eval(state, growth)
        return Replay(self.scene, self.integrator, sampler, ray, active, state, growth)


@dataclass(frozen=True)
class Replay:
    """Traced rays, with the state from which their light paths can be replayed."""

    # The arguments of the integrator when the rays were traced.
    scene: Any
    integrator: Any
    sampler: Any
    ray: Any
    # Mask of the rays that hit a surface; all others carry no light.
    active: Any
    # State that the integrator returned.
    state: Any
    # Derivative of the radiance by that which the integrator differentiates; None if they are the same.
    growth: Any = None

    def differentiate(self, mode: Any, cotangent: Any) -> Any:
        """Return the change of the radiance along replayed light paths, in forward mode."""
        if self.growth is not None and cotangent is not None:
            cotangent = self.growth * cotangent
        try:
            change, *_ = self.integrator.sample(
                mode=mode,
                sampler=self.sampler,
                state_in=self.state,
                δL=cotangent,
                **_options(self.scene, self.ray, self.active),
            )
        except Exception as error:
            # Dr.Jit's loops wrap exceptions that are raised inside them.
            # Mitsuba's message when the light depends on no parameter that has a gradient.
            if "not attached to the AD graph" in f"{error} {error.__cause__}":
                raise InputError(
                    "scene: the light paths that are replayed have no derivative by the parameters with a gradient: "
                    "wave captures have derivatives by radiance, textures and materials, none by positions of lamps; "
                    "capture by rays with the integrator path, or take differences of captures"
                ) from None
            raise
        if self.growth is not None and cotangent is None:
            change = self.growth * change
        # Evaluated so that gradients are accumulated before the next rays are traced.
        dr.eval(change)
        return change


class ReplayedLight:
    """Light of 1 along each ray that hits a surface, whose gradient is propagated by replays of light paths."""

    is_radiance = False

    def __init__(self, light: LightDerivatives):
        self._light = light

    def __call__(self, point: Triple, slope: Pair, active: Any, seed: int, wavelengths: list | None = None) -> list:
        """Return the light along rays, as `SceneLight` does, with gradients."""
        with dr.suspend_grad():
            self._replay = self._light.replay(point, slope, active, seed, wavelengths)
        # What is linear in the light has a gradient that does not depend on the light.
        self._value = mi.Spectrum(dr.select(self._replay.active, mi.Float(1), 0))
        dr.enable_grad(self._value)
        return channels(self._value) if wavelengths is None else list(self._value)

    def propagate(self) -> None:
        """Propagate the gradient of the light that was last asked for to Dr.Jit's gradients of scene parameters."""
        with dr.resume_grad():
            cotangent = dr.grad(self._value)
        dr.eval(cotangent)
        self._replay.differentiate(dr.ADMode.Backward, cotangent)


def _options(scene: Any, ray: Any, active: Any) -> Named:
    """Return the arguments of an integrator's `sample` that are the same in all modes."""
    return {"scene": scene, "ray": ray, "active": active, "depth": mi.UInt32(0), "δaovs": None}


def random_numbers(seed: int, lanes: int) -> Any:
    """Return a seeded sampler of independent random numbers."""
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


def channels(radiance: Any) -> list:
    """Return the channels of a radiance: one in spectral variants, where all lanes have the same wavelength."""
    return [radiance[0]] if mi.is_spectral else list(radiance)


_CHORDS = 32
"""Rays from rim to rim of the main lens that look for surfaces there."""

_SLANT = 1e-4
"""Distance of their ends from the main lens's plane over its radius, so that they cross surfaces in this plane."""


def _touches(scene: Any, sensor: mi.Sensor, radius: float) -> bool:
    """Return whether a surface crosses or covers the main lens."""
    index = dr.arange(mi.Float, _CHORDS)
    ends = []
    # One end goes round evenly, the other by the golden angle, so that the chords' middles fill the lens.
    for angle, slant in ((2 * math.pi / _CHORDS * index, -_SLANT), (2.4 * index, _SLANT)):
        ends.append(sensor.world_transform() @ (radius * mi.Point3f(dr.cos(angle), dr.sin(angle), slant)))
    ray = mi.Ray3f(ends[0], ends[1] - ends[0])
    ray.maxt = 1.0
    return bool(dr.any(scene.ray_test(ray)))


def warn_of_metres(scene: Any, sensor: Any) -> None:
    """Warn if a camera's lengths look like micrometres, a surface touches it, or the scene's look like metres.

    Too near means within the focal length, or nearer than half the nearest distance that refocusing makes sharp. Other
    cameras are not checked.
    """
    camera = getattr(sensor, "camera", None)
    for text in micrometres(camera) if camera is not None else ():
        warn(text)
    box = scene.bbox()
    # An objective sees what is nearer than its focal length.
    if camera is None or not box.valid() or not camera.lens_data.converges:
        return
    to_camera = np.linalg.inv(np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4))
    corners = np.array([np.append(np.ravel(box.corner(index)), 1.0) for index in range(8)]) @ to_camera.T[:, :3]
    farthest = float(corners[:, 2].max())
    reach = camera.aperture_radius
    inside = (corners.min(0) <= reach).all() and (corners.max(0) >= (-reach, -reach, -_SLANT * reach)).all()
    # The walls of a room in metres are inside the lens, too.
    in_metres = _SLANT * reach < farthest < camera.focal_length
    if inside and not in_metres and _touches(scene, sensor, reach):
        warn("a surface touches the camera's main lens, where the rays into the scene start: move one of the two")
        return
    if farthest <= 0:
        return
    ranges = depth_ranges(camera) if camera.refocuses else ()
    sharp = min((distances[0] for distances in ranges if distances), default=0.0)
    if farthest < camera.focal_length:
        where = f"within the main lens's focal length of {camera.focal_length:.4g} mm"
    elif farthest < 0.5 * sharp:
        # Below half of the nearest sharp distance a scene is not just out of focus.
        where = f"and refocusing makes nothing sharp that is nearer than {sharp:.4g} mm"
    else:
        return
    instead = advice(python='load_scene(..., unit="m") scales them', shell="--unit m scales them")
    warn(
        f"the whole scene is nearer than {farthest:.4g} mm, {where}: lengths are taken as millimetres; if the scene's "
        f"are metres, {instead}"
    )
