r"""Derivatives of captures by signed rays, by what a scene's radiance depends on: textures, emitters, BSDFs, media.

A capture is linear in the radiances of its rays, so that its change is the same sum of the changes of these. In
reverse, with the correlations :math:`J_n` of a figure's gradient and the kernels, the figure changes with the radiance
of ray k of N through a cell and lens by

.. math:: g_k = \frac{1}{N} \left[ w_k A_n(m_k, P_k)\, J_n + \frac{1}{N_h}
          \sum_{j \notin h} \left( J_0 - w_j A_n(m_j, P_j)\, J_n \right) \right] ,

of which the second part is that of the mean c which the ray's half h of the rays, :math:`N_h` of them, gives the other
half. What nodes of wavelengths mix of a ray's values into a channel is linear, too, and is transposed on the way back.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..camera.vector import Values
from ..runtime.jobs import Job, Task
from .scene_light import LightDerivatives
from .signed_camera import CameraAdjoint, CameraTangents
from .signed_capture import SignedCapture, Sum
from .signed_colours import Lanes, mixed
from .signed_draws import Lot, jitter
from .signed_rays import SignedRaySum


class SignedRayAdjoint(SignedRaySum):
    """The way back through a capture by signed rays; its light is a `LightDerivatives`."""

    def backward(self, gradient: Sequence[NDArray[np.float32]]) -> None:
        """Add to the gradients of parameters what follows from that of the sum, by channel (rows, columns)."""
        for lot, felt in self._back(gradient):
            self._pull(lot, felt)

    def _pull(self, lot: Lot, felt: list[list[Any]]) -> None:
        """Take back what rays of a lot have brought; see `_back`."""
        drawn, own = self._drawn_rays(lot.cells, dr.opaque(mi.UInt32, lot.seed & ~15))
        spp, rays = dr.opaque(mi.UInt32, self._spp), dr.width(own)
        for (pupil, nodes), lanes in zip(self._groups, lot.lanes, strict=True):
            replay = self._light.replay(*self._asked(pupil, drawn, own, lanes, lot.seed))
            # Rays of a cell that meets nothing bring nothing, whatever they would bring.
            meets = dr.select(replay.active, mi.UInt32(1), 0) + dr.zeros(mi.UInt32, rays)
            met = dr.compress(dr.block_sum(meets, self._spp) > 0)
            if not dr.width(met):
                continue
            lane = dr.arange(mi.UInt32, dr.width(met) * self._spp)
            place = dr.gather(mi.UInt32, met, lane // spp) * spp + lane % spp
            cotangent = dr.zeros(mi.Spectrum, rays)
            for value, part in self._cotangents(lot, met, felt, nodes, lanes).items():
                every = dr.zeros(mi.Float, rays)
                dr.scatter(every, part, place)
                cotangent[value] = every
            dr.eval(cotangent)
            replay.differentiate(dr.ADMode.Backward, cotangent)

    def _cotangents(
        self, lot: Lot, met: Any, felt: list[list[Any]], nodes: Sequence[int], lanes: Lanes | None
    ) -> dict[int, Any]:
        """Return by how much the figure changes with values of the radiance of each ray of some of a lot's cells."""
        spp, every = dr.opaque(mi.UInt32, self._spp), dr.opaque(mi.UInt32, lot.cells.box.rows * lot.cells.box.columns)
        cells, key = (
            replace(lot.cells, index=dr.gather(mi.UInt32, lot.cells.index, met)),
            dr.opaque(mi.UInt32, lot.seed & ~15),
        )
        drawn, own = self._drawn_rays(cells, key)
        sample = dr.arange(mi.UInt32, dr.width(own)) - own * spp
        chance = jitter(dr.gather(mi.UInt32, cells.index, own), key ^ (sample << 4))
        # Of each value: by its own ray, and by what rays of the other half bring less where the mean of this one does.
        totals: dict[int, tuple[Any, Any]] = {}
        for number in nodes:
            node = self._nodes[number]
            first = dr.gather(mi.UInt32, lot.first(every, self._values_of(node)), met)
            place = dr.gather(mi.UInt32, first, own)
            values = self._coefficients[number](drawn.point, drawn.inner, chance, drawn.open)
            direct, others = [], []
            for total in felt[number]:
                parts = [dr.gather(mi.Float, total, place + every * n, drawn.open) for n in range(len(values))]
                by_ray = drawn.weight * mixed(values, parts)
                direct.append(dr.select(drawn.open, by_ray, 0))
                others.append(dr.select(drawn.open, (parts[0] - by_ray) * self._known_part, 0))
            used, weights = node.mixture(lanes)
            if lanes is not None:
                each = dr.gather(mi.UInt32, met, own)
                weights = [[dr.gather(mi.Float, weight, each) for weight in row] for row in weights]
            for value, column in zip(used, zip(*weights, strict=True), strict=True):
                before = totals.get(value, (0, 0))
                totals[value] = before[0] + mixed(column, direct), before[1] + mixed(column, others)
        seen = dr.select(drawn.open, mi.Float(1), 0)
        dr.eval(seen, totals)
        (even, odd), *sums = self._halves(seen, [total[1] for total in totals.values()], dr.width(met))[0]
        by_mean = [
            (dr.select(even > 0, of_odd / even, 0), dr.select(odd > 0, of_even / odd, 0)) for of_even, of_odd in sums
        ]
        dr.eval(by_mean)
        is_even, scale = (
            (sample & 1) == 0,
            self._answer(drawn) / mi.Float(dr.opaque(mi.UInt32, self._spp * self._passes)),
        )
        return {
            value: (by_ray + seen * dr.select(is_even, *(dr.gather(mi.Float, half, own) for half in halves))) * scale
            for (value, (by_ray, _)), halves in zip(totals.items(), by_mean, strict=True)
        }


