r"""Diffraction by the microlens array: the kernels of a capture's images, and the functions over a lens.

Let T be the transmission of the array, relative to the lens that a ray meets. Behind the array, a ray that meets it at
m lands on the detector at an offset p from the ray model's position with the signed density

.. math:: K_a(m, p) = \frac{1}{(\lambda z)^2}
          \int T(m + \xi/2)\, T^*(m - \xi/2)\, e^{-2 \pi i \xi \cdot p / \lambda z}\, d^2\xi.

Pairs of points in two neighbouring lenses are included; they describe the interference of the neighbours' fields. With
functions :math:`a_n` of m chosen for the camera (`lens_functions`), :math:`K_a(m, p) \approx \sum_n a_n(m)
\varphi_n(p)`. Coordinates of microlens points are relative to the centre of the lens.

Fields behind the lenses are those of `array_field`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..fields import Kind
from ..optics import in_millimetres
from ..runtime import (
    Doubles,
    Flags,
    Floats,
    Integers,
    exponents,
    fft,
    on_all_cores,
    require_memory,
    single_threaded_blas,
)
from .accuracy import USUAL
from .array_field import LensWaves
from .lens_functions import LensFunctions, of_middles
from .oblique import Oblique, changes, directions, terms

REACH = 2.5
"""Distance in microlens pitches to which kernels are computed."""


class ArrayKernels(LensWaves):
    """Diffraction of one camera's microlenses at one wavelength, as kernels of images."""

    def __init__(
        self,
        camera: PlenopticCamera,
        wavelength: float,
        *,
        # There are at most as many functions over a lens as polynomials of this degree, (degree + 1) (degree + 2) / 2.
        degree: int = 4,
        # Shortest wavelength of the plans with which it is used, whose rays must land alike. Default: its own.
        shortest: float | None = None,
        # Part of images of random light that is allowed to be missing for want of more functions and oblique kernels.
        tolerance: float = 0.005,
        # Whether another plan with which it is used is far from focus, as all rays must land alike.
        beside_far: bool = False,
        # The plan whose functions it has.
        basis: ArrayKernels | None = None,
    ) -> None:
        super().__init__(camera, wavelength)
        self.degree = degree
        self.tolerance = tolerance
        self.basis = basis
        # Whether a ray lands where its point on the lens sends it, instead of where the lens's centre does. Far from
        # the microlenses' focus a few functions cannot describe the difference. The spread by the pupil is then taken
        # as that of the whole pupil for all of its points.
        self.lands_by_point = beside_far or self.defocus * wavelength / (shortest or wavelength) > USUAL.most_phase
        # Distance in mm to which captures need kernels.
        self.reach = REACH * max(camera.mla_pitches)
        self._computed: dict[tuple[float, float, int], Doubles] = {}

    @cached_property
    @single_threaded_blas()
    def functions(self) -> LensFunctions:
        """Functions of a ray's point on a lens; polynomials of some degree if landing points depend on these points."""
        if self.basis:
            growth = self.lattice.period()[0] / self.basis.lattice.period()[0]
            return replace(self.basis.functions, scale=self.basis.functions.scale * growth)
        u, v, inside = self.aperture_grid(USUAL.spectrum_samples if self.lands_by_point else USUAL.function_samples)
        higher = 0 if self.lands_by_point or self.degree == 0 else USUAL.higher_degrees
        scale = float(self.lattice.aperture_reach)
        polynomials = LensFunctions.polynomials(u[inside], v[inside], self.degree + higher, scale)
        if not higher:
            return polynomials
        u, v, inside = self.aperture_grid(self._samples_of(USUAL.coarse_points))
        # Two directions stand for all rays, with their mean square along each axis; opposite ones have mirror images.
        along, across = np.sqrt(2 * np.mean(np.square(self._cosines()), axis=0)).tolist()
        images = np.concatenate(
            [
                self._images(polynomials, kind, polynomials.functions, cosines)
                for kind in self.kinds[: len(self.camera.mla_focal_lengths)]
                for cosines in ((along, 0.0), (0.0, across))
            ],
            axis=1,
        )
        tolerance = USUAL.missing_functions * self.tolerance
        return polynomials.best(len(exponents(self.degree)), tolerance, (u[inside], v[inside]), images)

    @cached_property
    @single_threaded_blas()
    def oblique(self) -> Oblique:
        """Combinations of the changes of kernels with the direction of light."""
        if self.basis:
            return self.basis.oblique
        functions = self.functions
        camera = self.camera
        if self.lands_by_point or functions.count == 1:
            return Oblique.nothing(functions.count)
        cosines = self._cosines()
        largest = float(np.hypot(*cosines.T).max())
        # Small apertures fall between the points of a grid that is as fine for all.
        u, v, inside = self.aperture_grid(self._samples_of(USUAL.coarse_points))
        kinds = self.kinds[: len(camera.mla_focal_lengths)]
        # Kernels of steep light change with its direction as polynomials of degree 4.
        edge = max(self.lattice.aperture_reach / kind.distance for kind in self.kinds)
        is_steep = bool(largest + edge > USUAL.steep)
        degree = 4 if is_steep else 2
        images = [
            np.concatenate([self._images(functions, kind, functions.duals, (a, b)) for kind in kinds], axis=1)
            for a, b in directions(degree) * largest
        ]
        light = functions.light(u[inside], v[inside])
        allowed = USUAL.missing_oblique[is_steep] * self.tolerance
        most = USUAL.most_oblique * len(exponents(self.degree))
        return Oblique.best(largest, cosines / largest, np.stack(images), light, functions.odd, allowed, most)

    def _samples_of(self, count: int) -> int:
        """Return the number of samples across a pitch, given the number across an aperture."""
        return math.ceil(count * self.lattice.pitches[0] / self.lattice.aperture_width)

    @cached_property
    def covariance(self) -> Doubles:
        """Covariance of the values of an image's rays, for light with random edges from all directions."""
        functions = self.functions
        oblique = self.oblique
        u, v, inside = self.aperture_grid(USUAL.coarse_points // 2)
        light = functions.light(u[inside], v[inside])
        across, up = self._cosines().T / oblique.largest
        expected = np.transpose(terms(across, up, oblique.degree))
        factors = np.einsum("rnk,sk->srn", oblique.factors, expected)
        both = np.concatenate(
            [np.broadcast_to(np.eye(functions.count), (len(expected), *light.shape)), factors], axis=1
        )
        return np.asarray(np.einsum("sin,nm,sjm->ij", both, light, both, optimize=True) / len(expected))

    def _cosines(self) -> Doubles:
        """Return the direction cosines (n, 2) on the array, in the array's frame, of light from the pupil."""
        camera = self.camera
        field = np.linspace(-0.5, 0.5, USUAL.oblique_fields) if camera.lens_data.converges else np.zeros(1)
        pupil = np.linspace(-1, 1, USUAL.oblique_pupil) * camera.pupil_radius
        x, y, Px, Py = (
            coordinate.ravel()
            for coordinate in np.meshgrid(field * camera.detector_width, field * camera.detector_height, pupil, pupil)
        )
        inside = np.hypot(Px, Py) <= camera.pupil_radius
        slopes = (coordinate[inside] / camera.pupil_distance for coordinate in (x - Px, y - Py))
        u, v = self.lattice.to_frame(*slopes)
        return np.column_stack([u, v]) / np.sqrt(1 + u * u + v * v)[:, None]

    def _images(
        self, polynomials: LensFunctions, kind: Kind, coefficients: Doubles, cosines: tuple[float, float] = (0.0, 0.0)
    ) -> Doubles:
        """Return the spectra (n, values) of kernels, as pixels record them, for combinations of polynomials."""
        scale = in_millimetres(self.wavelength) * kind.distance
        fine = self.lattice.pitches[0] / USUAL.pitch_lags
        farthest = min(2 * USUAL.pitch_lags, int(scale / (2 * self.camera.pixel_size * fine)))
        count = USUAL.coarse_lags
        step = fine * max(1, farthest // count)
        if count * step <= self.lattice.aperture_width:
            # Half as many are close enough for the aperture, and for the period of kernels.
            count //= 2
            step *= 1 + (farthest > count)
        weights = np.sinc(np.arange(-count, count + 1) * (step * self.camera.pixel_size / scale))
        transfer = self._transfer(
            count, step, self._samples_of(USUAL.coarse_samples), kind, polynomials, coefficients, cosines
        )
        spectra = transfer * (weights[:, None] * weights)
        return np.concatenate([spectra.real, spectra.imag], axis=1).reshape(len(spectra), -1)

    def aperture_grid(self, samples: int) -> tuple[Doubles, Doubles, Flags]:
        """Return coordinates of a grid around a lens, in the frame of the lattice, and a mask of its aperture."""
        reach = self.lattice.cell_reach
        count = 2 * math.ceil(reach * samples / self.lattice.pitches[0])
        step = self.lattice.pitches[0] / samples
        along = (np.arange(count) + 0.5 - count / 2) * step
        v, u = np.meshgrid(along, along, indexing="ij")
        return u, v, np.asarray(self.lattice.in_aperture(*self.lattice.from_frame(u, v)))

    def kernels(self, step: float, reach: float, kind: int = 0) -> Doubles:
        """Return the kernels (n, k, k) of one kind of lenses on a grid of width `step`, times the area of a grid cell.

        First come the functions' kernels, which reach at least to `reach`, then the oblique ones. Light beyond is
        folded back, which conserves energy.
        """
        key = step, reach, kind
        if key in self._computed:
            return self._computed[key]
        of_kind = self.kinds[kind]
        samples = self.kernel_samples(step, reach, kind)
        bytes_of_sample = 8.0
        count = 2 * samples[2] + 1
        if self.lands_by_point:
            # Transforms of the aperture, their products, and the kernels themselves.
            bytes_of_sample = 32.0
            count = 2 * (math.ceil(reach / step) + 1) * self._cell_parts(step, of_kind)
        spot = in_millimetres(self.wavelength) * of_kind.distance / self.lattice.aperture_width
        # As for pixels far larger than a lens's diffraction pattern.
        require_memory(
            bytes_of_sample * self.functions.count * float(count) ** 2,
            f"detector_width = {self.camera.detector_width:g}: pixels of {self.camera.pixel_size:.3g} mm behind lenses "
            f"whose diffraction spreads {self.wavelength:g} nm by {spot:.2g} mm, need kernels of {count} x {count} "
            "samples",
        )
        if self.lands_by_point:
            self._computed[key] = self._cell_kernels(step, reach, of_kind)
        else:
            self._computed[key] = self.sampled_kernels(step, samples, kind)
        return self._computed[key]

    def _cell_parts(self, step: float, kind: Kind) -> int:
        """Return the number of samples across a cell that resolves a lens's diffraction."""
        scale = in_millimetres(self.wavelength) * kind.distance
        return math.ceil(USUAL.cycle_samples * step * self.lattice.aperture_width / scale)

    def kernel_samples(self, step: float, reach: float, kind: int = 0) -> tuple[int, int, int]:
        """Return the sampling of `kernels`: lag step in fine samples, number of lags, samples on either side."""
        scale = in_millimetres(self.wavelength) * self.kinds[kind].distance
        fine = self.lattice.pitches[0] / USUAL.pitch_lags
        stride = max(1, int(scale / (2 * fine * reach)))
        # Pairs in neighbouring lenses are less than two cell widths apart; the grid resolves half a cycle per step.
        farthest = int(min(2 * USUAL.pitch_lags, scale / (2 * step * fine))) // stride
        return stride, farthest, math.ceil((scale / (fine * stride * step) + USUAL.border) / 2)

    @single_threaded_blas()
    def sampled_kernels(self, step: float, samples: tuple[int, int, int], kind: int = 0) -> Doubles:
        """Return `kernels` with a given sampling, even where another sampling would suit better."""
        stride, farthest, count = samples
        functions = self.functions
        oblique = self.oblique
        lag = self.lattice.pitches[0] / USUAL.pitch_lags * stride
        transfer = self._transfer(farthest, lag, 2 * USUAL.pitch_lags, self.kinds[kind], functions, functions.duals)
        kernels = self._placed(transfer, stride, step, count, kind)
        if oblique.count:
            parts = np.einsum("rnk,kd->drn", oblique.kernels, changes(oblique.degree))
            # Coarse pixels resolve few lags.
            coarser = USUAL.oblique_coarser if oblique.degree == 2 and farthest >= USUAL.coarse_lags else 1
            transfer = np.sum(
                [
                    self._transfer(
                        farthest // coarser,
                        lag * coarser,
                        self._samples_of(USUAL.coarse_samples),
                        self.kinds[kind],
                        functions,
                        functions.duals @ combination.T,
                        (a, b),
                    )
                    for combination, (a, b) in zip(parts, directions(oblique.degree) * oblique.largest, strict=True)
                ],
                axis=0,
            )
            # Their period is shorter, but not the border of their windows.
            small = self._placed(
                transfer, stride * coarser, step, min(count, count // coarser + USUAL.border // 2), kind
            )
            aside = (kernels.shape[1] - small.shape[1]) // 2
            kernels = np.concatenate([kernels, np.pad(small, [(0, 0), (aside, aside), (aside, aside)])])
        # Coarse grids sample so few lags that light would be lost or gained.
        missing = np.eye(len(kernels))[0] - kernels.sum((1, 2))
        return np.asarray(kernels + missing[:, None, None] * (kernels[0] / kernels[0].sum()))

    def _placed(self, transfer: NDArray[np.complex64], stride: int, step: float, count: int, kind: int) -> Doubles:
        """Return kernels of `count` samples on either side, from transfer functions `stride` steps apart."""
        scale = in_millimetres(self.wavelength) * self.kinds[kind].distance
        apart = self.lattice.pitches[0] / USUAL.pitch_lags * stride
        farthest = transfer.shape[1] // 2
        position = np.arange(-count, count + 1) * step
        lags = np.arange(-farthest, farthest + 1) * apart
        # All repetitions of the window add up to 1, so that a kernel has the transfer function at each lag.
        period = scale / apart
        beyond = (np.abs(position) - period / 2) / min(USUAL.border * step, period)
        window = (1 - np.sin(np.pi * np.clip(beyond, -0.5, 0.5))) / 2
        waves = window[:, None] * np.exp(-2j * np.pi * np.outer(position, lags) / scale) * (apart * step / scale)
        return np.einsum("yb,nba,xa->nyx", waves, transfer, waves, optimize=True).real

    def spots(self, along: Doubles) -> Doubles:
        """Return the diffraction patterns (types, n, n) of single lenses, at detector positions along both axes."""
        u, v, inside = self.aperture_grid(USUAL.pitch_lags)
        wavelength = in_millimetres(self.wavelength)
        patterns = []
        for kind in self.kinds[: len(self.camera.mla_focal_lengths)]:
            scale = wavelength * kind.distance
            waves = np.exp(-2j * np.pi * np.outer(along, u[0]) / scale)
            # In front of the lens, whose phase follows.
            phase = (self.convergence(kind) + 1 / kind.focal_length) * (u * u + v * v) / (2 * wavelength)
            offset = self.lattice.from_frame(u, v)
            phase += self.camera.microlens.lens_waves(self.lattice, *offset, kind.focal_length, self.wavelength)
            field = waves @ np.where(inside, np.exp(2j * np.pi * phase), 0) @ waves.T
            patterns.append(np.abs(field) ** 2 * (u[0, 1] - u[0, 0]) ** 2 / (inside.sum() * scale**2))
        return np.stack(patterns)

    def _cell_kernels(self, step: float, reach: float, kind: Kind) -> Doubles:
        """Return kernels between cells of uniform light, for cells that may be larger than the diffraction kernels.

        Neighbours and phases are left out: see `of_middles`.
        """
        lattice = self.lattice
        scale = in_millimetres(self.wavelength) * kind.distance
        parts = self._cell_parts(step, kind)
        count = math.ceil(reach / step)
        fine = step / parts
        far = (count + 1) * parts - 1
        x, y, _ = self.aperture_grid(USUAL.spectrum_samples)
        along = x[0]
        spacing = x[0, 1] - x[0, 0]
        inside = lattice.in_aperture(x, y)
        functions = self.functions
        u, v = (coordinate / functions.scale for coordinate in lattice.to_frame(x, y))
        # The transforms of samples repeat; behind large lenses they do so within the kernels' reach.
        within = min(far, int(scale / (2 * spacing * fine)))
        waves = np.exp(-2j * np.pi * np.outer(np.arange(-within, within + 1) * fine, along) / scale)
        fields = {(a, b): waves @ np.where(inside, u**a * v**b, 0) @ waves.T for a, b in functions.exponents}
        products = of_middles(functions.exponents, fields)
        kernels = np.einsum("mn,myx->nyx", functions.combined, products) * (spacing * fine / scale) ** 2 / inside.sum()
        kernels = np.pad(kernels, [(0, 0), *[(far - within,) * 2] * 2])
        tent = np.convolve(np.ones(parts), np.ones(parts)) / parts
        for axis in (1, 2):
            kernels = np.apply_along_axis(np.convolve, axis, kernels, tent, "valid")
        return kernels[:, ::parts, ::parts]

    def _transfer(
        self,
        farthest: int,
        lag: float,
        samples: int,
        kind: Kind,
        polynomials: LensFunctions,
        coefficients: Doubles,
        cosines: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.complex64]:
        """Return the integrals over a cell of combinations of polynomials, times T T*, at lags along y and x.

        Along either axis there are `farthest` lags on either side, multiples of `lag` in mm, and at least a number of
        samples across the pitch. `coefficients` (polynomials, n) define the combinations. Light has given direction
        cosines.
        """
        lattice = self.lattice
        # A lag of whole strides moves both points of a pair to points of the grid.
        stride = math.ceil(lag / 2 * samples / lattice.pitches[0] - 1e-6)
        step = lag / 2 / stride
        # Samples count in part up to one beyond the cell, which with them is wider by two samples.
        reach = math.ceil(lattice.cell_reach * (1 / step + 2 / lattice.pitches[0])) + farthest * stride
        along = (np.arange(-reach, reach) + 0.5) * step
        y, x = np.meshgrid(along, along, indexing="ij")
        (x, y), T, share = self.transmission((x, y), kind, cosines)
        open_ = share > 0
        rows, columns = (np.flatnonzero(open_.any(axis)) for axis in (1, 0))
        top = rows[0]
        bottom = rows[-1] + 1
        left = columns[0]
        width = columns[-1] + 1 - columns[0]
        both = np.hstack([polynomials.functions, polynomials.duals])
        u, v = (coordinate[open_] for coordinate in lattice.to_frame(x, y))
        functions, duals = np.split(polynomials.values(u, v, both), 2)
        # On these samples, too, the integrals of the duals with the functions over the lens are exact.
        measure = share[open_] * np.square(np.abs(T[open_]))
        products = functions @ (measure * duals).T / measure.sum()
        exact = np.linalg.solve(products, polynomials.functions.T @ coefficients)
        weight = np.zeros((coefficients.shape[1], *open_.shape), np.float32)
        weight[:, open_] = share[open_] * (exact.T @ duals)
        weight = weight[:, top:bottom, left : left + width]
        across, up, around = (self._symmetry(T, weight, axes) for axes in (2, 1, (1, 2)))
        real = imaginary = np.ones(coefficients.shape[1], bool)
        if around is not None:
            # Opposite points give conjugate products: half of the lens gives the real or the imaginary part.
            real = np.ravel(around > 0)
            imaginary = ~real
            bottom = (top + bottom) // 2
            weight = 2 * weight[:, : bottom - top]
        weight = weight.reshape(len(weight), -1).T
        weights = weight[:, real], weight[:, imaginary]
        count = 2 * farthest + 1
        most = farthest * stride
        # One symmetry gives the lags on one side from those on the other.
        first = 0 if across is None and up is None else farthest
        result = np.zeros((coefficients.shape[1], count, count), np.complex64)
        # Views (column, row, place) of the real and the imaginary part of T, from each column on.
        lines = [
            np.lib.stride_tricks.sliding_window_view(T_part.copy(), width, axis=1).transpose(1, 0, 2)
            for T_part in (T.real, T.imag)
        ]
        lines = [line[left - most : left + most + 1 : stride] for line in lines]
        # 2**17: Products of pairs that are computed at a time, so that these fit into a cache.
        few = max(1, 2**17 // ((bottom - top) * width))

        def integrate(lags: Integers) -> None:
            for lag, start in itertools.product(lags.tolist(), range(first, count, few)):
                columns = slice(start, min(start + few, count))
                b = lag * stride
                shape = columns.stop - start, -1
                after = [line[columns, top + b : bottom + b] for line in lines]
                before = [line[::-1][columns, top - b : bottom - b] for line in lines]
                if real.any():
                    product = (after[0] * before[0] + after[1] * before[1]).reshape(shape)
                    result.real[real, farthest + lag, columns] = (product @ weights[0]).T
                if imaginary.any():
                    product = (after[1] * before[0] - after[0] * before[1]).reshape(shape)
                    result.imag[imaginary, farthest + lag, columns] = (product @ weights[1]).T

        on_all_cores(integrate, np.array_split(np.arange(farthest + 1), fft.worker_count()))
        other_side = result[:, farthest:, :farthest:-1]
        if across is not None:
            result[:, farthest:, :farthest] = other_side * across
        elif up is not None:
            result[:, farthest:, :farthest] = other_side.conj() * up
        # The weights are real.
        result[:, :farthest] = result[:, :farthest:-1, ::-1].conj()
        # The normalisation uses the sampled open area, which conserves the energy.
        return np.asarray(result / np.float32(measure.sum()))

    @staticmethod
    def _symmetry(T: NDArray[Any], weight: Floats, axis: int | tuple[int, int]) -> Floats | None:
        """Return 1 for weights that are even, and -1 for odd ones, along axes along which T is even; otherwise None.

        Shapes: the result (n, 1, 1), `weight` (n, rows, columns).
        """
        if not np.abs(T - np.flip(T[None], axis)[0]).max() <= USUAL.mirrored:
            return None
        mirror = np.flip(weight, axis)
        signs = np.where(np.einsum("nij,nij->n", mirror, weight) < 0, np.float32(-1), np.float32(1))[:, None, None]
        error = np.abs(weight - signs * mirror).max((1, 2))
        return signs if (error <= USUAL.mirrored * np.abs(weight).max((1, 2))).all() else None


def displaced(kernels: Doubles) -> list[Doubles]:
    """Return the changes of kernels per cell of displacement, along x, then along y."""
    from scipy.ndimage import convolve1d

    # Kernels end abruptly, and their slopes include these ends: a short filter confines them to their surroundings.
    reach = USUAL.derivative_samples
    steps = np.arange(-reach, reach + 1)
    ideal = np.divide((-1.0) ** steps, steps, out=np.zeros(len(steps)), where=steps != 0)
    wide = np.pad(kernels, [(0, 0), (reach, reach), (reach, reach)])
    window = np.kaiser(len(steps), USUAL.derivative_shape)
    return [convolve1d(wide, -ideal * window, axis, mode="constant") for axis in (2, 1)]
