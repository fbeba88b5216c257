r"""The field on the pupil of many scene points with complex amplitudes, layer by layer of distance.

At the point P of the pupil, the field of the point X is the amplitude of X times

.. math:: B(P, X) \, e^{2 \pi i p(P, X)}, \qquad p(P, X) = p_0(P) + c(P, X) + r(P, X)

with the path p in waves as in `lenses`, 0 to the pupil's centre. :math:`p_0` is common to a layer, and c are waves of
which sums over points are convolutions or transforms (see `carriers`): spheres of one radius behind an ideal main lens,
tilts behind a parabolic one. The remainder r is small and smooth: the defocus within the layer and, with tilts, the
non-paraxial change of the wavefront across the field. Therefore :math:`B \exp(2 \pi i r)` is a sum of a few products of
a function of P and one of X, which are found by interpolation between Chebyshev nodes of the pupil and a singular value
decomposition (Candes, Demanet and Ying, "A fast butterfly algorithm for the computation of Fourier integral operators",
2009, use the same separation). The cost is one convolution or transform for each of these products, for any number of
points, and no step is paraxial.
"""

import math
from collections.abc import Iterator
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...fields import OpticalSystem
from ...lenses import ThinLens
from ...optics import in_millimetres, phasor, soft_edge
from ...points import blocks
from ...runtime import Array, Doubles, Field, Integers, active_backend, array_module, fft
from .carriers import PupilGrid, Spheres, Tilts

_TOLERANCE = 5e-6
"""Error of the separated field, relative to its modulus: about that of single precision."""

_TRIED = 64
"""Points of a layer for which the interpolation is tried, and positions on the pupil."""

_DIAGONALS = np.array([(1, 0, 0), (0, 1, 0), (1, 1, 0), (1, -1, 0), (0, 0, 1), (1, 1, 1), (1, -1, 1)], np.float64)
"""Directions in the tilt along x and y, and nearness, of a layer's points."""

_BASIS = 2048
"""Largest number of points of a layer from which its products are found."""

_TOGETHER = 2**22
"""Number of factors that are computed together, which limits their memory."""

_MISSED = 5e-5
"""Error of a single point's separated field beyond which products are added for it."""

_SPOKES = 24
"""Positions on a ring of the pupil at which the power of a point's light is summed."""


