r"""Diffraction by the microlens array: kernels of a capture's images, and the functions over a lens.

Behind the array, of transmission T in units of the lens that the ray meets, a ray that meets it at m lands on the
detector at an offset p from the position of the ray model, with the signed density

.. math:: K_a(m, p) = \frac{1}{(\lambda z)^2}
          \int T(m + \xi/2)\, T^*(m - \xi/2)\, e^{-2 \pi i \xi \cdot p / \lambda z}\, d^2\xi.

Pairs of points in two neighbouring lenses are included: they describe the interference of the neighbours' fields.
With functions :math:`a_n` of m that are chosen for the camera (`lens_functions`),
:math:`K_a(m, p) \approx \sum_n a_n(m) \varphi_n(p)`. Coordinates of microlens points are relative to the centre of
the lens.
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
from ..runtime.limits import require_memory, single_threaded_blas
from .lens_functions import LensFunctions
from .lens_kinds import Kind, LensKinds
from .microlenses import aperture_points

_TRANSFER_SAMPLES = 64
"""Lags per pitch of lenses' transfer functions. There are twice as many points, whose phases differ by a tenth of a
period between neighbours."""

_KEPT = 2.0
"""Samples per cycle of the highest frequency of a lens's diffraction; two samples represent it completely."""

SPECTRUM_SAMPLES = 256
"""Samples across a lens for the Fourier coefficients of its functions."""

_HIGHER, _COARSE, _LAGS = 4, 48, 16
"""Degrees of the polynomials that are combined above the degree whose polynomials are as many as the functions; points
across an aperture and lags on either side for which the functions are the best."""

REACH = 2.5
"""Distance in microlens pitches to which kernels are computed."""

MOST_PHASE = 8.0
"""Largest defocus in radians at a lens's edge for which functions over the lens describe where rays land."""


