r"""Diffraction in phase space: the spread of rays of incoherent light by the main lens's pupil and the microlenses.

In front of the pupil the Wigner function of incoherent light is the radiance along rays (Walther, J. Opt. Soc. Am. 58,
1256 (1968); Bastiaans, Opt. Commun. 25, 26 (1978)). Two apertures spread it. Behind the *pupil* a ray through the pupil
point P keeps P, and meets the array at m + x instead of m, with the signed density

.. math:: K_p(P, x) = \frac{1}{(\lambda b)^2} \int O_P(\eta)\, e^{-2 \pi i \eta \cdot x / \lambda b}\, d^2\eta, \qquad
          O_P(\eta) = t(P + \eta/2)\, t^*(P - \eta/2).

Behind the *array* the ray lands on the detector at an offset p from the ray model's position, with a signed density
:math:`K_a(m, p) \approx \sum_n a_n(m) \varphi_n(p)`, where :math:`a_n` are functions of m over a lens: see
`array_kernels` and `lens_functions`. A capture becomes a ray capture of a few values per ray, followed by one
convolution for each value:

.. math:: I = \sum_n \varphi_n * \sum_{rays} L\, A_n, \qquad A_n(m, P) = \int K_p(P, x)\, a_n(m + x)\, d^2x .

All of this depends on the camera and the wavelength, and not on the scene. Coordinates of microlens points are relative
to the centre of the lens. The coefficients are tabulated here, and interpolated with Dr.Jit on the active device.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy
from numpy.typing import NDArray

from ..camera import PlenopticCamera, Round
from ..errors import InputError, short_repr
from ..fields import OpticalSystem, opaque_lattice
from ..optics import in_millimetres
from ..runtime import (
    Doubles,
    Floats,
    Pair,
    Shape,
    Sizes,
    begin_step,
    drjit_array,
    empty_packets,
    fft,
    monomials,
    on_all_cores,
    require_memory,
    single_threaded_blas,
)
from .accuracy import FINER, USUAL, WaveAccuracy
from .array_field import LensWaves
from .array_kernels import cell_kernels, covariance_of_values, lens_functions, oblique_kernels, sampled_kernels
from .lens_functions import LegendreProducts, LensFunctions
from .oblique import Oblique

FINE = 0.005
"""Accuracy below which finer plans are made."""

_PACKET = 4
"""Count of coefficients that are gathered at a time."""

_BYTES = 2**30
"""Bytes of tables that are cached, beyond which those that a capture does not need are freed, the oldest first. A table
takes some 18 MiB, and 40 MiB at f/2."""

_tables: dict[tuple, Table] = {}
_Jitter = tuple[Any, Any, Any, Any]


class TableNode(NamedTuple):
    """The window of the table at one node of the pupil's radius, in the lattice frame."""

    # Side lengths, which are whole multiples of the lattice periods.
    sides: Pair
    # Samples along the sides.
    counts: Shape
    # Number of intervals between nodes over a quarter turn.
    angular: int


