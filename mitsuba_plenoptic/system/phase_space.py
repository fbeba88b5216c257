r"""Diffraction in phase space: what a ray of incoherent light carries behind the main lens's pupil and the microlenses.

In front of the pupil the Wigner function of incoherent light is the radiance along rays (Walther, J. Opt. Soc. Am. 58,
1256 (1968); Bastiaans, Opt. Commun. 25, 26 (1978)). Two apertures spread it. Behind the *pupil* a ray through the pupil
point P keeps P, and meets the array at m + x instead of m, with the signed density

.. math:: K_p(P, x) = \frac{1}{(\lambda b)^2} \int O_P(\eta)\, e^{-2 \pi i \eta \cdot x / \lambda b}\, d^2\eta, \qquad
          O_P(\eta) = t(P + \eta/2)\, t^*(P - \eta/2).

Behind the *array*, of transmission T in units of the lens that the ray meets, it lands on the detector p aside of where
the ray model puts it, with the signed density

.. math:: K_a(m, p) = \frac{1}{(\lambda z)^2}
          \int T(m + \xi/2)\, T^*(m - \xi/2)\, e^{-2 \pi i \xi \cdot p / \lambda z}\, d^2\xi.

Pairs of points in two neighbouring lenses are part of it: they are how the fields of neighbours interfere. Projected on
polynomials :math:`P_n` of m that are orthonormal over the aperture, :math:`K_a(m, p) \approx \sum_n a_n(m)
\varphi_n(p)`, a capture becomes a ray capture of some values a ray and as many convolutions:

.. math:: I = \sum_n \varphi_n * \sum_{rays} L\, A_n, \qquad A_n(m, P) = \int K_p(P, x)\, a_n(m + x)\, d^2x .

All depends on the camera and the wavelength, nothing on the scene. Coordinates of microlens points count from the
centre of the lens.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..camera import PlenopticCamera
from ..errors import InputError, short_repr
from ..lattice import Lattice
from ..optics.phase import in_millimetres
from ..runtime.limits import single_threaded_blas
from .lens_kinds import Kind, LensKinds
from .optical_system import OpticalSystem

_TRANSFER_SAMPLES = 64
"""Samples of a lens for its transfer functions: the phase between neighbours turns by a fifth of a period."""

_KEPT = 2.0
"""Samples over the highest frequency of a lens's diffraction, in cycles: two hold it whole."""

_SPECTRUM_SAMPLES = 256
"""Samples of a lens for the Fourier coefficients of its polynomials."""

_SPREADS = 2.0
"""Widths of the window about a lens over the width of the pupil's diffraction along the radius, lambda b / 2 h."""

_LEAST_WINDOW, _NARROW = 3, 0.2
"""Lenses, across, of the least window, which is one less where that width is less than so much of a lens."""

_OVERSAMPLING, _FINEST = 1.4, 64
"""Samples of the table over those that its highest frequency needs, and those of a lens at most."""

MOST_PHASE, MOST_SHIFT = 8.0, 0.3
"""Radians of defocus at a lens's edge up to which polynomials describe where its rays land; pixels by which the pupil's
diffraction may move them where they do not."""

_SUBSAMPLES = 4
"""Gauss-Legendre nodes, per direction and side, of the pupil's overlap around a node of the table."""


_TABLES = 8
"""Tables that are held for further plans, of some 35 MiB each."""

_tables: dict[tuple[Any, ...], list[NDArray[np.float32]]] = {}


class TableNode(NamedTuple):
    """The window of the table at one node of the pupil's radius, in the lattice's frame."""

    # Its sides, whole multiples of the periods of the lattice.
    sides: tuple[float, float]
    # Samples along them.
    counts: tuple[int, int]
    # Nodes over a quarter turn, less one.
    angular: int


