r"""Diffraction by the pupil of an ordinary camera, in phase space: functions of a ray's pupil point, and kernels.

Without a microlens array a ray that passes the pupil at P and would land on the detector at m lands at m + x, with the
signed density

.. math:: K_p(P, x) = \frac{1}{(\lambda b)^2} \int t(P + \eta/2)\, t^*(P - \eta/2)\,
          e^{-2 \pi i \eta \cdot x / \lambda b}\, d^2\eta ,

where t is the transmission of the pupil, aberrations included (`phase_space`). With polynomials :math:`a_n` that are
orthonormal over the pupil, the first of which is 1, :math:`K_p(P, x) \approx \sum_n a_n(P)\, \varphi_n(x)`, and a
capture is a ray capture of a few values per ray followed by one convolution for each,

.. math:: I = \sum_n \varphi_n * \sum_{rays} L\, a_n(P), \qquad \varphi_n(x) = \int a_n(P)\, K_p(P, x)\, d^2P .

The first kernel is the point spread function in focus, which is therefore exact. Light from other distances varies with
P; where it does so faster than the polynomials, defocus has already averaged out what diffraction would change.

As P is the middle of two points of the pupil, :math:`P^i = 2^{-i} \sum_a \binom{i}{a} x_1^a x_2^{i-a}`, the kernels are
sums of products of the transforms of t times powers.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mitsuba as mi
import numpy as np
import scipy
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..optics.waves import in_millimetres
from ..runtime.limits import require_memory, single_threaded_blas
from .lens_functions import LensFunctions
from .lens_kinds import Kind
from .oblique import Oblique
from .optical_system import OpticalSystem

_DEGREES = 4, 6
"""Degrees of the polynomials over the pupil, of usual and of finer plans."""

_SAMPLES = 256
"""Samples of the transmission across the pupil."""

_HIGHEST = 2.0
"""Highest frequency of an image on the detector, the cut-off, in cycles per lambda b / R."""

_REACH = 24.0
"""Half the width of the kernels in lambda b / R: 0.4 % of the Airy pattern is beyond, and is spread over the kernel."""


@dataclass(frozen=True)
class PupilDiffraction:
    """Diffraction of one ordinary camera at one wavelength, as functions over the pupil and kernels of images."""

    camera: PlenopticCamera
    wavelength: float
    fine: bool = False

    @cached_property
    def system(self) -> OpticalSystem:
        return OpticalSystem(self.camera, self.wavelength)

    @property
    def unit(self) -> float:
        """Width of the pupil's diffraction on the detector, lambda b / R, in millimetres: 1.64 radii of the Airy disc."""
        return in_millimetres(self.wavelength) * self.camera.pupil_distance / self.camera.pupil_radius

    @cached_property
    def _pupil(self) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
        """Coordinates along the pupil over its radius, and its transmission, on a square around it."""
        along = (np.arange(_SAMPLES) + 0.5) * (2 / _SAMPLES) - 1
        y, x = np.meshgrid(along, along, indexing="ij")
        return along, np.where(np.hypot(x, y) <= 1, 1 + 0j, 0)

    @cached_property
    @single_threaded_blas()
    def functions(self) -> LensFunctions:
        """Polynomials of a ray's pupil point over the pupil's radius."""
        along, transmission = self._pupil
        v, u = (each[transmission != 0] for each in np.meshgrid(along, along, indexing="ij"))
        return LensFunctions.polynomials(u, v, _DEGREES[self.fine], 1.0)

    @single_threaded_blas()
    def fields(self, places: NDArray[np.float64]) -> dict[tuple[int, int], NDArray[np.complex128]]:
        """Return transforms of transmission times powers, at detector places in `unit` along both axes."""
        along, transmission = self._pupil
        waves = np.exp(-2j * np.pi * np.outer(places, along))
        return {
            (a, b): waves @ (transmission * along**a * along[:, None] ** b) @ waves.T
            for a, b in self.functions.exponents
        }

    def sampled(self, step: float, count: int) -> NDArray[np.float64]:
        """Return the kernels (n, k, k) at `count` samples on either side, `step` units apart, times their area."""
        fields, products = self.fields(np.arange(-count, count + 1) * step), []
        for i, j in self.functions.exponents:
            both = np.zeros((2 * count + 1,) * 2)
            for a, b in itertools.product(range(i + 1), range(j + 1)):
                weight = math.comb(i, a) * math.comb(j, b) / 2 ** (i + j)
                both += weight * (fields[a, b] * fields[i - a, j - b].conj()).real
            products.append(both)
        spacing = 2 / _SAMPLES
        power = (np.abs(self._pupil[1]) ** 2).sum() * spacing**2
        # P = (x1 + x2) / 2 has the density of x1 and x2 eightfold
        kernels = np.einsum("mn,myx->nyx", self.functions.combined, products) * (spacing**4 * step**2 / power)
        whole = np.eye(len(kernels))[0]
        return kernels + ((whole - kernels.sum((1, 2))) / (2 * count + 1) ** 2)[:, None, None]
