r"""The field on the microlens array of a point on the axis: a function of the radius alone.

The first Rayleigh-Sommerfeld integral (Goodman, "Introduction to Fourier Optics", section 3.5) over the exit pupil,

.. math:: u(r) = \frac{1}{i \lambda} \int U(\rho) \, \rho \, d\rho \int \frac{b}{R^2} e^{i k R} \, d\theta,
          \qquad R^2 = b^2 + \rho^2 + r^2 - 2 \rho r \cos\theta.

The integral over the angle is a Bessel function of half the difference of the shortest and the longest R, times the
phase of their mean: exact in both stationary points, with an error of amplitude of :math:`\rho r / b^2` between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...optics.lens_system import LensSystem
from ...optics.main_lens import UniformLens, main_lens
from ...optics.phase import in_millimetres

_PER_WAVE = 12
"""Samples along the radius over the finest period of the field's modulus, :math:`\\lambda b / D_1`."""

_FARTHEST = 1e9
"""Distance of a point whose vergence is that of infinity, in millimetres."""


@dataclass(frozen=True)
class RadialFields:
    r"""Fields of points on the axis, without the curvature of their wavefronts.

    Attributes
    ----------
    step : float
        Distance of samples along the radius, in millimetres.
    samples : complex128 array (points, samples)
        Each field times :math:`e^{-i \pi r^2 c / \lambda}`, c its curvature.
    curvature : float64 array (points,)
        Of the wavefront on the microlens array by rays near the axis, in 1/mm.
    """

    step: float
    samples: NDArray[np.complex128]
    curvature: NDArray[np.float64]

    @classmethod
    def of(
        cls, camera: PlenopticCamera, wavelength: float, distances: NDArray[np.float64], reach: float
    ) -> RadialFields:
        """Compute the fields of points at some distances, up to a radius."""
        lens, lam = main_lens(camera), in_millimetres(wavelength)
        a, b = float(lens.pupil_radius), float(lens.pupil_distance)
        factor = defocus(lens, distances)
        nodes = 64 + math.ceil(2 * math.pi / lam * a * (reach + a * float(np.abs(factor).max())) / b)
        rho, weight = scipy.special.roots_legendre(nodes)
        rho, weight = a / 2 * (rho + 1), a / 2 * weight
        pupil, points = (rho[:, None], np.zeros((nodes, 1))), (0.0, 0.0, distances)
        sources = lens.amplitude(pupil, points) * np.exp(2j * math.pi * lens.path(pupil, points, wavelength))
        sources = sources * (2 * math.pi * weight * rho)[:, None]
        step = lam * b / (2 * a) / _PER_WAVE
        r = np.arange(math.ceil(reach / step) + 2) * step
        samples = np.empty((len(distances), len(r)), np.complex128)
        for start in range(0, len(r), 512):
            part = r[start : start + 512, None]
            near, far = ((b * b + (rho + sign * part) ** 2) ** 0.5 for sign in (-1, 1))
            mean, half = (near + far) / 2, 2 * rho * part / (near + far)
            kernel = scipy.special.j0(2 * math.pi / lam * half) * np.exp(2j * math.pi / lam * (mean - b))
            samples[:, start : start + 512] = ((kernel * (b / (1j * lam * mean**2))) @ sources).T
        curvature = (1 - 1 / factor) / b
        samples *= np.exp(-1j * math.pi / lam * curvature[:, None] * r**2)
        return cls(step, samples, curvature)


def defocus(lens: UniformLens, distances: Any) -> Any:
    """Return the places of rays from the axis on the microlens array over those on the pupil, :math:`1 - b v`."""
    return 1 - lens.pupil_distance * lens.vergence(distances)


def distance_of(lens: UniformLens | LensSystem, vergence: Any) -> Any:
    """Return the distance of the scene points whose images have these vergences; what is beyond infinity is there.

    To a lens without power all light with an image comes converging: its points lie behind the lens.
    """
    nearness = lens.vergence(math.inf) - vergence
    if lens.vergence(math.inf) <= 1 / _FARTHEST:
        return 1 / nearness
    return 1 / np.maximum(nearness, 1 / _FARTHEST)


def axial_ray(lens: UniformLens, rho: Any, distances: Any) -> tuple[Any, Any]:
    """Return where on the array the ray of an axial point through a pupil radius arrives, and the field's modulus.

    The modulus is that of geometric optics, by the area that rays take on the pupil and on the array. Beyond the rim,
    where rays may meet before the array, both go on as they are at the rim.
    """

    def land(radius: Any) -> Any:
        s = lens.cosines((radius, 0.0), (0.0, 0.0, distances))[0]
        return radius + lens.pupil_distance * s / np.sqrt(1 - s * s)

    step = 1e-4 * float(lens.pupil_radius)
    inner = np.clip(rho, step, lens.pupil_radius)
    place = land(inner)
    along, across = (land(inner + step) - land(inner - step)) / (2 * step), place / inner
    amplitude = lens.amplitude((inner, 0.0), (0.0, 0.0, distances))
    return place + along * (rho - inner), amplitude / np.sqrt(np.abs(along * across))
