"""The gradients of all coefficients of the main lens's aberrations at once.

A path is linear in them, with the Zernike polynomials for factors. So the gradients follow from the moments of the
path's gradient over the pupil, which are one product of matrices: sums over all samples, one for each coefficient,
would take several times longer than all else that is differentiated.
"""

from __future__ import annotations

import itertools
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...bounds import WAVEFRONT_UNIT
from ...lenses.wavefront import Wavefront, zernike
from ...optics.phase import in_millimetres
from ...runtime.backend import backend

_BLOCK = 2**14
"""Samples of which the powers are made at a time."""


def varying_path(coefficients: Any, radius: float, x: Any, y: Any) -> Any:
    """Return what the change of coefficients adds to the path at points of the pupil: zero, with gradients."""
    return dr.custom(_VaryingPath, coefficients, radius, dr.detach(x), dr.detach(y))


class _VaryingPath(dr.CustomOp):
    """A sum of Zernike polynomials with coefficients that are zero except for their changes."""

    def eval(self, coefficients: Any, radius: float, x: Any, y: Any) -> Any:
        self._count, self._radius, self._points = len(coefficients), radius, (x, y)
        return dr.zeros(type(x), dr.width(x))

    def forward(self) -> None:
        changes = np.asarray(self.grad_in("coefficients").numpy(), np.float64)
        kind = type(self._points[0])
        some = [dr.opaque(kind, change) for change in changes[: np.flatnonzero(changes).max(initial=-1) + 1].tolist()]
        self.set_grad_out(Wavefront(some, self._radius).path(*self._points) + dr.zeros(kind, dr.width(self._points[0])))

    def backward(self) -> None:
        gradient, x, y = (backend().to_host(backend().from_drjit(part)) for part in (self.grad_out(), *self._points))
        found = np.array(_gradients(self._count, gradient, x, y, self._radius))
        self.set_grad_in("coefficients", type(self.grad_in("coefficients"))(found))

    def name(self) -> str:
        return "aberrations"


def _gradients(count: int, gradient: NDArray[Any], x: NDArray[Any], y: NDArray[Any], radius: float) -> list[float]:
    """Return the sums over the samples of each polynomial times the gradient of the path."""
    polynomials = [zernike(j) for j in range(1, count + 1)]
    size = max(len(polynomial) for polynomial in polynomials)
    moments = np.zeros((size, size))
    for first in range(0, len(gradient), _BLOCK):
        block = slice(first, first + _BLOCK)
        moments += (_powers(x[block] / radius, size) * gradient[block]) @ _powers(y[block] / radius, size).T
    unit = in_millimetres(WAVEFRONT_UNIT)
    return [unit * float((moments[: len(some), : len(some)] * some).sum()) for some in polynomials]


def _powers(values: NDArray[Any], count: int) -> NDArray[np.float64]:
    """Return the powers 0 ... count - 1 of some values, (count, n)."""
    result = np.ones((count, len(values)))
    for lower, power in itertools.pairwise(result):
        np.multiply(lower, values, out=power)
    return result