@dataclass(frozen=True)
class ArrayKernels:
    """Diffraction of one camera's microlenses at one wavelength, as kernels of images."""

    # A camera whose detector is near the microlenses' focus; one with glass is taken `at_wavelength`.
    camera: PlenopticCamera
    wavelength: float
    # There are at most as many functions over a lens as polynomials of this degree, (degree + 1) (degree + 2) / 2.
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

        Far from the microlenses' focus a few functions do not suffice for the difference. The spread by the pupil is
        then taken as that of the whole pupil for all of its points.
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
    @single_threaded_blas()
    def functions(self) -> LensFunctions:
        """The functions of a ray's point on a lens; polynomials if each ray lands by its own point, or of degree 0."""
        u, v, inside = self.aperture_grid(SPECTRUM_SAMPLES)
        higher = 0 if self.by_points or self.degree == 0 else _HIGHER
        scale = float(self.lattice.aperture_reach)
        polynomials = LensFunctions.polynomials(u[inside], v[inside], self.degree + higher, scale)
        if not higher:
            return polynomials
        u, v, inside = self.aperture_grid(math.ceil(_COARSE * self.lattice.pitches[0] / self.lattice.aperture_width))
        images = np.concatenate(
            [self._images(polynomials, kind) for kind in self.kinds[: len(self.camera.mla_focal_lengths)]], axis=1
        )
        return polynomials.best((self.degree + 1) * (self.degree + 2) // 2, (u[inside], v[inside]), images)

    def _images(self, polynomials: LensFunctions, kind: Kind) -> NDArray[np.float64]:
        """Return the spectra (polynomials, values) of a kind's kernels of polynomials, as pixels record them."""
        scale = in_millimetres(self.wavelength) * kind.distance
        fine = self.lattice.pitches[0] / _TRANSFER_SAMPLES
        farthest = min(2 * _TRANSFER_SAMPLES, int(scale / (2 * self.camera.pixel_size * fine)))
        every = max(1, farthest // _LAGS)
        lags = np.arange(-_LAGS, _LAGS + 1) * every
        weights = np.sinc(lags * (fine * self.camera.pixel_size / scale))
        spectra = self._transfer(_LAGS, every, kind, polynomials, polynomials.functions) * (weights[:, None] * weights)
        return np.concatenate([spectra.real, spectra.imag], axis=1).reshape(len(spectra), -1)

    def aperture_grid(self, samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return coordinates of a grid around a lens, in the frame of the lattice, and a mask of its aperture."""
        reach = float(self.lattice.cell_reach)
        count = 2 * math.ceil(reach * samples / self.lattice.pitches[0])
        step = self.lattice.pitches[0] / samples
        along = (np.arange(count) + 0.5 - count / 2) * step
        v, u = np.meshgrid(along, along, indexing="ij")
        return u, v, np.asarray(self.lattice.in_aperture(*self.lattice.from_frame(u, v)))

    def mirrored(self, values: Sequence[Any], across: Any, up: Any) -> list[Any]:
        """Return the values of the functions at positions mirrored along u, along v, or both."""
        signs = dr.select(across, -1.0, 1.0), dr.select(up, -1.0, 1.0)
        return [
            value * (signs[0] if i else 1.0) * (signs[1] if j else 1.0)
            for (i, j), value in zip(self.functions.odd, values, strict=False)
        ]

    def kernels(self, step: float, reach: float, kind: int = 0) -> NDArray[np.float64]:
        """Return the kernels (n, k, k) of a kind of lenses on a grid of some step, times the area of a grid cell.

        They reach at least to `reach`. Light beyond is folded back, which conserves the energy.
        """
        key = step, reach, kind
        if key not in self._kept:
            self._require_memory(step, reach, kind)
            if self.by_points:
                self._kept[key] = self._cell_kernels(step, reach, self.kinds[kind])
            else:
                self._kept[key] = self.sampled_kernels(step, self.kernel_samples(step, reach, kind), kind)
        return self._kept[key]

    def _require_memory(self, step: float, reach: float, kind: int) -> None:
        """Refuse kernels of pixels far larger than a lens's diffraction, which would not fit into memory."""
        if self.by_points:
            # Transforms of the aperture, their products, and the kernels themselves.
            count, each = 2 * (math.ceil(reach / step) + 1) * self._cell_parts(step, self.kinds[kind]), 32.0
        else:
            count, each = 2 * self.kernel_samples(step, reach, kind)[2] + 1, 8.0
        spot = in_millimetres(self.wavelength) * self.kinds[kind].distance / float(self.lattice.aperture_width)
        require_memory(
            each * self.functions.count * float(count) ** 2,
            f"detector_width = {self.camera.detector_width:g}: pixels of {self.camera.pixel_size:.3g} mm behind lenses "
            f"whose diffraction spreads {self.wavelength:g} nm by {spot:.2g} mm, need kernels of {count} x {count} "
            "samples",
        )

    def _cell_parts(self, step: float, kind: Kind) -> int:
        """Return the count of samples across a cell that resolve a lens's diffraction."""
        scale = in_millimetres(self.wavelength) * kind.distance
        return math.ceil(_KEPT * step * float(self.lattice.aperture_width) / scale)

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
        functions = self.functions
        lags = np.arange(-farthest, farthest + 1) * every
        transfer = self._transfer(farthest, every, self.kinds[kind], functions, functions.duals)
        place = np.arange(-count, count + 1) * step
        waves = np.exp(-2j * np.pi * np.outer(place, lags * fine) / scale) * (every * fine * step / scale)
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
        parts = self._cell_parts(step, kind)
        count = math.ceil(reach / step)
        fine, far = step / parts, (count + 1) * parts - 1
        x, y, _ = self.aperture_grid(SPECTRUM_SAMPLES)
        along, spacing = x[0], x[0, 1] - x[0, 0]
        inside = lattice.in_aperture(x, y)
        functions = self.functions
        u, v = (place / functions.scale for place in lattice.to_frame(x, y))
        waves = np.exp(-2j * np.pi * np.outer(np.arange(-far, far + 1) * fine, along) / scale)
        fields = {(a, b): waves @ np.where(inside, u**a * v**b, 0) @ waves.T for a, b in functions.exponents}
        products = []
        for i, j in functions.exponents:
            both = np.zeros(fields[0, 0].shape)
            for a, b in itertools.product(range(i + 1), range(j + 1)):
                weight = math.comb(i, a) * math.comb(j, b) / 2 ** (i + j)
                both += weight * (fields[a, b] * fields[i - a, j - b].conj()).real
            products.append(both)
        kernels = np.einsum("mn,myx->nyx", functions.combined, products) * (spacing * fine / scale) ** 2 / inside.sum()
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

    def _transfer(
        self, farthest: int, every: int, kind: Kind, polynomials: LensFunctions, coefficients: NDArray[np.float64]
    ) -> NDArray[np.complex64]:
        """Return the integrals of combinations of polynomials, times T T*, over a cell at lags along y and x.

        Along either axis there are `farthest` lags on either side, `every` steps apart. `coefficients` are those of the
        combinations (polynomials, n).
        """
        lattice, camera = self.lattice, self.camera
        wavelength = in_millimetres(self.wavelength)
        # Points lie between the borders of lenses. A lag of whole steps moves both points of a pair to such points.
        step = lattice.pitches[0] / _TRANSFER_SAMPLES / 2
        reach = math.ceil(lattice.cell_reach / step) + farthest * every + 1
        along = (np.arange(-reach, reach) + 0.5) * step
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
        # Functions are undefined outside the aperture, where rays have no coefficients.
        own = (i == kind.lens_type) & (j == 0) & inside
        rows, columns = (np.flatnonzero(own.any(axis)) for axis in (1, 0))
        top, bottom, left, width = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1 - columns[0]
        values = polynomials.values(*(place[own] for place in lattice.to_frame(x, y)))
        # On these samples, too, the integrals are exact for polynomials.
        exact = np.linalg.solve(values.T @ values, coefficients) * len(values)
        weight = np.zeros((*own.shape, coefficients.shape[1]), np.float32)
        weight[own] = values @ exact
        weight = weight[top:bottom, left : left + width].reshape(-1, coefficients.shape[1])
        count, most = 2 * farthest + 1, farthest * every
        result = np.empty((coefficients.shape[1], count, count), np.complex64)
        product = np.empty((count, bottom - top, width), np.complex64)
        # Views (column, row, place) of T, from each column on.
        lines = np.lib.stride_tricks.sliding_window_view(T, width, axis=1).transpose(1, 0, 2)
        after, before = lines[left - most : left + most + 1 : every], lines[left + most : left - most - 1 : -every]
        for lag in range(farthest + 1):
            b = lag * every
            np.conjugate(before[:, top - b : bottom - b], out=product)
            product *= after[:, top + b : bottom + b]
            flat = product.reshape(count, -1)
            result[:, farthest + lag] = (flat.real @ weight + 1j * (flat.imag @ weight)).T
        # The weights are real.
        result[:, :farthest] = result[:, :farthest:-1, ::-1].conj()
        # The normalisation uses the sampled open area, which conserves the energy.
        return np.asarray(result / result[0, farthest, farthest].real)