@dataclass(frozen=True, eq=False)
class PhaseSpace:
    """Diffraction of one camera at one wavelength, as coefficients of rays and kernels of images."""

    camera: PlenopticCamera
    wavelength: float
    accuracy: WaveAccuracy
    waves: LensWaves
    system: OpticalSystem
    # Whether a ray lands where its point on the lens sends it, instead of where the lens's centre does. Far from the
    # microlenses' focus a few functions cannot describe the difference. The spread by the pupil is then taken as that
    # of the whole pupil for all of its points.
    lands_by_point: bool
    # Functions of a ray's point on a lens, and combinations of the changes of their kernels with light's direction.
    functions: LensFunctions
    oblique: Oblique
    # Covariance of the values of an image's rays, in random light.
    covariance: Doubles
    # Nodes of the table along the pupil's radius.
    nodes: list[TableNode]
    # The plan whose functions and nodes it has.
    basis: PhaseSpace | None
    _computed: dict[Any, Doubles] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        # Taken `at_wavelength` if it has glass.
        camera: PlenopticCamera,
        wavelength: float,
        accuracy: WaveAccuracy = USUAL,
        *,
        # Extreme wavelengths of the plans with which it is used, whose rays land alike and whose tables have the same
        # nodes. Default: its own.
        shortest: float | None = None,
        longest: float | None = None,
        # Whether another plan with which it is used is far from focus, as all rays must land alike.
        beside_far: bool = False,
        # The plan whose functions and nodes of the table it has.
        basis: PhaseSpace | None = None,
    ) -> Self:
        """Return the plan of a camera whose detector is near the microlenses' focus."""
        waves = LensWaves(camera, wavelength)
        system = OpticalSystem(camera, wavelength)
        shortest = shortest or wavelength
        lands_by_point = beside_far or waves.defocus * wavelength / shortest > USUAL.most_phase
        for name, refused, rule in _rules(waves, lands_by_point):
            if refused:
                raise InputError(f"{name} = {short_repr(getattr(camera, name))}: for signed rays it must be {rule}")
        if basis:
            grown = np.divide(waves.lattice.period(), basis.waves.lattice.period()).tolist()
            functions = replace(basis.functions, scale=basis.functions.scale * grown[0])
            oblique = basis.oblique
            covariance = basis.covariance
            # Windows grow with the lattice.
            nodes = [node._replace(sides=(node.sides[0] * grown[0], node.sides[1] * grown[1])) for node in basis.nodes]
        else:
            begin_step("functions of diffraction")
            degree = accuracy.degree + 2 * (waves.defocus > USUAL.high_defocus and not lands_by_point)
            functions = lens_functions(waves, degree, accuracy.tolerance, lands_by_point)
            oblique = Oblique.nothing(functions.count)
            if not lands_by_point and functions.count > 1:
                oblique = oblique_kernels(waves, functions, degree, accuracy.tolerance)
            covariance = covariance_of_values(waves, functions, oblique)
            nodes = table_nodes(waves, shortest, longest or wavelength, accuracy)
        return cls(
            camera, wavelength, accuracy, waves, system, lands_by_point, functions, oblique, covariance, nodes, basis
        )

    @property
    def options(self) -> tuple:
        """All that kernels depend on beside the camera, the plan about which it is expanded, and the wavelength."""
        return self.accuracy, self.lands_by_point

    @property
    def tolerance(self) -> float:
        """Part of images of random light that may be missing for want of images of the places in a pixel."""
        return self.accuracy.tolerance

    @property
    def reach(self) -> float:
        """Distance in mm to which captures need kernels."""
        return 2.5 * max(self.camera.mla_pitches)

    @property
    def table(self) -> Table:
        """Coefficients of rays at each node of the pupil's radius: (nodes of the angle, rows, columns, functions).

        Cameras that differ only in parameters without effect on the table, such as their detectors, share it. Plans do
        not store it, as those of many cameras, for example in a fit, would fill the memory.
        """
        tabulate([self])
        return _tables[self.key]

    @property
    def start(self) -> PhaseSpace:
        """The plan about which this one is expanded: by default the plan itself."""
        return self.basis or self

    @property
    def key(self) -> tuple:
        """All that the table depends on."""
        camera = self.camera
        return (
            *(camera.mla_lattice, camera.mla_pitches, camera.mla_aperture, camera.mla_fill),
            *(camera.pupil_radius, camera.pupil_distance, camera.aperture, self.wavelength, *self.nodes),
            self.functions.combined.tobytes(),
        )

    @property
    def layout(self) -> tuple:
        """All that the places of coefficients in the table depend on, but the lattice."""
        return self.camera.pupil_radius, *self.nodes

    @property
    def shapes(self) -> list[Sizes]:
        """Shapes of the table's arrays."""
        return [(node.angular + 1, *reversed(node.counts), self.functions.count) for node in self.nodes]

    @single_threaded_blas()
    def tabulated(self) -> list[Floats]:
        """Return the arrays of the table of coefficients, computed anew."""
        arrays = [np.empty(shape, np.float32) for shape in self.shapes]
        reach = in_millimetres(self.wavelength) * self.camera.pupil_distance
        functions = self.functions
        # Functions are even or odd along both axes: their values over a quarter of the aperture give all coefficients.
        grids: tuple = self.waves.aperture_grid(USUAL.function_samples)
        u, v, inside = (grid[len(grid) // 2 :, len(grid) // 2 :] for grid in grids)
        spacing = 2 * u[0, 0]
        values = functions.values(u, v, functions.functions) * (2 * spacing) ** 2
        values = np.where(inside, values, 0).astype(np.float32)
        odd_u, odd_v = np.array(functions.odd).T[..., None, None]

        def fill(radial: int) -> None:
            node = self.nodes[radial]
            # Fourier coefficients over the window, for the frequencies that pass the pupil.
            products = values
            gains = []
            lags = []
            inner = self._distance(max(radial - 1, 0))
            for axis, along, odd in ((0, u[0], odd_u), (1, v[:, 0], odd_v)):
                side = node.sides[axis]
                count = node.counts[axis]
                most = min((count - 1) // 2, int(2 * math.sqrt(self.camera.pupil_radius**2 - inner**2) * side / reach))
                # Opposite frequencies give conjugate parts: those of half the plane stand for both.
                order = np.arange(most + 1)
                angles = 2 * np.pi / side * np.outer(along, order)
                waves = np.where(odd, *(f(angles).astype(np.float32) for f in (np.sin, np.cos)))
                products = np.swapaxes(products @ waves, 1, 2)
                if axis:
                    order = np.concatenate([order, -order[:0:-1]])
                    mirrored = products[:, :0:-1] * np.where(odd, np.float32(-1), np.float32(1))
                    products = np.concatenate([products, mirrored], axis=1)
                # Samples are in the middle of cells. The gain compensates the damping by linear interpolation.
                phases = np.exp(np.pi * 1j * order * (1 / count - 1)) * np.sinc(order / count) ** -2 * count / side
                gains.append(phases * np.sinc(order * (spacing / side)))
                lags.append(np.asarray(order * (reach / side), np.float32))
            factors = (-1j) ** (odd_u.astype(int) + odd_v) * gains[1][:, None] * gains[0]
            spectra = products * factors.astype(np.complex64)
            columns, rows = node.counts
            most = len(lags[1]) // 2
            ends = slice(most + 1), slice(-most or rows, None)
            spectrum = np.zeros((functions.count, rows, len(lags[0])), np.complex64)
            for angle in range(node.angular + 1):
                passed = self._overlap(radial, angle, lags[0], lags[1][:, None])
                for end in ends:
                    np.multiply(spectra[:, end], passed[end], out=spectrum[:, end])
                lines = scipy.fft.ifft(spectrum, axis=1, workers=1)
                image = scipy.fft.irfft(lines, columns, axis=2, workers=1, overwrite_x=True)
                arrays[radial][angle] = np.moveaxis(image, 0, -1)

        on_all_cores(fill, range(len(self.nodes)))
        return arrays

    def kernels(self, step: float, reach: float, kind: int = 0) -> Doubles:
        """Return the kernels (n, k, k) of one kind of lenses, at least to a distance; see `array_kernels`."""
        key = step, reach, kind
        if key in self._computed:
            return self._computed[key]
        of_kind = self.waves.kinds[kind]
        samples = self.waves.kernel_samples(step, reach, kind)
        bytes_of_sample = 8.0
        count = 2 * samples[2] + 1
        if self.lands_by_point:
            # Transforms of the aperture, their products, and the kernels themselves.
            bytes_of_sample = 32.0
            count = 2 * (math.ceil(reach / step) + 1) * self.waves.cell_parts(step, of_kind)
        spot = in_millimetres(self.wavelength) * of_kind.distance / self.camera.lattice.aperture_width
        # As for pixels far larger than a lens's diffraction pattern.
        require_memory(
            bytes_of_sample * self.functions.count * float(count) ** 2,
            f"detector_width = {self.camera.detector_width:g}: pixels of {self.camera.pixel_size:.3g} mm behind lenses "
            f"whose diffraction spreads {self.wavelength:g} nm by {spot:.2g} mm, need kernels of {count} x {count} "
            "samples",
        )
        if self.lands_by_point:
            self._computed[key] = cell_kernels(self.waves, self.functions, step, reach, of_kind)
        else:
            self._computed[key] = self.sampled_kernels(step, samples, kind)
        return self._computed[key]

    def sampled_kernels(self, step: float, samples: tuple[int, int, int], kind: int) -> Doubles:
        """Return `kernels` with a given sampling, even where another sampling would suit better."""
        return sampled_kernels(self.waves, self.functions, self.oblique, step, samples, self.waves.kinds[kind])

    def _distance(self, radial: Any) -> Any:
        return along_radius(self.camera.pupil_radius, radial / self.accuracy.radial)

    def _overlap(self, radial: int, angle: int, lag_u: Floats, lag_v: Floats) -> Floats:
        """Return O_P over the power at P, averaged over the part of the pupil for which interpolation uses a node."""
        radius = self.camera.pupil_radius
        aperture = self.camera.aperture
        # Points of a Fibonacci lattice, with the density of linear interpolation's weights along both axes.
        count, step = USUAL.overlap_points
        uniform = 2 * ((np.outer((1, step), np.arange(count)) + 0.5) / count % 1) - 1
        aside, turned = np.sign(uniform) * (1 - np.sqrt(1 - np.abs(uniform)))
        if radial in (0, self.accuracy.radial):
            # Nodes are on one side of those on the axis and at the rim.
            aside = np.abs(aside) if radial == 0 else -np.abs(aside)
        distance = self._distance(radial + aside)
        direction = (angle + turned) * (math.pi / 2 / self.nodes[radial].angular)
        # The area elements of steps of the node's index; on the axis any values give the same result.
        area = ((self.accuracy.radial - radial - aside) * distance).astype(np.float32)
        points = (distance * np.stack([np.cos(direction), np.sin(direction)])).astype(np.float32)
        # Where no light passes, the light of what is tabulated is multiplied by 0.
        dark = USUAL.least_transmission
        passed = np.maximum(aperture.power(*(points / radius)), dark)
        lags = np.stack([lag.ravel() for lag in np.broadcast_arrays(lag_u, lag_v)])
        room = np.float32(radius**2) - np.square(lags).sum(0) / 4
        total = np.zeros_like(room)
        # 16: Points at a time, whose pairs fit into a cache.
        for some in (slice(first, first + 16) for first in range(0, count, 16)):
            # Both points P + lag / 2 and P - lag / 2 are within the pupil.
            both = points[:, some].T @ lags
            np.abs(both, out=both)
            both += np.square(points[:, some]).sum(0)[:, None]
            np.less_equal(both, room, out=both)
            if aperture != Round():
                ends = [(points[:, some, None] + side * lags[:, None] / 2) / radius for side in (1, -1)]
                both *= np.sqrt(math.prod(np.maximum(aperture.power(*end), dark) for end in ends))
            total += area[some] @ both
        return np.asarray((total / (area * passed).sum()).reshape(len(lag_v), -1), np.float32)

    def parts(self, fine: bool) -> int:
        """Return the number of cells of the grid across a pixel, for usual or finer plans."""
        if self.lands_by_point:
            return 1  # kernels are integrated over pixels
        highest = self.camera.pixel_size / self.waves.widths[0]
        most = FINER if fine or highest > USUAL.coarse_pixel else USUAL
        return min(math.ceil((FINER if fine else USUAL).cells * highest), most.most_cells)

    def arguments(self, point: Pair, pupil: Pair) -> list:
        """Return the numbers of which a ray's coefficients are polynomials: its point on a lens over the reach."""
        return [coordinate / self.functions.scale for coordinate in self.waves.lattice.to_frame(*point)]

    def moved(self, camera: PlenopticCamera) -> PhaseSpace:
        """Return the plan of a slightly different camera, with the same functions and nodes of the table."""
        return PhaseSpace.of(camera, self.wavelength, self.accuracy, beside_far=self.lands_by_point, basis=self)


def along_radius(radius: float, part: Any) -> Any:
    """Return the distance from the pupil's centre of a part of the nodes of its radius, which are denser at the rim."""
    return radius * (1 - (1 - part) ** 2)


def table_nodes(waves: LensWaves, shortest: float, longest: float, accuracy: WaveAccuracy) -> list[TableNode]:
    """Return the nodes of the table along the pupil's radius, each with its window and number of samples."""
    camera = waves.camera
    radius = camera.pupil_radius
    pitch = waves.lattice.pitches[0]
    # Windows are for the longest wavelength, and samples for the shortest.
    reach, least_reach = (in_millimetres(limit) * camera.pupil_distance for limit in (longest, shortest))
    unit = max(pitch, USUAL.airy_unit * reach / radius)
    oversampling = USUAL.oversampling * (1 + (unit > USUAL.wide_unit * pitch))
    nodes = []
    for index in range(accuracy.radial + 1):
        distance, inner = (along_radius(radius, max(r, 0) / accuracy.radial) for r in (index, index - 1))
        spread = USUAL.window_spreads * reach / max(radius - distance, 1e-9 * radius)
        least = (USUAL.least_window - (spread <= USUAL.narrow_spread * unit)) * unit
        width = min(accuracy.window * unit, max(least, unit + spread))
        sides = tuple(math.ceil(width / period - 1e-6) * period for period in waves.lattice.period())
        # The largest lag is perpendicular to the radius.
        step = least_reach / (2 * oversampling * 2 * math.sqrt(radius**2 - inner**2))
        step = max(step, pitch / USUAL.most_samples)
        # Between adjacent nodes the farthest points move by half a unit.
        angular = math.ceil(math.pi / 2 * max(sides) / unit)
        counts = fft.fast_length(sides[0] / step), fft.fast_length(sides[1] / step)
        nodes.append(TableNode(sides, counts, angular))
    return nodes


def _rules(waves: LensWaves, lands_by_point: bool) -> list[tuple[str, bool, str]]:
    """Return parameters, whether functions of rays and kernels do not describe their diffraction, and what does."""
    camera = waves.camera
    width = in_millimetres(waves.wavelength)
    # Smallest `mla_fill` for which the kernels are valid, by the narrowest opening in wavelengths.
    least_fill = USUAL.narrowest_opening * width * camera.mla_fill / camera.lattice.aperture_width
    # Displacement of light, in pixels, by the pupil's diffraction, where landing points vary over a lens.
    growth = max(abs(waves.convergence(kind)) * kind.distance for kind in waves.kinds)
    shift = growth * width * camera.pupil_distance / (2 * camera.pupil_radius) / camera.pixel_size
    # The range in mm of the detector's distance, for the last of the rules.
    aside = USUAL.most_phase * width / math.pi / waves.lattice.aperture_reach**2
    vergence = camera.lens_data.converges / camera.pupil_distance
    powers = [1 / f2 - vergence for f2 in camera.reduced_focal_lengths]
    near, far = (camera.mla_medium / max(power, 1e-9) for power in (min(powers) + aside, max(powers) - aside))
    limits = f"from {near:.4g} to {far:.4g} mm" if near <= far else "which several focal lengths do not allow"
    return [
        (
            "mla_fill",
            least_fill > camera.mla_fill,
            f'{least_fill:.3g} or more, openings of {USUAL.narrowest_opening:g} wavelengths; use method="points"',
        ),
        (
            "mla_shape",
            waves.aberration > USUAL.most_phase,
            "closer to a parabola, for the shortest wavelength, too; use CaptureOperator",
        ),
        ("mla_shape", not camera.microlens.is_parabolic and lands_by_point, "near the microlenses' focus"),
        (
            "detector_distance",
            lands_by_point and shift > USUAL.most_shift,
            f"closer to the microlenses' focus, {limits}",
        ),
    ]


def coefficients_of(plans: Sequence) -> list[RayCoefficients | Polynomials]:
    """Return the objects that compute the coefficients of rays for plans."""
    tabulate([plan for plan in plans if not plan.lands_by_point])
    return [Polynomials(plan) if plan.lands_by_point else RayCoefficients(plan, plan.table) for plan in plans]


def tabulate(plans: Sequence[PhaseSpace]) -> None:
    """Compute the tables of plans that are not cached.

    Tables with the same places lie side by side, so that rays find the coefficients of all wavelengths in one place.
    """
    by_key = {plan.key: plan for plan in plans}
    alike: dict[Any, list[tuple[Any, PhaseSpace]]] = {}
    for key, plan in by_key.items():
        if key not in _tables:
            alike.setdefault(plan.layout, []).append((key, plan))
    for some in alike.values():
        tables = Table.side_by_side([plan.shapes for _, plan in some])
        for key in [key for key in _tables if key not in by_key]:
            if sum(table.size for table in (*tables, *_tables.values())) > _BYTES:
                del _tables[key]
        for (key, plan), table in zip(some, tables, strict=True):
            begin_step("tables of diffraction")
            table.fill(plan.tabulated())
            _tables[key] = table


class TableNodes:
    """Nodes of a plan's table, of which a ray takes a random one near its pupil point."""

    def __init__(self, plan: PhaseSpace):
        self._radial = plan.accuracy.radial
        self._radius = dr.opaque(mi.Float, plan.camera.pupil_radius)
        self._angular = drjit_array(mi.Float, np.array([node.angular for node in plan.nodes]))

    def along(self, Pu: Any, Pv: Any, chance: Any) -> Pair:
        """Return distances from the pupil's centre over its radius, and a random neighbouring node of the radius."""
        distance = dr.sqrt(Pu * Pu + Pv * Pv) / self._radius
        position = (1 - dr.sqrt(dr.maximum(1 - distance, 0))) * self._radial
        return distance, mi.UInt(dr.minimum(dr.floor(position + chance), self._radial))

    def around(self, Pu: Any, Pv: Any, radial: Any, chance: Any) -> Any:
        """Return a random neighbouring node of the angle, at a node of the radius."""
        position = dr.atan2(dr.abs(Pv), dr.abs(Pu)) * (2 / math.pi) * dr.gather(mi.Float, self._angular, radial)
        return mi.UInt(dr.floor(position + chance))


class Table(list[NDArray]):
    """Coefficient arrays of a table's nodes, of 16 bits, one after another in `memory` (places, numbers), in packets.

    Zeros follow the arrays, for rays outside all nodes. Other tables may fill other columns of the memory.
    """

    def __init__(
        self,
        shapes: Sequence[Sizes],
        # Memory, and the table's first packet in each row; by default, memory for this table alone.
        memory: NDArray | None = None,
        first: int = 0,
    ):
        self.packets = -(-shapes[0][-1] // _PACKET)
        self.first = first
        ends = np.cumsum([math.prod(shape[:-1]) for shape in shapes])
        if memory is None:
            memory = empty_packets((int(ends[-1]) + 1, self.packets * _PACKET), np.float16)
        self.memory = memory
        packets = memory[:, first * _PACKET : (first + self.packets) * _PACKET]
        columns = packets[:, : shapes[0][-1]]
        packets[:, shapes[0][-1] :] = 0
        packets[-1] = 0
        super().__init__(rows.reshape(shape) for rows, shape in zip(np.split(columns, ends)[:-1], shapes, strict=True))

    @classmethod
    def side_by_side(cls, tables_of_shapes: Sequence[Sequence[Sizes]]) -> list[Table]:
        """Return zero tables of given shapes with the same places, in one memory."""
        together = [
            (*shape[:-1], sum(-(-shapes[0][-1] // _PACKET) * _PACKET for shapes in tables_of_shapes))
            for shape in tables_of_shapes[0]
        ]
        memory = cls(together).memory
        tables = []
        first = 0
        for shapes in tables_of_shapes:
            tables.append(cls(shapes, memory, first))
            first += tables[-1].packets
        return tables

    def fill(self, arrays: Sequence[Floats]) -> None:
        """Take the coefficients of arrays of the same shapes."""
        for rows, values in zip(self, arrays, strict=True):
            # NumPy takes 80 ns for a number that is subnormal in 16 bits, as most are far from a lens.
            rows[...] = mi.Float16(drjit_array(mi.Float, values)).numpy().reshape(values.shape)

    @property
    def size(self) -> int:
        """Bytes of the arrays."""
        return sum(array.nbytes for array in self)


class RayCoefficients:
    """The table of a `PhaseSpace`, or another table of the same layout, on the device of the active variant."""

    def __init__(self, plan: PhaseSpace, table: Table):
        self.plan = plan
        self.layout = plan.layout
        self._table = drjit_array(mi.Float16, table.memory)
        self._packets = range(table.first, table.first + table.packets)
        self._wide = table.memory.shape[1] // _PACKET
        *first, self._nowhere = np.cumsum([0] + [math.prod(array.shape[:3]) for array in table]).tolist()
        self._first = drjit_array(mi.Int, np.array(first))
        sides = np.array([n.sides for n in plan.nodes])
        counts = np.array([n.counts for n in plan.nodes])
        self._sides = [drjit_array(mi.Float, column) for column in sides.T]
        self._counts = [drjit_array(mi.Int, column) for column in counts.T]
        self._nodes = TableNodes(plan)
        self._lattice = opaque_lattice(plan.camera, mi.Float)
        # A bit for each function that changes its sign, in each quarter of the pupil.
        quarters = [
            sum(1 << n for n, (across, up) in enumerate(plan.functions.odd) if across * (q & 1) != up * (q >> 1))
            for q in range(4)
        ]
        self._signs = drjit_array(mi.UInt32, np.array(quarters))

    def __call__(self, point: Pair, pupil: Pair, jitter: _Jitter, active: Any) -> list:
        """Return the coefficients of rays from points of a lens through points of the pupil."""
        return self.read(*self.places(point, pupil, jitter, active))

    def places(self, point: Pair, pupil: Pair, jitter: _Jitter, active: Any) -> list:
        """Return the places in the table of the coefficients of rays, for `read`; see `__call__`.

        Each ray takes one node of the table at random, so that the expectation is the linear interpolation between the
        sixteen nodes around it.
        """
        u, v = self._lattice.to_frame(*point)
        Pu, Pv = self._lattice.to_frame(*pupil)
        distance, radial = self._nodes.along(Pu, Pv, jitter[0])
        active = active & (distance <= 1)
        # The table covers a quarter of the pupil; the symmetry of the lenses gives the others.
        mirrored = Pu < 0, Pv < 0
        u, v = (dr.select(turned, -coordinate, coordinate) for turned, coordinate in zip(mirrored, (u, v), strict=True))
        index = dr.gather(mi.Int, self._first, radial)
        sizes = [dr.gather(mi.Int, counts, radial) for counts in self._counts]
        index += mi.Int(self._nodes.around(Pu, Pv, radial, jitter[1])) * (sizes[0] * sizes[1])
        for axis, coordinate, chance, row in ((1, v, jitter[2], sizes[0]), (0, u, jitter[3], 1)):
            side = dr.gather(mi.Float, self._sides[axis], radial)
            size = sizes[axis]
            active &= dr.abs(coordinate) <= side / 2
            count = mi.Float(size)
            node = mi.Int(dr.floor(coordinate * (count / side) + (count / 2 - 0.5) + chance))
            # The window is periodic.
            index += dr.select(node < 0, node + size, dr.select(node >= size, node - size, node)) * row
        # The two lowest bits tell in which quarter of the pupil the ray is.
        quarter = dr.select(mirrored[0], mi.UInt32(1), 0) | dr.select(mirrored[1], mi.UInt32(2), 0)
        return [dr.select(active, mi.UInt32(index) << 2 | quarter, dr.opaque(mi.UInt32, self._nowhere << 2))]

    def read(self, index: Any) -> list:
        """Return the coefficients at `places`."""
        values = [
            mi.Float(value)
            for packet in self._packets
            for value in dr.gather(mi.Array4f16, self._table, (index >> 2) * self._wide + packet)
        ]
        signs = dr.gather(mi.UInt32, self._signs, index & 3)
        return [
            dr.reinterpret_array(mi.Float, dr.reinterpret_array(mi.UInt32, value) ^ (signs << (31 - n) & (1 << 31)))
            for n, value in enumerate(values[: self.plan.functions.count])
        ]

    def slopes(self, point: Pair, pupil: Pair, jitter: _Jitter, active: Any) -> tuple[list, list]:
        """Return the derivatives of the coefficients by the point, along the lattice's axes; see `__call__`."""
        Pu, Pv = self._lattice.to_frame(*pupil)
        _, radial = self._nodes.along(Pu, Pv, jitter[0])
        result = []
        for axis, P in enumerate((Pu, Pv)):
            # This is the slope of linear interpolation between nodes.
            before, after = (
                self(point, pupil, (*jitter[:2], *(end if i == 1 - axis else jitter[2 + i] for i in range(2))), active)
                for end in (mi.Float(0), mi.Float(1))
            )
            density = mi.Float(dr.gather(mi.Int, self._counts[axis], radial)) / dr.gather(
                mi.Float, self._sides[axis], radial
            )
            density = dr.select(P < 0, -density, density)
            result.append([(b - a) * density for a, b in zip(before, after, strict=True)])
        return result[0], result[1]


class Polynomials:
    """Coefficients of rays that land by their own points: the polynomials of a plan."""

    def __init__(self, plan: Any):
        self.plan = plan
        self.layout: tuple = (plan.functions.scale,)

    def places(self, point: Pair, pupil: Any, jitter: Any, active: Any) -> list:
        """Return the arguments of the polynomials, for `read`."""
        return list(self.plan.arguments(point, pupil))

    def read(self, u: Any, v: Any, *shares: Any) -> list:
        """Return the values of the polynomials at `places`, whose monomials are those of each share of a ray."""
        functions = self.plan.functions
        if isinstance(functions, LegendreProducts):
            return functions.at_rays(u, v)
        terms = monomials(u, v, functions.exponents)
        if shares:
            terms = [share * term for share in shares for term in terms]
        return [
            sum((term * float(c) for term, c in zip(terms, column, strict=True) if c), mi.Float(0))
            for column in functions.combined.T
        ]