@dataclass(frozen=True)
class PhaseSpace:
    """Diffraction of one camera at one wavelength, as coefficients that rays carry and kernels that images pass."""

    # A camera not far out of whose microlenses' focus is the detector; one with glasses as it is `at_wavelength`.
    camera: PlenopticCamera
    wavelength: float
    # Total degree of the polynomials over a lens. There are (degree + 1) (degree + 2) / 2.
    degree: int = 4
    # Lenses, across, over which the pupil's rim spreads a ray, which it does most. Light beyond is folded back by whole
    # windows, which keeps the energy.
    window: int = 9
    # Nodes of the table along the pupil's radius, dense towards its rim.
    radial: int = 12
    # Wavelength of the plans with which it is used, whose rays land alike: the shortest. Default: its own.
    shortest: float | None = None

    def __post_init__(self) -> None:
        camera = self.camera
        for name, refused, rule in (
            (
                "main_lens",
                camera.lens_data.images_stop,
                "not of the Fourier arrangement",
            ),
            ("glass", camera.glass is not None, "taken at the wavelength, by camera.at_wavelength"),
            ("mla_glass", camera.mla_glass is not None, "taken at the wavelength, by camera.at_wavelength"),
            ("detector_distance", self._shift > MOST_SHIFT, f"closer to the microlenses' focus, {self._limits}"),
        ):
            if refused:
                raise InputError(f"{name} = {short_repr(getattr(camera, name))}: for signed rays it must be {rule}")

    @property
    def defocus(self) -> float:
        """Radians by which the microlenses' waves are out of focus on the detector, at their edges, at most."""
        square = float(self.lattice.aperture_reach) ** 2
        most = max(abs(self.convergence(kind)) for kind in self.kinds)
        return math.pi * most * square / in_millimetres(self.wavelength)

    @property
    def by_points(self) -> bool:
        """Whether each ray lands by its own point of the lens, and not by the lens's centre.

        Far out of the microlenses' focus polynomials do not describe the difference. All points of the pupil are then
        taken to spread rays as the whole pupil does on average.
        """
        return self.defocus * self.wavelength / (self.shortest or self.wavelength) > MOST_PHASE

    @property
    def _shift(self) -> float:
        """Pixels by which the pupil's diffraction moves light on the detector, if rays land by their own points."""
        if not self.by_points:
            return 0.0
        camera = self.camera
        most = max(abs(self.convergence(kind)) * kind.detector_distance for kind in self.kinds)
        width = in_millimetres(self.wavelength) * camera.pupil_distance / (2 * camera.pupil_radius)
        return most * width / camera.pixel_size

    @property
    def _limits(self) -> str:
        """Where the detector may be."""
        camera = self.camera
        aside = MOST_PHASE * in_millimetres(self.wavelength) / math.pi / float(self.lattice.aperture_reach) ** 2
        own = camera.lens_data.converges / camera.pupil_distance
        powers = [1 / f2 - own for f2 in camera.mla_focal_lengths]
        near, far = 1 / (min(powers) + aside), 1 / max(max(powers) - aside, 1e-9)
        return f"from {near:.4g} to {far:.4g} mm" if near <= far else "which several focal lengths do not allow"

    @cached_property
    def system(self) -> OpticalSystem:
        """The camera, bound to the wavelength."""
        return OpticalSystem(self.camera, self.wavelength)

    # -- sizes ---------------------------------------------------------------------------------------

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
        """Powers of u and v that a polynomial adds to those before it."""
        return [(i, total - i) for total in range(self.degree + 1) for i in range(total, -1, -1)]

    @cached_property
    def nodes(self) -> list[TableNode]:
        """The table's nodes along the pupil's radius, and the windows and samples that each needs."""
        radius, reach = self.camera.pupil_radius, in_millimetres(self.wavelength) * self.camera.pupil_distance
        pitch = self.lattice.pitches[0]
        made = []
        for index in range(self.radial + 1):
            distance, inner = (radius * (1 - (1 - max(r, 0) / self.radial) ** 2) for r in (index, index - 1))
            spread = _SPREADS * reach / max(radius - distance, 1e-9 * radius)
            least = _LEAST_WINDOW * pitch if spread > _NARROW * pitch else (_LEAST_WINDOW - 1) * pitch
            wanted = min(self.window * pitch, max(least, pitch + spread))
            sides = tuple(math.ceil(wanted / period - 1e-6) * period for period in self.lattice.period())
            # The greatest lag is across the radius.
            step = max(reach / (2 * _OVERSAMPLING * 2 * math.sqrt(radius**2 - inner**2)), pitch / _FINEST)
            # From one node to the next the farthest points turn by half a lens.
            angular = math.ceil(math.pi / 2 * max(sides) / pitch)
            made.append(TableNode(sides, tuple(math.ceil(side / step) for side in sides), angular))
        return made

    # -- polynomials over a lens -------------------------------------------------------------------

    def _aperture_grid(self, samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return coordinates, in the lattice's frame, of a grid about a lens, and which points its aperture holds."""
        reach = float(self.lattice.cell_reach)
        count = 2 * math.ceil(reach * samples / self.lattice.pitches[0])
        step = self.lattice.pitches[0] / samples
        along = (np.arange(count) + 0.5 - count / 2) * step
        v, u = np.meshgrid(along, along, indexing="ij")
        return u, v, np.asarray(self.lattice.in_aperture(*self.lattice.from_frame(u, v)))

    @cached_property
    def triangle(self) -> NDArray[np.float64]:
        """Coefficients of the orthonormal polynomials in monomials of u and v over the pitch, by Gram-Schmidt."""
        u, v, inside = self._aperture_grid(_SPECTRUM_SAMPLES)
        monomials = self._monomials(u[inside], v[inside])
        gram = monomials.T @ monomials / len(monomials)
        return np.linalg.inv(np.linalg.cholesky(gram)).T

    def _monomials(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        pitch = self.lattice.pitches[0]
        return np.stack([(u / pitch) ** i * (v / pitch) ** j for i, j in self.exponents], axis=-1)

    def polynomials(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the polynomials, whose mean product over the aperture is 1 of one with itself, else 0."""
        return self._monomials(u, v) @ self.triangle

    def mirrored(self, values: Sequence[Any], across: Any, up: Any) -> list[Any]:
        """Return the values of polynomials of a place that is mirrored along u, along v, or both."""
        signs = dr.select(across, -1.0, 1.0), dr.select(up, -1.0, 1.0)
        return [
            value * (signs[0] if i % 2 else 1.0) * (signs[1] if j % 2 else 1.0)
            for (i, j), value in zip(self.exponents, values, strict=False)
        ]

    # -- the pupil: coefficients of rays -------------------------------------------------------------

    @cached_property
    def table(self) -> list[NDArray[np.float32]]:
        """Coefficients of rays at each node of the radius: (nodes of the angle, rows, columns, polynomials).

        Cameras share it that differ in what it does not depend on, such as their detectors.
        """
        camera = self.camera
        key = (
            *(camera.mla_lattice, camera.mla_pitches, camera.mla_aperture, camera.mla_fill),
            *(camera.pupil_radius, camera.pupil_distance, self.wavelength, self.degree, *self.nodes),
        )
        if key not in _tables:
            while len(_tables) >= _TABLES:
                del _tables[next(iter(_tables))]
            _tables[key] = self._tabulated()
        return _tables[key]

    @single_threaded_blas()
    def _tabulated(self) -> list[NDArray[np.float32]]:
        """Return the table that `table` keeps."""
        radius, reach = self.camera.pupil_radius, in_millimetres(self.wavelength) * self.camera.pupil_distance
        u, v, inside = self._aperture_grid(_SPECTRUM_SAMPLES)
        values = np.where(inside[..., None], self.polynomials(u, v), 0) * (u[0, 1] - u[0, 0]) ** 2
        table = []
        for radial, node in enumerate(self.nodes):
            # Fourier coefficients over the window, of the frequencies that the pupil lets through.
            to_space, orders, lags = [], [], []
            for side, count in zip(node.sides, node.counts, strict=True):
                order = np.arange(-((count - 1) // 2), (count - 1) // 2 + 1)
                place = (np.arange(count) + 0.5) * side / count - side / 2
                # What linear interpolation damps is raised beforehand.
                gain = np.sinc(order / count) ** -2 / side
                to_space.append((np.exp(2j * np.pi * np.outer(place, order) / side) * gain).astype(np.complex64))
                orders.append(np.exp(-2j * np.pi * np.outer(order, u[0]) / side).astype(np.complex64))
                lags.append(np.asarray(order * (reach / side), np.float64))
            spectra = np.einsum("ay,yxn,bx->nab", orders[1], values.astype(np.float32), orders[0], optimize=True)
            part = np.empty((node.angular + 1, *reversed(node.counts), len(self.exponents)), np.float32)
            for angle in range(node.angular + 1):
                overlap = self._overlap(
                    radial,
                    angle * math.pi / 2 / node.angular,
                    math.pi / 2 / node.angular,
                    lags[0],
                    lags[1][:, None],
                    radius,
                )
                part[angle] = np.moveaxis((to_space[1] @ (spectra * overlap) @ to_space[0].T).real, 0, -1)
            table.append(part)
        return table

    def _overlap(
        self,
        radial: int,
        angle: float,
        turn: float,
        lag_u: NDArray[np.float64],
        lag_v: NDArray[np.float64],
        radius: float,
    ) -> NDArray[np.float32]:
        """Return O_P, averaged over the part of the pupil that linear interpolation gives to a node."""
        abscissae, weights = np.polynomial.legendre.leggauss(_SUBSAMPLES)
        aside, weights = (abscissae + 1) / 2, weights * (1 - (abscissae + 1) / 2)
        steps = np.concatenate([-aside, aside])
        weights = np.concatenate([weights, weights])
        total = np.zeros(np.broadcast_shapes(lag_u.shape, lag_v.shape))
        scale = 0.0
        for step, weight in zip(steps, weights, strict=True):
            t = 1 - (radial + step) / self.radial
            if not 0 <= t <= 1:
                continue
            distance = radius * (1 - t * t)
            # The area that belongs to a step of t, but on the axis any would be nothing.
            area = weight * t * distance
            for part, share in zip(steps, weights, strict=True):
                Pu, Pv = distance * math.cos(angle + part * turn), distance * math.sin(angle + part * turn)
                both = np.maximum(
                    (Pu + lag_u / 2) ** 2 + (Pv + lag_v / 2) ** 2, (Pu - lag_u / 2) ** 2 + (Pv - lag_v / 2) ** 2
                )
                total += area * share * (both <= radius * radius)
                scale += area * share
        return (total / scale).astype(np.float32)

    def moved(self, camera: PlenopticCamera) -> PhaseSpace:
        """Return the plan of a camera that differs a little, whose table has the same nodes."""
        plan = replace(self, camera=camera)
        scales = [own / before for own, before in zip(plan.lattice.period(), self.lattice.period(), strict=True)]
        vars(plan)["nodes"] = [
            node._replace(sides=(node.sides[0] * scales[0], node.sides[1] * scales[1])) for node in self.nodes
        ]
        return plan

    # -- the array: kernels of images ------------------------------------------------------------------

    def kernels(self, step: float, reach: float, kind: int = 0) -> NDArray[np.float64]:
        """Return the kernels of lenses of a kind times the area of a grid's cell; (n, k, k).

        The grid has this step, and the kernels reach at least so far. Light beyond is folded back, which keeps the
        energy.
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
        """Return how `kernels` are sampled: steps from lag to lag, lags and samples on each side of the middle."""
        scale = in_millimetres(self.wavelength) * self.kinds[kind].detector_distance
        fine = self.lattice.pitches[0] / _TRANSFER_SAMPLES
        every = max(1, int(scale / (2 * fine * reach)))
        # Pairs in neighbouring lenses are less than two widths of a cell apart; a grid holds half a cycle a step.
        farthest = int(min(2 * _TRANSFER_SAMPLES, scale / (2 * step * fine))) // every
        return every, farthest, math.ceil(scale / (2 * fine * every * step) - 0.5)

    @single_threaded_blas()
    def sampled_kernels(self, step: float, samples: tuple[int, int, int], kind: int = 0) -> NDArray[np.float64]:
        """Return `kernels` that are sampled like others, whatever would be best for them."""
        scale = in_millimetres(self.wavelength) * self.kinds[kind].detector_distance
        fine = self.lattice.pitches[0] / _TRANSFER_SAMPLES
        every, farthest, count = samples
        transfer = self._transfer(np.arange(-farthest, farthest + 1) * every, self.kinds[kind])
        place, lags = np.arange(-count, count + 1) * step, np.arange(-farthest, farthest + 1) * (every * fine)
        waves = np.exp(-2j * np.pi * np.outer(place, lags) / scale) * (every * fine * step / scale)
        return np.einsum("yb,nba,xa->nyx", waves, transfer, waves, optimize=True).real

    def spots(self, along: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return what one lens of each type diffracts, at places on the detector along both axes: (types, n, n)."""
        u, v, inside = self._aperture_grid(_TRANSFER_SAMPLES)
        wavelength = in_millimetres(self.wavelength)
        made = []
        for kind in self.kinds[: len(self.camera.mla_focal_lengths)]:
            scale = wavelength * kind.detector_distance
            waves = np.exp(-2j * np.pi * np.outer(along, u[0]) / scale)
            phase = self.convergence(kind) * (u * u + v * v) / (2 * wavelength)
            field = waves @ np.where(inside, np.exp(2j * np.pi * phase), 0) @ waves.T
            made.append(np.abs(field) ** 2 * (u[0, 1] - u[0, 0]) ** 2 / (inside.sum() * scale**2))
        return np.stack(made)

    def _cell_kernels(self, step: float, reach: float, kind: Kind) -> NDArray[np.float64]:
        r"""Return kernels from cells, over which light is even, to cells, which may be larger than the kernels are.

        Without neighbours and phase the integral over pairs of points is a sum of products: that of
        :math:`m^i = 2^{-i} \sum_a \binom{i}{a} x_1^a x_2^{i-a}` is one of transforms of the aperture times powers.
        """
        lattice, scale = self.lattice, in_millimetres(self.wavelength) * kind.detector_distance
        parts = math.ceil(_KEPT * step * float(lattice.aperture_width) / scale)
        count = math.ceil(reach / step)
        fine, far = step / parts, (count + 1) * parts - 1
        x, y, _ = self._aperture_grid(_SPECTRUM_SAMPLES)
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
        """Return the curvature of the waves from a point of the pupil, behind a lens, over those to the detector."""
        # Waves from a point of an objective's stop are plane.
        own = self.camera.lens_data.converges / self.camera.pupil_distance
        return 1 / kind.detector_distance + own - 1 / kind.focal_length

    def _transfer(self, lags: NDArray[np.int64], kind: Kind) -> NDArray[np.complex64]:
        """Return the integrals of polynomial times T T* over a cell at lags of steps, the same along x and y."""
        lattice, camera = self.lattice, self.camera
        wavelength = in_millimetres(self.wavelength)
        step = lattice.pitches[0] / _TRANSFER_SAMPLES
        half = math.ceil(lattice.cell_reach / step)
        # Half steps about the lens: with a lag of whole steps, both points of a pair lie between two whole steps.
        reach = 2 * half + int(lags[-1]) + 1
        along = np.arange(-reach, reach + 1) * (step / 2)
        y, x = np.meshgrid(along, along, indexing="ij")
        # Types follow each other along a row.
        centre = lattice.centre(float(kind.lens_type), 0.0)
        i, j = lattice.cell(x + centre[0], y + centre[1])
        cx, cy = (c - c0 for c, c0 in zip(lattice.centre(i, j), centre, strict=True))
        # Neighbours are as irregular.
        powers = camera.mla_focal_lengths[kind.lens_type] / kind.focal_length / np.array(camera.mla_focal_lengths)
        types = lattice.lens_type(i, j).astype(int) if len(powers) > 1 else np.zeros(i.shape, int)
        phase = ((x * x + y * y) * powers[kind.lens_type] - ((x - cx) ** 2 + (y - cy) ** 2) * powers[types]) / (
            2 * wavelength
        )
        if not self.by_points:
            # A quadratic phase shifts what lands, by the place on the lens.
            phase += self.convergence(kind) * (x * x + y * y) / (2 * wavelength)
        inside = lattice.in_aperture(x - cx, y - cy)
        T = np.where(inside, np.exp(2j * np.pi * phase), 0).astype(np.complex64)
        # Beyond the aperture polynomials stand for nothing, and rays have no coefficients.
        own = np.asarray((i == kind.lens_type) & (j == 0) & inside, np.float32)
        # Points on a border belong to both sides.
        weights = self.polynomials(*lattice.to_frame(x, y)) * ((own + own[::-1, ::-1]) / 2)[..., None]
        result = np.zeros((len(self.exponents), len(lags), len(lags)), np.complex64)
        middle = len(lags) // 2
        for row, b in enumerate(lags[middle:].tolist(), middle):
            for odd in range(2):
                (places,) = np.nonzero((lags + odd) % 2 == 0)
                if not len(places):
                    continue
                # Midpoints every whole step, between samples of T, of the cell and what its border shares.
                rows, columns = (reach + 1 - each % 2 + 2 * np.arange(-half, half + 1) for each in (b, odd))
                weight = weights[np.ix_(rows, columns)].reshape(-1, len(self.exponents)).astype(np.float32)
                index = (columns + lags[places, None])[:, None]
                product = T[(rows + b)[:, None], index] * T[(rows - b)[:, None], index[::-1]].conj()
                product = product.reshape(len(places), -1)
                result[:, row, places] = ((product.real @ weight) + 1j * (product.imag @ weight)).T
        # The weights are real.
        result[:, :middle] = result[:, :middle:-1, ::-1].conj()
        # The open area as it is sampled, so that energy is kept.
        return np.asarray(result / result[0, middle, middle].real)
