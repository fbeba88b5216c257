r"""Functions over the open and the closed parts of a coded aperture, and their kernels, fitted to planes of any blur.

Light of two open points of a pupil interferes as a ray through their middle P (`pupil_diffraction`), which may be
closed. Some rays therefore pass closed parts. Functions :math:`f_n` are polynomials times the density of the open
parts, the first of which is this density itself, and polynomials times a density over the closed parts. For an image
frequency :math:`\eta`, kernels have to represent

.. math:: w_\eta(P) = t(P + \eta/2)\, t^*(P - \eta/2) \approx \sum_n f_n(P)\, \hat\varphi_n(\eta)

for light that varies over the pupil like :math:`e^{2 \pi i v \cdot P}`. A plane with a blur of :math:`\beta` units has
:math:`v = \beta \eta`, and occluders add small v of all directions. The cells of an aperture make :math:`w_\eta` rough,
so that few functions cannot be near it everywhere. Its integrals along lines are few enough numbers, however, and the
integrals of the functions, across which the cells lie differently, are independent. Least squares over a list of blurs
and of small v find :math:`\hat\varphi_n`, with the noise of rays as a penalty (ridge regression: Hoerl and Kennard,
Technometrics 12, 55 (1970)). The first kernel is the point spread function in focus, which is therefore exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy
from numpy.typing import NDArray

from ..runtime import Doubles, Pair, Shape, drjit_array, monomials, on_all_cores, single_threaded_blas
from .accuracy import USUAL
from .lens_functions import edge_covariance, even_polynomials
from .pupil_samples import PupilSamples, along, means, spread_points

CLOSED = 0.25
"""Part of the rays that pass closed parts of pupils that have some between open ones."""

_SAMPLES = 128
"""Samples across the pupil."""

_AREA = (2 / _SAMPLES) ** 2
"""Area of a sample."""


@dataclass(frozen=True)
class PupilFunctions:
    """Polynomials of a ray's pupil point, times the open and the closed share of the rays there."""

    # Powers of x and y of the monomials of each share.
    exponents: list[Shape]
    # Coefficients (monomials of all shares, functions).
    combined: Doubles

    scale = 1.0

    @property
    def count(self) -> int:
        """Number of functions."""
        return self.combined.shape[1]

    def values(self, x: Doubles, y: Doubles, shares: Doubles) -> Doubles:
        """Return the values (points, functions) at points, whose shares are an array (shares, points)."""
        terms = np.stack(monomials(x, y, self.exponents), -1)
        return np.concatenate([share[:, None] * terms for share in shares], 1) @ self.combined