@dataclass(frozen=True)
class SignedGradients:
    """The derivatives of a capture by signed rays, with the same rays as its `compute` draws."""

    capture: SignedCapture
    # The derivatives of its light; None: the light is held.
    light: LightDerivatives | None
    seed: int
    spp: int

    def forward(self, changes: Values) -> NDArray[np.float32]:
        """Return the change of the capture, (rows, columns, channels)."""
        with dr.suspend_grad():
            change = np.zeros((*self.capture.camera.shape, self.capture.colours.spectrum.channels), np.float32)
            if self.light is not None:
                change += self._image(SignedRaySum, self.light)
            if changes:
                change += self._image(partial(CameraTangents, changes=changes))
            for channel, mended in self.capture.mended(self._image(SignedRaySum)).items():
                change[..., channel] = mended.forward(change[..., channel])
        return change

    def backward(self, gradient: NDArray[np.float32], names: Sequence[str]) -> Values:
        """Return the gradients by the camera's parameters; those by the scene's are added to Dr.Jit's.

        Shapes: `gradient` (rows, columns, channels).
        """
        with dr.suspend_grad():
            linear = list(np.moveaxis(gradient, -1, 0))
            for channel, mended in self.capture.mended(self._image(SignedRaySum)).items():
                linear[channel] = mended.backward(linear[channel])
            if self.light is not None:
                self._sum(SignedRayAdjoint, self.light).backward(linear)
            return self._sum(partial(CameraAdjoint, names=names)).backward(linear) if names else {}

    def _sum(self, kind: Callable[..., Sum], light: LightDerivatives | None = None) -> Sum:
        return self.capture.sums(self.spp, self.seed, 1, kind, light)[0]()

    def _image(self, kind: Callable[..., SignedRaySum], light: LightDerivatives | None = None) -> NDArray[np.float32]:
        """Return what a sum of a kind makes of the rays, (rows, columns, channels)."""
        work = self._sum(kind, light)
        items = int(work.items.sum())
        shape = *self.capture.camera.shape, self.capture.colours.spectrum.channels
        return Job().run([Task(items, lambda: work, lambda image: image)], shape, items)
