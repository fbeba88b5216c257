r"""Plans of a camera whose parameters vary, by expansion about a camera nearby.

A camera that is fitted changes in small steps, and its tables and kernels with it. Instead of computing them at each
step, a capture that is differentiated takes those of a camera nearby and their changes: with x the relative change of a
parameter on which kernels depend, and q the logarithm of the ratio of the pupil's diffraction width to the pitch,

.. math:: \varphi_n(x) \approx \varphi_n + x\, \varphi_n' + \tfrac{1}{2} x^2 \varphi_n'' ,
          \qquad A_n(q) \approx A_n + q\, A_n' ,

with derivatives from differences. The parameters of the camera nearby lie on a grid whose steps are half of the
capture's accuracy, so that they follow from the camera alone. Kernels then miss less than a tenth of the accuracy. The
same derivatives give those of the capture.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np

from ..camera import PlenopticCamera, shortest_parts, with_parts
from ..runtime import Doubles, Floats, Pair, on_all_cores
from .phase_space import PhaseSpace, Table

OF_KERNELS = ("mla_distance", "mla_focal_length", "mla_pitch", "detector_distance", "detector_width")
"""Parameters on which the kernels depend."""

_KERNEL_STEP = 1e-3
_TABLE_STEP = 2e-2
"""Relative steps of finite differences of kernels, and of coefficient tables, whose sampled overlaps need more."""


def nearby(camera: PlenopticCamera, names: Sequence[str], accuracy: float) -> PlenopticCamera:
    """Return the camera whose values of some parameters lie on a grid, nearest to those of a camera."""
    names = [name for name in names if name in OF_KERNELS]
    # The products of changes that an expansion leaves out grow with the number of parameters.
    # 0.5: Relative step of the grid of cameras over the accuracy: at a quarter of 0.01, kernels miss 0.0005 of
    # themselves.
    step = 0.5 * max(accuracy, 1e-3) / max(len(names), 1)
    values = {
        name: np.exp(np.round(np.log(shortest_parts(camera, name)) / step) * step).astype(np.float64) for name in names
    }
    return with_parts(camera, values) if values else camera


class ExpandedPlan(PhaseSpace):
    """Diffraction of a camera, by expansion about the plan of a camera nearby."""

    @staticmethod
    @functools.lru_cache(maxsize=16)
    def about(plan: PhaseSpace, camera: PlenopticCamera) -> ExpandedPlan:
        """Return the plan of a camera near that of `plan`, cached for further captures."""
        return ExpandedPlan.of(camera, plan.wavelength, plan.accuracy, basis=plan)

    def tabulated(self) -> list[Floats]:
        """Return the arrays of the table of coefficients."""
        start = self.start.camera
        camera = self.camera
        ratio = camera.mla_distance / start.mla_distance * start.mla_pitches[0] / camera.mla_pitches[0]
        change = np.float32(math.log(ratio))
        return on_all_cores(lambda row: row[0] + change * row[1], zip(*_tables(self.start), strict=True))

    def kernels(self, step: float, reach: float, kind: int = 0) -> Doubles:
        """Return the kernels of one kind of lenses, with the sampling of those about which they are expanded."""
        total = self.start.kernels(self._start_step(step), self.start.reach, kind).copy()
        for name in OF_KERNELS:
            for component, change in enumerate(self._changes(name)):
                if change:
                    slope, curvature = _kernel_changes(self.start, name, component, self._start_step(step), kind)
                    total += change * slope + change**2 / 2 * curvature
        return total

    def kernel_slopes(self, name: str, step: float, kind: int) -> list[Doubles]:
        """Return the derivatives of kernels by each component of a parameter on which they depend."""
        values = shortest_parts(self.start.camera, name)
        slopes = []
        for component, change in enumerate(self._changes(name)):
            slope, curvature = _kernel_changes(self.start, name, component, self._start_step(step), kind)
            slopes.append((slope + change * curvature) / values[component])
        return slopes

    def _start_step(self, step: float) -> float:
        return step * self.start.camera.detector_width / self.camera.detector_width

    def _changes(self, name: str) -> list[float]:
        """Return the relative changes of a parameter's components."""
        return (shortest_parts(self.camera, name) / shortest_parts(self.start.camera, name) - 1).tolist()


@functools.lru_cache(maxsize=4)
def _tables(plan: PhaseSpace) -> tuple[list[Floats], list[Floats]]:
    """Return a plan's table, and its derivatives by the logarithm of the pupil's diffraction width."""
    distance = plan.camera.mla_distance
    sides = [
        plan.moved(plan.camera.replace(mla_distance=distance * (1 + side))).tabulated()
        for side in (_TABLE_STEP, -_TABLE_STEP)
    ]
    return plan.tabulated(), [(a - b) / np.float32(2 * _TABLE_STEP) for a, b in zip(*sides, strict=True)]


@functools.lru_cache(maxsize=4)
def width_slopes(start: PhaseSpace) -> Table:
    """Return the table of derivatives of a plan's coefficients by the logarithm of the pupil's diffraction width."""
    table = Table(start.shapes)
    table.fill(_tables(start)[1])
    return table


@functools.lru_cache(maxsize=32)
def _kernel_changes(plan: PhaseSpace, name: str, component: int, step: float, kind: int) -> Pair:
    """Return the first and second derivatives of kernels by the relative change of a parameter's component."""
    samples = plan.waves.kernel_samples(step, plan.reach, kind)
    sides = []
    for change in (_KERNEL_STEP, -_KERNEL_STEP):
        if name == "detector_width":
            sides.append(plan.sampled_kernels(step * (1 + change), samples, kind))
            continue
        values = shortest_parts(plan.camera, name)
        values[component] *= 1 + change
        sides.append(plan.moved(with_parts(plan.camera, {name: values})).sampled_kernels(step, samples, kind))
    middle = plan.kernels(step, plan.reach, kind)
    return (sides[0] - sides[1]) / (2 * _KERNEL_STEP), (sides[0] - 2 * middle + sides[1]) / _KERNEL_STEP**2
