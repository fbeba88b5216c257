r"""Derivatives of captures by signed rays, by what a scene's radiance depends on: textures, emitters, BSDFs, media.

A capture is linear in the radiances of its rays, so that its change is the same sum of the changes of these. In reverse,
with the correlations :math:`J_n` of a figure's gradient and the kernels, the figure changes with the radiance of ray k of
N through a cell and lens by

.. math:: g_k = \frac{1}{N} \left[ w_k A_n(m_k, P_k)\, J_n + \frac{1}{N_h}
          \sum_{j \notin h} \left( J_0 - w_j A_n(m_j, P_j)\, J_n \right) \right] ,

of which the second part is that of the mean c which the ray's half h of the rays, :math:`N_h` of them, gives the other
half. Both ways, the scene's integrator takes derivatives of radiance to those of parameters: by path replay
backpropagation (Vicini, Speierer and Jakob, "Path replay backpropagation: differentiating light paths using constant
memory and linear time", 2021), which follows each ray once for its radiance and once more for the derivative.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..runtime.jobs import Job, Task
from .draws import channels
from .negatives import Mended
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
        change = self._replay(dr.ADMode.Forward, *self.rays(point, slope, active, seed), active, None)
        return channels(dr.select(active, change, 0))

    def backward(
        self, point: tuple[Any, Any, Any], slope: Pair, active: Any, seed: int, cotangents: list[Any]
    ) -> None:
        """Add to the gradients of parameters what follows from those of the radiance, by channel, along rays."""
        spectrum = dr.zeros(mi.Spectrum, dr.width(cotangents))
        for number, cotangent in enumerate(cotangents):
            spectrum[number] = cotangent
        self._replay(dr.ADMode.Backward, *self.rays(point, slope, active, seed), active, spectrum)

    def _replay(self, mode: Any, sampler: Any, ray: Any, active: Any, cotangent: Any) -> Any:
        options = {"scene": self.scene, "ray": ray, "depth": mi.UInt32(0), "active": active}
        radiance, *_, state = self.integrator.sample(
            mode=dr.ADMode.Primal, sampler=sampler.clone(), state_in=None, δL=None, δaovs=None, **options
        )
        dr.eval(radiance, state)
        require_finite(channels(radiance))
        try:
            change, *_ = self.integrator.sample(
                mode=mode, sampler=sampler, state_in=state, δL=cotangent, δaovs=None, **options
            )
        except Exception as error:
            if _UNATTACHED in str(error):
                raise InputError("scene: its light does not depend on the parameters with a gradient") from None
            raise
        # Gradients are added before the next rays start.
        dr.eval(change)
        return change


class SignedRayAdjoint(SignedRaySum):
    """The way back through a capture by signed rays; its light is a `LightDerivatives`."""

    def backward(self, gradient: Sequence[NDArray[np.float32]]) -> None:
        """Add to the gradients of parameters what follows from that of the sum, by channel (rows, columns)."""
        for number, bins in enumerate(self._blocks):
            seeds = np.random.SeedSequence([self._seed, number])
            felt = [
                mi.Float(np.concatenate([image.ravel() for image in convolution.adjoint(channel, bins)]))
                for convolution, channel in zip(self._convolutions, gradient, strict=True)
            ]
            cells = dr.arange(mi.UInt32, bins.rows * bins.columns)
            for some, kind, own, seed in self._lots(bins, cells, seeds):
                self._pull(own, some, kind, felt, seed)

    def _pull(self, cells: Cells, some: Any, kind: Any, felt: list[Any], seed: int) -> None:
        """Take back what rays of some cells through a lens of each have brought; `felt` is it by kernel and cell."""
        spp, key = dr.opaque(mi.UInt32, self._spp), dr.opaque(mi.UInt32, seed & ~15)
        every = dr.opaque(mi.UInt32, cells.box.rows * cells.box.columns)
        drawn, *ray = self._rays(cells, key)
        lane = dr.arange(mi.UInt32, dr.width(some) * self._spp)
        own = lane // spp
        sample = lane - own * spp
        even = (sample & 1) == 0
        chance = jitter(dr.gather(mi.UInt32, cells.index, own), key ^ (sample << 4))
        seen = dr.select(drawn.open, mi.Float(1), 0)
        counts = self._halves(seen, even)
        cotangents = []
        for total, coefficients in zip(felt, self._coefficients, strict=True):
            values = coefficients(drawn.point, drawn.pupil, chance, drawn.open)
            first = dr.gather(mi.UInt32, some + every * (kind * len(values)), own)
            parts = [dr.gather(mi.Float, total, first + every * number, drawn.open) for number in range(len(values))]
            direct = drawn.weight * dr.sum([value * part for value, part in zip(values, parts, strict=True)], axis=0)
            direct = dr.select(drawn.open, direct, 0)
            # The rays of a half give their mean to those of the other half.
            through_mean = self._halves(parts[0] * seen - direct, even)
            shares = [
                dr.select(count > 0, given / count, 0) for count, given in zip(counts, through_mean[::-1], strict=True)
            ]
            dr.eval(shares)
            share = dr.select(even, *(dr.gather(mi.Float, share, own) for share in shares))
            cotangents.append((direct + share * seen) / mi.Float(spp))
        dr.eval(cotangents)
        self._light.backward(*ray, drawn.open, seed, cotangents)

    def _halves(self, values: Any, even: Any) -> list[Any]:
        """Return the sums over the rays of even and of odd numbers of each cell."""
        return [dr.block_sum(dr.select(even == side, values, 0), self._spp) for side in (True, False)]


@dataclass(frozen=True)
class SignedGradients:
    """The derivatives of a capture by signed rays.

    Attributes
    ----------
    capture : SignedCapture
        The capture.
    seed, spp
        As of its `compute`.
    """

    capture: SignedCapture
    seed: int
    spp: int

    def forward(self) -> NDArray[np.float32]:
        """Return the change of the capture, (rows, columns, channels), with the tangents of the scene's parameters."""
        light = LightDerivatives.of(self.capture.light, forward=True)
        with dr.suspend_grad():
            mended, change = self._mended(), self._sum(light)
        return np.stack([each.forward(change[..., i]) for i, each in enumerate(mended)], axis=-1)

    def backward(self, gradient: NDArray[np.float32]) -> None:
        """Add to the gradients of the scene's parameters what follows from that of the capture."""
        light = LightDerivatives.of(self.capture.light, forward=False)
        with dr.suspend_grad():
            linear = [each.backward(gradient[..., i]) for i, each in enumerate(self._mended())]
            (work,) = replace(self.capture, light=light).sums(self.spp, self.seed, 1, SignedRayAdjoint)
            work.backward(linear)

    def _mended(self) -> list[Mended]:
        return self.capture.mended(self._sum(self.capture.light))

    def _sum(self, light: SceneLight) -> NDArray[np.float32]:
        """Return the sum of the rays, (rows, columns, channels), whose light is another one."""
        (work,) = replace(self.capture, light=light).sums(self.spp, self.seed, 1, SignedRaySum)
        items = int(work.items.sum())
        shape = *self.capture.camera.shape, work.channels
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