class Layer:
    """Points (n, 3) of similar distance, each with unit power through the pupil, on the samples of a grid."""

    def __init__(self, system: OpticalSystem, lens: ThinLens, points: Doubles, grid: PupilGrid):
        self._lens = lens
        self._wavelength = system.wavelength
        self._grid = grid
        carrier = carrier_type(lens, points, grid)(lens, system.wavelength, points, grid)
        self._carrier = carrier
        nodes = self._nodes(points)
        on_device = active_backend().arrays.asarray
        self._interpolation = [on_device(_interpolation(nodes, grid.along(axis) / self._half)) for axis in (0, 1)]
        x, y = (mesh.ravel() * self._half for mesh in np.meshgrid(nodes, nodes))
        some = np.linspace(0, len(points) - 1, min(len(points), _BASIS)).astype(int)
        # Orthonormal functions that represent the factors of some points within the tolerance.
        basis, strength, _ = np.linalg.svd(self._remainder(x, y, points, some), full_matrices=False)
        tail = np.sqrt(np.cumsum(strength[::-1] ** 2)[::-1] / np.sum(strength**2))
        basis = basis[:, : max(1, int(np.count_nonzero(tail > _TOLERANCE)))]
        parts = []
        step = max(1, _TOGETHER // len(x))
        for first in range(0, len(points), step):
            basis, coefficients = _completed(basis, self._remainder(x, y, points, slice(first, first + step)))
            parts.append(coefficients)
        self.rank = basis.shape[1]
        by_nodes = np.ascontiguousarray(basis.T).reshape(self.rank, len(nodes), len(nodes)).astype(np.complex64)
        self._on_pupil = list(on_device(by_nodes))
        # Points before the last completion do without the products that came later.
        padded = [np.pad(rows, ((0, self.rank - len(rows)), (0, 0))) for rows in parts]
        self._of_points = list(on_device((np.concatenate(padded, 1) * self._carrier.shift).astype(np.complex64)))

    def add(self, amplitudes: Field, field: Field) -> None:
        """Add the field of points with given amplitudes (n,) to samples of the grid."""
        common = self._common()
        for on_pupil, of_points in zip(self._on_pupil, self._of_points, strict=True):
            for rows, waves in self._carrier.forward(amplitudes * of_points):
                waves *= self._values(on_pupil, rows)
                waves *= common[rows]
                field[rows] += waves

    def adjoint(self, field: Field) -> Field:
        """Return the inner product of each point's field with samples of the grid."""
        smooth = self._common().conj() * field
        total = active_backend().arrays.zeros(self._of_points[0].shape, np.complex64)
        for on_pupil, of_points in zip(self._on_pupil, self._of_points, strict=True):

            def products(on_pupil: Field = on_pupil) -> Iterator[tuple[slice, Field]]:
                for rows in blocks(self._grid.count):
                    yield rows, smooth[rows] * self._values(on_pupil, rows).conj()

            total += of_points.conj() * self._carrier.adjoint(products())
        return total

    @property
    def _half(self) -> float:
        """Half the side, in mm, of the square of nodes between which the fields are interpolated."""
        return self._grid.pitch * (self._grid.count // 2 + 1)

    def _common(self) -> Field:
        """Return the common factor of all points' fields on the samples, of modulus 1 in the pupil."""
        types = array_module()
        grid = self._grid
        row, column = fft.rows_and_columns(types, grid.count, grid.count)
        x, y = (
            (types.Float64(index) - grid.count // 2) * dr.opaque(types.Float64, grid.pitch)
            + dr.opaque(types.Float64, float(start))
            for index, start in zip((column, row), grid.middle, strict=True)
        )
        cover = types.Float(soft_edge(self._lens.inside((x, y)) / grid.pitch))
        light = phasor(self._carrier.common((x, y))) * cover
        return fft.as_field(fft.pack(light), (grid.count, grid.count))

    def _values(self, on_pupil: Field, rows: slice) -> Field:
        """Return values on the pupil at rows of the samples, interpolated from the values at the nodes."""
        along_x, along_y = self._interpolation
        return along_y[rows] @ on_pupil @ along_x.T

    def _nodes(self, points: Doubles) -> Doubles:
        """Return the Chebyshev nodes between -1 and 1 that the layer needs."""
        # Points on the edges of the layer along all of its diagonals, and some between.
        values = np.column_stack([points[:, :2] / points[:, 2:], 1 / points[:, 2]])
        along = ((values - values.mean(0)) / np.maximum(np.ptp(values, axis=0), 1e-300)) @ _DIAGONALS.T
        between = np.linspace(0, len(points) - 1, min(len(points), _TRIED)).astype(np.int64)
        some = np.unique(np.concatenate([along.argmin(0), along.argmax(0), between]))
        radius = np.sqrt((np.arange(_TRIED) + 0.5) / _TRIED)
        # A sunflower's pattern covers the pupil evenly.
        angle = np.arange(_TRIED) * (math.pi * (3 - math.sqrt(5)))
        x = radius * np.cos(angle)
        y = radius * np.sin(angle)
        exact = self._remainder(x * self._lens.pupil.radius, y * self._lens.pupil.radius, points, some)
        scale = self._lens.pupil.radius / self._half
        # Numbers of Chebyshev nodes across the pupil that are tried, one after another.
        for count in range(6, 49, 2):
            nodes = np.cos((np.arange(count) + 0.5) * (math.pi / count))
            at = [mesh.ravel() * self._half for mesh in np.meshgrid(nodes, nodes)]
            factors = self._remainder(at[0], at[1], points, some)
            across, down = (_interpolation(nodes, position * scale, np.float64) for position in (x, y))
            interpolated = np.einsum("pj,pi,jin->pn", down, across, factors.reshape(count, count, -1), optimize=True)
            if np.all(np.abs(interpolated - exact) <= _TOLERANCE * np.abs(exact).max(0)):
                return nodes
        x, y, g = points.mean(0)
        raise InputError(
            f"points about ({x:g}, {y:g}, {g:g}): the wavefronts of their field differ too much across the pupil to be "
            "computed together; use a smaller field or aperture_radius"
        )

    def _remainder(self, x: Doubles, y: Doubles, points: Doubles, indices: Any) -> NDArray[np.complex128]:
        """Return the factor B exp(2 pi i r) of the field at m pupil positions for some points, (m, n)."""
        point = tuple(points[indices].T)
        waves = self._lens.path((x[:, None], y[:, None]), point, self._wavelength)
        waves = self._carrier.remainder(waves, x, y, indices)
        amplitude = self._lens.amplitude((x[:, None], y[:, None]), point)
        amplitude = amplitude / np.sqrt(passed_power(self._lens, points[indices]))
        return amplitude * np.exp(2j * math.pi * waves)


def carrier_type(lens: ThinLens, points: Doubles, grid: PupilGrid) -> type[Spheres | Tilts]:
    """Return the kind of carrier waves that leaves the smallest remainder: spheres behind an ideal lens, else tilts."""
    # Largest width of the window in which spheres are summed, over that of the pupil.
    spheres = lens.model == "ideal" and Spheres.window(lens, points, grid) <= 4.0 * grid.count
    return Spheres if spheres else Tilts


def layers(system: OpticalSystem, lens: ThinLens, points: Doubles) -> list[Integers]:
    """Return the indices of the points (n, 3) of each layer of distance."""
    defocus = lens.pupil.radius**2 / (2 * in_millimetres(system.wavelength)) / points[:, 2]
    order = np.argsort(defocus, kind="stable")
    span = defocus[order] - defocus[order[0]]
    # 2.0: Largest range of the defocus of a layer's points at the pupil's edge, in waves.
    count = max(1, math.ceil(span[-1] / 2.0))
    layer = np.minimum(span * (count / max(span[-1], 1e-300)), count - 1).astype(int)
    return np.split(order, np.flatnonzero(np.diff(layer)) + 1)


def passed_power(lens: ThinLens, points: Doubles) -> Doubles:
    """Return the squared amplitude of each point's light, integrated over the pupil, (n,)."""
    # 8 rings: exact for polynomials of degree 15.
    nodes, weights = np.polynomial.legendre.leggauss(8)
    radius = lens.pupil.radius * np.sqrt((nodes + 1) / 2)
    angle = 2 * math.pi * np.arange(_SPOKES) / _SPOKES
    x, y = (np.outer(radius, turn(angle)).ravel()[:, None] for turn in (np.cos, np.sin))
    amplitude = lens.amplitude((x, y), (points[:, 0], points[:, 1], points[:, 2]))
    area = math.pi * lens.pupil.radius**2
    return np.repeat(weights / 2, _SPOKES) @ amplitude**2 * (area / _SPOKES)


def _completed(
    basis: NDArray[np.complex128], factors: NDArray[np.complex128]
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Return a basis extended by functions that factors (m, n) need, and the factors' coefficients.

    Points far from most other points need such functions.
    """
    power = _squares(factors)
    while True:
        coefficients = basis.conj().T @ factors
        error = 1 - _squares(coefficients) / power
        # 256: Points that miss at most from which products are found together.
        worst = np.argsort(error)[-256:]
        worst = worst[error[worst] > _MISSED**2]
        if not len(worst):
            return basis, coefficients
        missed = factors[:, worst] - basis @ coefficients[:, worst]
        added, strength, _ = np.linalg.svd(missed, full_matrices=False)
        added = added[:, strength > 0.5 * _MISSED * math.sqrt(power[worst].min())]
        # Orthogonal to the others in spite of rounding; those stay as they are.
        basis = np.hstack([basis, np.linalg.qr(added - basis @ (basis.conj().T @ added))[0]])


def _squares(columns: NDArray[np.complex128]) -> Doubles:
    """Return the squared norm of each column."""
    return (columns.real**2 + columns.imag**2).sum(0)


def _interpolation(nodes: Doubles, at: Doubles, kind: type = np.float32) -> Array:
    """Return the matrix of polynomial interpolation from Chebyshev nodes to positions between -1 and 1."""
    degree = len(nodes) - 1
    chebyshev = np.polynomial.chebyshev.chebvander
    return np.asarray(chebyshev(at, degree) @ np.linalg.inv(chebyshev(nodes, degree)), kind)