class FittedPupil:
    """Functions and kernels of one pupil of any shape, with polynomials of some degree."""

    @single_threaded_blas()
    def __init__(self, samples: PupilSamples, degree: int):
        self._aperture = samples.aperture
        self._degree = degree
        self._transmission = means(samples.transmission, _SAMPLES)
        power = means(samples.power, _SAMPLES)
        self._whole = power.sum()
        size = (2 * _SAMPLES,) * 2
        pairs = scipy.fft.irfft2(scipy.fft.rfft2(means(abs(samples.transmission), _SAMPLES), size) ** 2, size)[::2, ::2]
        # Rays with the root of the mean square of the light that they bring have the least noise. Samples that the
        # circle cuts are left out.
        farthest = abs(along(_SAMPLES)) + 1 / _SAMPLES
        within = np.hypot(farthest, farthest[:, None]) <= 1
        middles = np.where(within, np.sqrt(np.maximum(pairs - 1e-9 * pairs.max(), 0)), 0)
        closed = middles * (1 - power / power.max())
        some = closed.sum() > USUAL.least_closed * middles.sum()
        # Densities (n, n) of open and, if rays have to pass some, of closed parts; their integrals are 1.
        densities = np.stack([density / (density.sum() * _AREA) for density in ([power, closed] if some else [power])])
        # Density (n, n) of rays through closed parts, or None without such rays. As large a part of them is beyond the
        # circle as of the rays through open cells, some of which the circle cuts.
        self.closed: Doubles | None = None
        # Density (n, n) of all rays, and the shares (shares, n, n) that the parts have: their density over it.
        self._density = densities[0]
        if some:
            passed = samples.whole / (math.pi * samples.aperture.share)
            self.closed = passed * densities[1]
            self.closed[0, 0] = max(1 - passed, 0) / _AREA
            self._density = (1 - CLOSED) * densities[0] + CLOSED * densities[1]
        self._shares = densities / np.where(self._density > 0, self._density, 1)
        # Middle and half width, along x and y, of the box around the open parts.
        lit = [np.flatnonzero(densities[0].any(axis)) for axis in (0, 1)]
        ends = [
            (2 * int(along_axis[0]) / _SAMPLES - 1, 2 * int(along_axis[-1] + 1) / _SAMPLES - 1) for along_axis in lit
        ]
        self._box = [((low + high) / 2, (high - low) / 2) for low, high in ends]
        # The functions: the first has an integral of 1 over all rays, and the others of 0.
        sets = even_polynomials([self._boxed(*spread_points(density)) for density in densities], degree)
        combined = scipy.linalg.block_diag(*(functions.triangle for functions in sets))
        count = len(sets[0].exponents)
        # Rays through closed parts bring nothing of uniform light.
        combined[0, count::count] -= 1
        self.functions = PupilFunctions(sets[0].exponents, combined)

    def arguments(self, x: Any, y: Any) -> list:
        """Return, for pupil points over the radius, Dr.Jit arrays of which rays' functions are made.

        They are the coordinates in the box around the open parts, and the shares of open and of closed parts.
        """
        places = self._boxed(x, y)
        if self.closed is None:
            return list(places)
        column, row = (
            dr.clip(mi.Int(dr.floor((coordinate + 1) * (_SAMPLES / 2))), 0, _SAMPLES - 1) for coordinate in (x, y)
        )
        closed = dr.gather(mi.Float, drjit_array(mi.Float, self.closed.ravel()), mi.UInt32(row * _SAMPLES + column))
        densities = self._aperture.power(x, y) / (math.pi * self._aperture.share), closed
        density = (1 - CLOSED) * densities[0] + CLOSED * densities[1]
        return [*places, *(dr.select(density > 0, share_of_density / density, 0) for share_of_density in densities)]

    def _boxed(self, x: Any, y: Any) -> Pair:
        """Return coordinates in the box around the open parts, from -1 to 1."""
        boxed = [(coordinate - middle) / half for coordinate, (middle, half) in zip((x, y), self._box, strict=True)]
        return boxed[0], boxed[1]

    @cached_property
    def covariance(self) -> Doubles:
        """Covariance of the functions' integrals over light with random edges."""
        x, y = (coordinate[:: USUAL.fitted_every] for coordinate in spread_points(self._density))
        column, row = (((coordinate + 1) * (_SAMPLES / 2)).astype(int) for coordinate in (x, y))
        values = self.functions.values(*self._boxed(x, y), self._shares[:, row, column])
        return edge_covariance(values, x, y, 1.0)

    def kernels(self, places: Doubles) -> Doubles:
        """Return the kernels (functions, n, n) after the first, at places in lambda b / R along both axes."""
        y, x = _frequencies()
        along_y, along_x = (np.exp(-2j * np.pi * np.outer(places, frequency)) for frequency in (y, x))
        # The other half plane of frequencies has the conjugate spectrum.
        combined = ((along_y * np.where(y > 0, 2, 1)) @ self._spectra @ along_x.T).real / USUAL.unit_frequencies**2
        fall = (np.hypot(places, places[:, None]) / (USUAL.unit_frequencies / 2) - USUAL.taper) / (1 - USUAL.taper)
        return combined * np.cos(np.pi / 2 * np.clip(fall, 0, 1)) ** 2

    @cached_property
    def _spectra(self) -> NDArray[np.complex128]:
        """Spectra (functions, rows, columns) at `_frequencies` of the kernels after the first, by least squares."""
        x = along(_SAMPLES)
        u, v = self._boxed((x + 0 * x[:, None]).ravel(), (x[:, None] + 0 * x).ravel())
        values = self.functions.values(u, v, self._shares.reshape(len(self._shares), -1))
        weighted = values * (self._density.ravel() * _AREA)[:, None]
        noise = USUAL.noise_weight * (values.T @ weighted)[1:, 1:]
        images = np.ascontiguousarray(np.swapaxes(weighted.reshape(_SAMPLES, _SAMPLES, -1), 1, 2), np.complex64)
        lights = _lights(USUAL.tilt_limit * (self._degree + 1))
        frequencies = _frequencies()
        weight = np.sqrt([light.weight for light in lights])

        def seen(light: _Light) -> tuple[NDArray[np.complex64], ...]:
            """Return the integrals of the functions, and of w for the light and for its conjugate."""
            waves = [
                np.exp(2j * np.pi * np.outer(light.blur * frequency + tilt, x)).astype(np.complex64)
                for frequency, tilt in zip(frequencies, (light.y, light.x), strict=True)
            ]
            rows = (waves[0] @ images.reshape(_SAMPLES, -1)).reshape(-1, _SAMPLES) @ waves[1].T
            opposite = _Light(-light.blur, -light.x, -light.y)
            return rows.reshape(len(waves[0]), -1, len(waves[1])), self._light_of(light), self._light_of(opposite)

        integrals = on_all_cores(seen, lights)
        spread = self._light_of(_Light(0.0, 0.0, 0.0))

        def fitted(row: int) -> NDArray[np.complex128]:
            """Return the spectra (functions, columns) of a row of frequencies."""
            functions, ahead, behind = (
                np.stack([integral[row] for integral in of_lights]) for of_lights in zip(*integrals, strict=True)
            )
            ahead = ahead - functions[:, 0] * spread[row]
            behind = behind - functions[:, 0].conj() * spread[row]
            others = np.moveaxis(functions[:, 1:], 2, 0).transpose(0, 2, 1) * weight
            # Functions are real, so that their integrals with the conjugate light are conjugate.
            model = np.concatenate([others.real, others.imag], 2)
            target = np.concatenate([weight * (ahead + behind).T, -1j * weight * (ahead - behind).T], 1) / 2
            solution = np.linalg.solve(model @ model.transpose(0, 2, 1) + noise, model @ target[..., None])
            return solution[..., 0].T

        return np.stack(on_all_cores(fitted, range(len(frequencies[0]))), 1)

    def _light_of(self, light: _Light) -> NDArray[np.complex64]:
        """Return the integrals of w with light that varies over the pupil, at `_frequencies`."""
        x = along(_SAMPLES)
        size = (2 * _SAMPLES,) * 2
        bent = self._transmission * np.exp(1j * np.pi * light.blur * (x**2 + x[:, None] ** 2))
        tilted = np.exp(1j * np.pi * (light.x * x + light.y * x[:, None]))
        first, second = (scipy.fft.fft2(light_field, size) for light_field in (bent * tilted, bent * tilted.conj()))
        steps = [np.round(frequency * _SAMPLES / 2).astype(int) for frequency in _frequencies()]
        correlation = scipy.fft.ifft2(first * second.conj())[np.ix_(*steps)]
        return np.asarray(correlation / self._whole, np.complex64)


