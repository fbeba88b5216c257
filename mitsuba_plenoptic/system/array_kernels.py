r"""Diffraction by the microlens array: kernels of a capture's images, and the polynomials over a lens.

Behind the array, of transmission T in units of the lens that the ray meets, a ray that meets it at m lands on the
detector at an offset p from the position of the ray model, with the signed density

.. math:: K_a(m, p) = \frac{1}{(\lambda z)^2}
          \int T(m + \xi/2)\, T^*(m - \xi/2)\, e^{-2 \pi i \xi \cdot p / \lambda z}\, d^2\xi.

Pairs of points in two neighbouring lenses are included: they describe the interference of the neighbours' fields.
Projected on polynomials :math:`P_n` of m that are orthonormal over the aperture, :math:`K_a(m, p) \approx \sum_n a_n(m)
\varphi_n(p)`. Coordinates of microlens points are relative to the centre of the lens.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..lattice import Lattice
from ..optics.waves import in_millimetres
from ..runtime.limits import single_threaded_blas
from .lens_kinds import Kind, LensKinds
from .microlenses import aperture_points

_TRANSFER_SAMPLES = 64
"""Samples across a lens for its transfer functions: the phase between neighbours changes by a fifth of a period."""

_KEPT = 2.0
"""Samples per cycle of the highest frequency of a lens's diffraction; two samples represent it completely."""

SPECTRUM_SAMPLES = 256
"""Samples across a lens for the Fourier coefficients of its polynomials."""

MOST_PHASE = 8.0
"""Largest defocus in radians at a lens's edge for which polynomials describe where rays land."""


