"""Thin elements that fields pass in the source plane of a step: microlenses, and detector light made to converge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ..camera import PlenopticCamera
from ..optics import parabola, phasor, rays
from ..runtime import Array, Field, Pair, Shape, active_backend, drjit_array, fft
from .microlens_orders import MicrolensArray
from .steps import Step
from .transmittance import is_separable, transmission


class Element:
    """Thin element in the source plane of a step: lines along x and y, or a function of x and y, or samples.

    The function takes Dr.Jit arrays. Rows where the line along y is zero are left out.
    """

    def __init__(
        self,
        step: Step,
        function: Callable[[Any, Any], Any] | None = None,
        *,
        along_x: Field | None = None,
        along_y: Field | None = None,
        samples: Field | None = None,
    ):
        self._step = step
        self._function = function
        self._samples = samples
        self.along_x = along_x
        self.along_y = along_y
        self._lit = np.ones(step.y.count, bool) if along_y is None else active_backend().to_host(along_y) != 0

    @classmethod
    def separated(cls, step: Step, function: Callable[[Any, Any], Any], point: Pair) -> Element:
        """Return a product of a function of x and one of y, from its values on two lines through a point.

        Its modulus is 1 at that point.
        """
        x, y = point
        line = _evaluate(np.append(step.x.source, x), np.array([y]), function)[0]
        along_y = _evaluate(np.array([x]), step.y.source, function)[:, 0] * line[-1].conj()
        return cls(step, along_x=line[:-1], along_y=along_y)

    @classmethod
    def by_orders(cls, step: Step, array: MicrolensArray, cosine: float) -> Element:
        """Return the microlenses without the diffraction orders beyond a direction, which the samples would alias."""
        lines = {}
        plane = None
        for factor in array.factors(cosine):
            if len(factor.axes) == 2:
                plane = factor.at
            else:
                places = (step.x, step.y)[factor.axes[0]].source
                line = factor.at(drjit_array(active_backend().types.Float64, places))
                lines[factor.axes[0]] = fft.as_field(fft.pack(line), (len(places),))
        return cls(step, plane, along_x=lines.get(0), along_y=lines.get(1))

    def lit(self, rows: slice) -> list[slice]:
        """Return runs of the rows in which the element transmits light."""
        runs = np.flatnonzero(np.diff(self._lit[rows], prepend=False, append=False)).reshape(-1, 2)
        return [slice(rows.start + first, rows.start + end) for first, end in runs.tolist()]

    def through(self, rows: slice, samples: Field, out: Field) -> None:
        """Write rows of a field, multiplied by all factors but the one along y, to `out`."""
        factor = self.factor(rows)
        if factor is None:
            out[...] = samples
        else:
            active_backend().arrays.multiply(samples, factor, out=out)

    def back(self, rows: slice, samples: Field, scale: float) -> Field:
        """Return rows of a field, multiplied by the conjugates of all factors and by a scale."""
        for factor in (self.factor(rows), None if self.along_y is None else self.along_y[rows, None]):
            samples = samples if factor is None else samples * factor.conj()
        return samples * np.float32(scale)

    def factor(self, rows: slice) -> Any:
        """Return the factors of rows but for the one along y; None if they are 1."""
        if self._samples is not None:
            return self._samples[rows]
        if self._function is None:
            return self.along_x
        return _evaluate(self._step.x.source, self._step.y.source[rows], self._function)


def _evaluate(x: Array, y: Array, function: Callable[[Any, Any], Any]) -> Field:
    """Return a function of two Dr.Jit arrays at all pairs of coordinates."""
    types = active_backend().types
    row, column = fft.rows_and_columns(types, len(y), len(x))
    at = [
        dr.gather(types.Float64, drjit_array(types.Float64, values), index) for values, index in ((x, column), (y, row))
    ]
    return fft.as_field(fft.pack(function(*at)), (len(y), len(x)))


def microlenses(
    step: Step, camera: PlenopticCamera, wavelength: float, interleave: int = 1, subset: Shape = (0, 0)
) -> Element:
    """Return the microlenses of a subset, in the source plane of a step; other lenses are opaque.

    The period of the subset is `interleave` in both lattice indices, and `subset` are the indices' remainders.
    """

    def lens(x: Any, y: Any) -> Any:
        light = transmission(camera, wavelength, x, y)
        return light if interleave == 1 else _of_subset(light, camera.lattice.cell(x, y), interleave, subset)

    if not is_separable(camera):
        return Element(step, lens)
    return Element.separated(step, lens, _centre(camera, subset))


def converging(
    step: Step, camera: PlenopticCamera, wavelength: float, interleave: int = 1, subset: Shape | None = None
) -> Element:
    """Return the element that makes detector light converge to the centres of all lenses, or of a subset."""
    b = camera.mla_distance
    z = camera.reduced_distance

    def phase(x: Any, y: Any) -> Any:
        # Fields are those of a thin lens, whose pupil is in its plane.
        index = camera.lattice.cell(*(rays.chief_point(camera, p) for p in (x, y)))
        cx, cy = camera.lattice.centre(*index)
        light = phasor(parabola((x - cx) ** 2 + (y - cy) ** 2, z, wavelength))
        return light if subset is None else _of_subset(light, index, interleave, subset)

    if not is_separable(camera):
        return Element(step, phase)
    x, y = _centre(camera, subset or (0, 0))
    # Under the lens's own chief ray, so that it belongs to the lens.
    return Element.separated(step, phase, (x * (b + z) / b, y * (b + z) / b))


def _centre(camera: PlenopticCamera, index: Shape) -> Pair:
    """Return the centre of a lens."""
    x, y = camera.lattice.centre(*map(float, index))
    return float(x), float(y)


def _of_subset(light: Any, index: Pair, interleave: int, subset: Shape) -> Any:
    """Return light with the contributions of lenses outside the subset set to 0."""
    period = dr.opaque(type(index[0]), interleave)
    mine = [
        i - period * dr.floor((i + 0.5) / period) == dr.opaque(type(i), remainder)
        for i, remainder in zip(index, subset, strict=True)
    ]
    return dr.select(mine[0] & mine[1], light, 0)