class _Light(NamedTuple):
    """Light that varies over the pupil, and to which kernels are fitted."""

    # Blur in lambda b / R, and v without it.
    blur: float
    x: float
    y: float
    weight: float = 0.0


def _lights(steepest: float) -> list[_Light]:
    """Return the light of each pair of opposite blurs, and of opposite v up to the steepest."""
    most = math.floor(steepest / USUAL.tilt_step)
    steps = USUAL.tilt_step * np.arange(-most, most + 1)
    tilts = [(x, y) for x in steps for y in steps if (y, x) > (0, 0) and math.hypot(x, y) <= steepest]
    blurs = USUAL.widest_blur * (np.arange(1, USUAL.fitted_blurs + 1) / USUAL.fitted_blurs) ** 2
    return [
        *(_Light(float(blur), 0.0, 0.0, (1 - USUAL.tilt_weight) / USUAL.fitted_blurs) for blur in blurs),
        *(_Light(0.0, float(x), float(y), USUAL.tilt_weight / len(tilts)) for x, y in tilts),
    ]


def _frequencies() -> tuple[Doubles, Doubles]:
    """Return the frequencies of images along y, of half of the plane, and along x, in R / lambda b and below 2."""
    most = 2 * USUAL.unit_frequencies - 1
    return np.arange(most + 1) / USUAL.unit_frequencies, np.arange(-most, most + 1) / USUAL.unit_frequencies
