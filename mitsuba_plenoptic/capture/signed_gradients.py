r"""Derivatives of captures by signed rays, by what a scene's radiance depends on: textures, emitters, BSDFs, media.

A capture is linear in the radiances of its rays, so that its change is the same sum of the changes of these. In
reverse, with the correlations :math:`J_n` of a figure's gradient and the kernels, the figure changes with the radiance
of ray k of N through a cell and lens by

.. math:: g_k = \frac{1}{N} \left[ w_k A_n(m_k, P_k)\, J_n + \frac{1}{N_h}
          \sum_{j \notin h} \left( J_0 - w_j A_n(m_j, P_j)\, J_n \right) \right] ,

of which the second part is that of the mean c which the ray's half h of the rays, :math:`N_h` of them, gives the other
half. Both ways, the scene's integrator takes derivatives of radiance to those of parameters: by path replay
backpropagation (Vicini, Speierer and Jakob, "Path replay backpropagation: differentiating light paths using constant
memory and linear time", 2021), which follows each ray once for its radiance and once more for the derivative.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..runtime.jobs import Job, Task
from .draws import channels
from .negatives import Mended
from .signed_camera import CameraAdjoint, CameraTangents, Values, parameters_of
from .signed_capture import SignedCapture
from .signed_draws import Cells, Pair, jitter
from .signed_rays import SceneLight, SignedRaySum, require_finite

_REPLAYED = {"PathIntegrator": "prb", "VolumetricPathIntegrator": "prbvolpath"}
"""Plugins that find the same radiance as others, and its derivatives; the latter by the names of their classes."""

_ENDLESS = 2**31
"""Lengths of light paths from here on mean that there is no limit."""

_REVERSE_ONLY = "PRBVolpathIntegrator"
"""The class of an integrator that Mitsuba does not differentiate forward."""

_UNATTACHED = "not attached to the AD graph"
"""What Mitsuba says where no parameter that has a gradient counts."""


@dataclass(frozen=True)
class LightDerivatives(SceneLight):
    """The derivatives of the radiance along rays; called, it returns those along the tangents of parameters."""

    @classmethod
    def of(cls, light: SceneLight, forward: bool) -> LightDerivatives:
        """Return those of some light.

        Raises
        ------
        InputError
            If Mitsuba does not differentiate it.
        """
        integrator = _differentiable(light.integrator)
        name = type(integrator).__name__
        if forward and (name == _REVERSE_ONLY or mi.is_spectral):
            kind = f"nested {name}" if name == _REVERSE_ONLY else f"variant {mi.variant()}"
            raise InputError(f"{kind}: Mitsuba differentiates it in reverse alone; use dr.backward")
        if name == _REVERSE_ONLY and light.sensor.get_medium() is not None:
            raise InputError(f"nested {name}: it differentiates no light of cameras in a medium")
        return cls(light.scene, light.sensor, integrator, light.wavelength)

    def __call__(self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int) -> list[Any]:
        """Return the change of the radiance, by channel, along rays from points of the camera frame."""
        change = self.replay(point, slope, active, seed).differentiate(dr.ADMode.Forward, None)
        return channels(dr.select(active, change, 0))

    def replay(self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int) -> Replay:
        """Follow rays from points of the camera frame for their radiance."""
        sampler, ray = self.rays(point, slope, active, seed)
        if self.scene.environment() is None and self.sensor.get_medium() is None:
            active = active & self.scene.ray_test(ray, active)
        dr.eval(active)
        radiance, *_, state = self.integrator.sample(
            mode=dr.ADMode.Primal, sampler=sampler.clone(), state_in=None, δL=None, **_options(self.scene, ray, active)
        )
        dr.eval(radiance, state)
        require_finite(channels(radiance))
        return Replay(self.scene, self.integrator, sampler, ray, active, state)


@dataclass(frozen=True)
class Replay:
    """Rays whose light paths are known.

    Attributes
    ----------
    scene, integrator, sampler, ray
        As the integrator has taken them.
    active : Bool
        Which of them meet anything: others bring no light.
    state : object
        What the integrator has found.
    """

    scene: Any
    integrator: Any
    sampler: Any
    ray: Any
    active: Any
    state: Any

    def backward(self, cotangents: list[Any]) -> None:
        """Add to the gradients of parameters what follows from those of the radiance, by channel, along rays."""
        spectrum = dr.zeros(mi.Spectrum, dr.width(cotangents))
        for number, cotangent in enumerate(cotangents):
            spectrum[number] = cotangent
        self.differentiate(dr.ADMode.Backward, spectrum)

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


class SignedRayAdjoint(SignedRaySum):
    """The way back through a capture by signed rays; its light is a `LightDerivatives`."""

    def backward(self, gradient: Sequence[NDArray[np.float32]]) -> None:
        """Add to the gradients of parameters what follows from that of the sum, by channel (rows, columns)."""
        for cells, first, felt, seed in self.back(gradient):
            self._pull(cells, first, felt, seed)

    def _pull(self, cells: Cells, first: Any, felt: list[Any], seed: int) -> None:
        """Take back what rays of some cells through a lens of each have brought; see `back`."""
        key = dr.opaque(mi.UInt32, seed & ~15)
        drawn, *ray = self._rays(cells, key)
        replay = self._light.replay(*ray, drawn.open, seed)
        lanes = dr.width(first) * self._spp
        # Rays of a cell that meets nothing bring nothing, whatever they would bring.
        meets = dr.select(replay.active, mi.UInt32(1), 0) + dr.zeros(mi.UInt32, lanes)
        met = dr.compress(dr.block_sum(meets, self._spp) > 0)
        if not dr.width(met):
            return
        own = replace(cells, index=dr.gather(mi.UInt32, cells.index, met))
        found = self._cotangents(own, dr.gather(mi.UInt32, first, met), felt, key)
        spp, lane = dr.opaque(mi.UInt32, self._spp), dr.arange(mi.UInt32, dr.width(met) * self._spp)
        place = dr.gather(mi.UInt32, met, lane // spp) * spp + lane % spp
        cotangents = [dr.zeros(mi.Float, lanes) for _ in found]
        for cotangent, part in zip(cotangents, found, strict=True):
            dr.scatter(cotangent, part, place)
        dr.eval(cotangents)
        replay.backward(cotangents)

    def _cotangents(self, cells: Cells, first: Any, felt: list[Any], key: Any) -> list[Any]:
        """Return, for each channel, by how much the figure changes with the radiance of each ray."""
        spp, count = dr.opaque(mi.UInt32, self._spp), dr.width(first)
        every = dr.opaque(mi.UInt32, cells.box.rows * cells.box.columns)
        drawn, *_ = self._rays(cells, key)
        lane = dr.arange(mi.UInt32, count * self._spp)
        own = lane // spp
        sample = lane - own * spp
        chance = jitter(dr.gather(mi.UInt32, cells.index, own), key ^ (sample << 4))
        place, seen = dr.gather(mi.UInt32, first, own), dr.select(drawn.open, mi.Float(1), 0)
        direct, others = [], []
        for total, coefficients in zip(felt, self._coefficients, strict=True):
            values = coefficients(drawn.point, drawn.pupil, chance, drawn.open)
            parts = [dr.gather(mi.Float, total, place + every * number, drawn.open) for number in range(len(values))]
            by_ray = drawn.weight * dr.sum([value * part for value, part in zip(values, parts, strict=True)], axis=0)
            direct.append(dr.select(drawn.open, by_ray, 0))
            # The rays of the other half bring less of what the mean of this one brings already.
            others.append(dr.select(drawn.open, parts[0] - by_ray, 0))
        dr.eval(seen, direct, others)
        ((even, odd), *sums), _ = self._halves(seen, others, count)
        by_mean = [
            (dr.select(even > 0, of_odd / even, 0), dr.select(odd > 0, of_even / odd, 0)) for of_even, of_odd in sums
        ]
        dr.eval(by_mean)
        is_even = (sample & 1) == 0
        return [
            (by_ray + seen * dr.select(is_even, *(dr.gather(mi.Float, half, own) for half in halves))) / mi.Float(spp)
            for by_ray, halves in zip(direct, by_mean, strict=True)
        ]


@dataclass(frozen=True)
class SignedGradients:
    """The derivatives of a capture by signed rays, with the same rays as its `compute` draws.

    Attributes
    ----------
    capture : SignedCapture
        The capture.
    light : LightDerivatives, optional
        The derivatives of its light; None: the light is held.
    seed, spp
        As of its `compute`.
    """

    capture: SignedCapture
    light: LightDerivatives | None
    seed: int
    spp: int

    def forward(self, changes: Values) -> NDArray[np.float32]:
        """Return the change of the capture, (rows, columns, channels).

        Parameters
        ----------
        changes : dict
            Of the camera's parameters, by name. The tangents of the scene's parameters are Dr.Jit's.
        """
        with dr.suspend_grad():
            mended = self._mended()
            change = np.zeros((*self.capture.camera.shape, len(mended)), np.float32)
            if self.light is not None:
                change += self._sum(replace(self.capture, light=self.light), SignedRaySum)
            if changes:
                # What is one number has one change, whatever it stands for.
                start = parameters_of(self.capture.camera)
                parts = {name: part[: len(start[name])] for name, part in changes.items()}
                change += self._sum(self.capture, partial(CameraTangents, changes=parts))
        return np.stack([each.forward(change[..., i]) for i, each in enumerate(mended)], axis=-1)

    def backward(self, gradient: NDArray[np.float32], names: Sequence[str]) -> Values:
        """Return the gradients by the camera's parameters; those by the scene's are added to Dr.Jit's.

        Parameters
        ----------
        gradient : float32 array (rows, columns, channels)
            Of a figure with respect to the capture.
        names : sequence of str
            Of the camera's parameters.
        """
        with dr.suspend_grad():
            linear = [each.backward(gradient[..., i]) for i, each in enumerate(self._mended())]
            if self.light is not None:
                light = replace(self.capture, light=self.light)
                light.sums(self.spp, self.seed, 1, SignedRayAdjoint)[0].backward(linear)
            if not names:
                return {}
            return self.capture.sums(self.spp, self.seed, 1, partial(CameraAdjoint, names=names))[0].backward(linear)

    def _mended(self) -> list[Mended]:
        return self.capture.mended(self._sum(self.capture, SignedRaySum))

    def _sum(self, capture: SignedCapture, kind: Callable[..., SignedRaySum]) -> NDArray[np.float32]:
        """Return what a sum of a kind makes of a capture's rays, (rows, columns, channels)."""
        (work,) = capture.sums(self.spp, self.seed, 1, kind)
        items = int(work.items.sum())
        shape = *capture.camera.shape, work.channels
        return Job().run([Task(items, lambda: work, lambda image: image)], shape, items)


def _differentiable(integrator: Any) -> Any:
    """Return the integrator that differentiates the radiance which another one finds.

    Raises
    ------
    InputError
        If there is none.
    """
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