@dataclass(frozen=True)
class ArrayKernels:
    """Diffraction of one camera's microlenses at one wavelength, as kernels of images."""

    # A camera whose detector is near the microlenses' focus; one with glass is taken `at_wavelength`.
    camera: PlenopticCamera
    wavelength: float
    # Total degree of the polynomials over a lens, of which there are (degree + 1) (degree + 2) / 2.
    degree: int = 4
    # Shortest wavelength of the plans with which it is used, whose rays must land alike. Default: its own wavelength.
    shortest: float | None = None

    @property
    def defocus(self) -> float:
        """Largest defocus of the microlenses' waves on the detector, in radians at the edge of a lens."""
        square = float(self.lattice.aperture_reach) ** 2
        most = max(abs(self.convergence(kind)) for kind in self.kinds)
        return math.pi * most * square / in_millimetres(self.wavelength)

    @property
    def aberration(self) -> float:
        """Difference of the shape of lenses from the parabola by which rays land, in radians at the edge of a lens.

        It is that of the slopes, since a phase may have jumps.
        """
        shape, lattice, (focal_length, *_) = self.camera.mla_shape, self.lattice, self.camera.reduced_focal_lengths
        assert shape is not None
        u, v = lattice.to_frame(*aperture_points(lattice))
        strength = shape.strength(self.wavelength)
        slopes = (s * strength + place / focal_length for s, place in zip(shape.slopes(u, v), (u, v), strict=True))
        most = float(np.hypot(*slopes).max())
        return math.pi * most * float(lattice.aperture_reach) / in_millimetres(self.wavelength)

    @property
    def by_points(self) -> bool:
        """Whether each ray lands by its own point of the lens, and not by the lens's centre.

        Far from the microlenses' focus polynomials do not describe the difference. The spread by the pupil is then
        taken as that of the whole pupil for all of its points.
        """
        return self.defocus * self.wavelength / (self.shortest or self.wavelength) > MOST_PHASE

    @property
    def lattice(self) -> Lattice:
        """The microlens lattice."""
        return self.camera.lattice

    @cached_property
    def kinds(self) -> list[Kind]:
        """The kinds of microlenses."""
        return LensKinds(self.camera).every

    @cached_property
    def exponents(self) -> list[tuple[int, int]]:
        """Powers of u and v of the monomial that each polynomial adds to the previous ones."""
        return [(i, total - i) for total in range(self.degree + 1) for i in range(total, -1, -1)]

    def aperture_grid(self, samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return coordinates of a grid around a lens, in the frame of the lattice, and a mask of its aperture."""
        reach = float(self.lattice.cell_reach)
        count = 2 * math.ceil(reach * samples / self.lattice.pitches[0])
        step = self.lattice.pitches[0] / samples
        along = (np.arange(count) + 0.5 - count / 2) * step
        v, u = np.meshgrid(along, along, indexing="ij")
        return u, v, np.asarray(self.lattice.in_aperture(*self.lattice.from_frame(u, v)))

    @cached_property
    def triangle(self) -> NDArray[np.float64]:
        """Coefficients of the orthonormal polynomials in monomials of u and v over the pitch, by Gram-Schmidt."""
        u, v, inside = self.aperture_grid(SPECTRUM_SAMPLES)
        monomials = self._monomials(u[inside], v[inside])
        gram = monomials.T @ monomials / len(monomials)
        return np.linalg.inv(np.linalg.cholesky(gram)).T

    def _monomials(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        pitch = self.lattice.pitches[0]
        return np.stack([(u / pitch) ** i * (v / pitch) ** j for i, j in self.exponents], axis=-1)

    def polynomials(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values of the polynomials, which are orthonormal over the aperture."""
        return self._monomials(u, v) @ self.triangle

    def mirrored(self, values: Sequence[Any], across: Any, up: Any) -> list[Any]:
        """Return the values of polynomials at positions mirrored along u, along v, or both."""
        signs = dr.select(across, -1.0, 1.0), dr.select(up, -1.0, 1.0)
        return [
            value * (signs[0] if i % 2 else 1.0) * (signs[1] if j % 2 else 1.0)
            for (i, j), value in zip(self.exponents, values, strict=False)
        ]

    def kernels(self, step: float, reach: float, kind: int = 0) -> NDArray[np.float64]:
        """Return the kernels (n, k, k) of a kind of lenses on a grid of some step, times the area of a grid cell.

        They reach at least to `reach`. Light beyond is folded back, which conserves the energy.
        """
        key = step, reach, kind
        if key not in self._kept:
            if self.by_points:
                self._kept[key] = self._cell_kernels(step, reach, self.kinds[kind])
            else:
                self._kept[key] = self.sampled_kernels(step, self.kernel_samples(step, reach, kind), kind)
        return self._kept[key]

    @cached_property
    def _kept(self) -> dict[tuple[float, float, int], NDArray[np.float64]]:
        return {}

    def kernel_samples(self, step: float, reach: float, kind: int = 0) -> tuple[int, int, int]:
        """Return the sampling of `kernels`: lag step in fine steps, and numbers of lags and samples on either side."""
        scale = in_millimetres(self.wavelength) * self.kinds[kind].distance
        fine = self.lattice.pitches[0] / _TRANSFER_SAMPLES
        every = max(1, int(scale / (2 * fine * reach)))
        # Pairs in neighbouring lenses are less than two cell widths apart; the grid resolves half a cycle per step.
        farthest = int(min(2 * _TRANSFER_SAMPLES, scale / (2 * step * fine))) // every
        return every, farthest, math.ceil(scale / (2 * fine * every * step) - 0.5)

    @single_threaded_blas()
    def sampled_kernels(self, step: float, samples: tuple[int, int, int], kind: int = 0) -> NDArray[np.float64]:
        """Return `kernels` with a given sampling, even if another one would suit them better."""
        scale = in_millimetres(self.wavelength) * self.kinds[kind].distance
        fine = self.lattice.pitches[0] / _TRANSFER_SAMPLES
        every, farthest, count = samples
        transfer = self._transfer(np.arange(-farthest, farthest + 1) * every, self.kinds[kind])
        place, lags = np.arange(-count, count + 1) * step, np.arange(-farthest, farthest + 1) * (every * fine)
        waves = np.exp(-2j * np.pi * np.outer(place, lags) / scale) * (every * fine * step / scale)
        return np.einsum("yb,nba,xa->nyx", waves, transfer, waves, optimize=True).real

    def spots(self, along: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the diffraction patterns (types, n, n) of single lenses, at detector positions along both axes."""
        u, v, inside = self.aperture_grid(_TRANSFER_SAMPLES)
        wavelength = in_millimetres(self.wavelength)
        made = []
        for kind in self.kinds[: len(self.camera.mla_focal_lengths)]:
            scale = wavelength * kind.distance
            waves = np.exp(-2j * np.pi * np.outer(along, u[0]) / scale)
            phase = self.convergence(kind) * (u * u + v * v) / (2 * wavelength)
            if self.camera.mla_shape is not None:
                phase = phase + self._beyond_parabola(u, v, kind)
            field = waves @ np.where(inside, np.exp(2j * np.pi * phase), 0) @ waves.T
            made.append(np.abs(field) ** 2 * (u[0, 1] - u[0, 0]) ** 2 / (inside.sum() * scale**2))
        return np.stack(made)

    def _cell_kernels(self, step: float, reach: float, kind: Kind) -> NDArray[np.float64]:
        r"""Return kernels between cells over which light is uniform, and which may be larger than the kernels.

        Without neighbours and phase the integral over pairs of points is a sum of products: that of
        :math:`m^i = 2^{-i} \sum_a \binom{i}{a} x_1^a x_2^{i-a}` is a sum of products of transforms of aperture times
        power.
        """
        lattice, scale = self.lattice, in_millimetres(self.wavelength) * kind.distance
        parts = math.ceil(_KEPT * step * float(lattice.aperture_width) / scale)
        count = math.ceil(reach / step)
        fine, far = step / parts, (count + 1) * parts - 1
        x, y, _ = self.aperture_grid(SPECTRUM_SAMPLES)
        along, spacing = x[0], x[0, 1] - x[0, 0]
        inside = lattice.in_aperture(x, y)
        u, v = (place / lattice.pitches[0] for place in lattice.to_frame(x, y))
        waves = np.exp(-2j * np.pi * np.outer(np.arange(-far, far + 1) * fine, along) / scale)
        fields = {(a, b): waves @ np.where(inside, u**a * v**b, 0) @ waves.T for a, b in self.exponents}
        products = []
        for i, j in self.exponents:
            both = np.zeros(fields[0, 0].shape)
            for a, b in itertools.product(range(i + 1), range(j + 1)):
                weight = math.comb(i, a) * math.comb(j, b) / 2 ** (i + j)
                both += weight * (fields[a, b] * fields[i - a, j - b].conj()).real
            products.append(both)
        kernels = np.einsum("mn,myx->nyx", self.triangle, products) * (spacing * fine / scale) ** 2 / inside.sum()
        tent = np.convolve(np.ones(parts), np.ones(parts)) / parts
        for axis in (1, 2):
            kernels = np.apply_along_axis(np.convolve, axis, kernels, tent, "valid")
        return kernels[:, ::parts, ::parts]

    def convergence(self, kind: Kind) -> float:
        """Return the wavefront curvature behind a lens for a pupil point, less that for focus on the detector."""
        # Waves from a point of an objective's stop are plane.
        own = self.camera.lens_data.converges / self.camera.pupil_distance
        return 1 / kind.distance + own - 1 / kind.focal_length

    def _beyond_parabola(self, u: NDArray[np.float64], v: NDArray[np.float64], kind: Kind) -> NDArray[np.float64]:
        """Return the phase of a lens in waves without that of the parabola by which rays land."""
        shape = self.camera.mla_shape
        assert shape is not None
        ratio = kind.focal_length / self.camera.reduced_focal_lengths[kind.lens_type]
        parabola = (u * u + v * v) / (2 * in_millimetres(self.wavelength) * kind.focal_length)
        return np.asarray(shape.waves(u, v, self.wavelength) / ratio + parabola)

    def _transfer(self, lags: NDArray[np.int64], kind: Kind) -> NDArray[np.complex64]:
        """Return the integrals of polynomial times T T* over a cell at given lags in steps, the same along x and y."""
        lattice, camera = self.lattice, self.camera
        wavelength = in_millimetres(self.wavelength)
        step = lattice.pitches[0] / _TRANSFER_SAMPLES
        half = math.ceil(lattice.cell_reach / step)
        # The grid has half steps: with a lag of whole steps, both points of a pair lie on it.
        reach = 2 * half + int(lags[-1]) + 1
        along = np.arange(-reach, reach + 1) * (step / 2)
        y, x = np.meshgrid(along, along, indexing="ij")
        # Lens types alternate along a row.
        centre = lattice.centre(float(kind.lens_type), 0.0)
        i, j = lattice.cell(x + centre[0], y + centre[1])
        cx, cy = (c - c0 for c, c0 in zip(lattice.centre(i, j), centre, strict=True))
        # Neighbours are assumed to deviate as the lens itself does.
        powers = camera.mla_focal_lengths[kind.lens_type] / kind.focal_length / np.array(camera.mla_focal_lengths)
        types = lattice.lens_type(i, j).astype(int) if len(powers) > 1 else np.zeros(i.shape, int)
        phase = ((x * x + y * y) * powers[kind.lens_type] - ((x - cx) ** 2 + (y - cy) ** 2) * powers[types]) / (
            2 * wavelength
        )
        if not self.by_points:
            # A quadratic phase shifts the landing point in proportion to the position on the lens.
            phase += self.convergence(kind) * (x * x + y * y) / (2 * wavelength)
        if camera.mla_shape is not None:
            phase += self._beyond_parabola(*lattice.to_frame(x - cx, y - cy), kind)
        inside = lattice.in_aperture(x - cx, y - cy)
        T = np.where(inside, np.exp(2j * np.pi * phase), 0).astype(np.complex64)
        # Polynomials are undefined outside the aperture, where rays have no coefficients.
        own = np.asarray((i == kind.lens_type) & (j == 0) & inside, np.float32)
        # Points on a border belong half to either side.
        weights = self.polynomials(*lattice.to_frame(x, y)) * ((own + own[::-1, ::-1]) / 2)[..., None]
        result = np.zeros((len(self.exponents), len(lags), len(lags)), np.complex64)
        middle = len(lags) // 2
        for row, b in enumerate(lags[middle:].tolist(), middle):
            for odd in range(2):
                (places,) = np.nonzero((lags + odd) % 2 == 0)
                if not len(places):
                    continue
                # Midpoints at whole steps, between samples of T, within the cell including its border.
                rows, columns = (reach + 1 - each % 2 + 2 * np.arange(-half, half + 1) for each in (b, odd))
                weight = weights[np.ix_(rows, columns)].reshape(-1, len(self.exponents)).astype(np.float32)
                index = (columns + lags[places, None])[:, None]
                product = T[(rows + b)[:, None], index] * T[(rows - b)[:, None], index[::-1]].conj()
                product = product.reshape(len(places), -1)
                result[:, row, places] = ((product.real @ weight) + 1j * (product.imag @ weight)).T
        # The weights are real.
        result[:, :middle] = result[:, :middle:-1, ::-1].conj()
        # The normalisation uses the sampled open area, which conserves the energy.
        return np.asarray(result / result[0, middle, middle].real)
