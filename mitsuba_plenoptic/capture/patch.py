r"""Fields of radiators on a patch of the detector, many at a time.

A scene point lights a small patch of the MLA. There its field is a sum of plane waves, one for each direction
cosine s from a pupil point P to the centre Mc of the patch, times a common curvature (the Debye integral with its
quadratic term kept; Born and Wolf, "Principles of Optics", section 8.8):

.. math:: u(M_c + \mu) = \frac{ds^2}{\lambda} e^{i k \mu^2 / 2 R_0}
          \sum_s A(s) \, e^{i k (|P - X| - P^2 / 2 f_1 + R - R_0)} \, e^{i k s \cdot \mu},
          \qquad P = M_c - R s, \quad R = \frac{b}{\sqrt{1 - s^2}}

with :math:`A = \mathrm{pupil}(P) \, g R^2 / (|P - X|^2 b)`, so that :math:`\sum |A|^2 ds^2` is the power through the
pupil. The sum is an inverse FFT of which few inputs are not zero. Curvature and microlens phase are products of
a function of x and one of y, so the transforms to the MLA and back to the spectrum are done axis by axis, and rows
outside the pupil never. The transfer function to the detector is that of the angular spectrum.

All of this is done in the frame that is turned with the microlens lattice about the axis, in which the main lens is
the same. Where the microlenses are no product of a function of x and one of y, as on a hexagonal lattice, the field
is there on the MLA in both axes, which costs about twice the time.

The tilt of the chief ray is rounded to a whole number of frequency samples and left out: it shifts the spectrum,
and the intensity does not feel it. So the pitch has to hold only the cone of the pupil and the microlens, and
some of the light that the edges of the microlenses scatter.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..lattice import turn
from ..optics.free_space import transfer
from ..optics.main_lens import main_lens
from ..optics.microlens_orders import axis_transmission, plane_transmission
from ..optics.microlenses import is_separable
from ..optics.phase import in_millimetres, phasor, soft_edge
from ..optics.sampling import fast_length
from ..runtime.backend import backend
from ..runtime.fft import Field, as_field, fft, pack
from ..runtime.indexing import split
from .grid import Grid, Placement
from .pupil_weights import PupilWeights


@dataclass(frozen=True)
class _Sizes:
    """How much is done at a time.

    Attributes
    ----------
    group : int
        Samples of the fields that are transformed together: so many that the calls cost little.
    block : int
        Samples of a block, which stays in a core's own cache; on CUDA there is nothing to gain from blocks.
    """

    group: int
    block: int


_PROCESSOR = _Sizes(group=2**17, block=2**16)
_CUDA = _Sizes(group=2**25, block=2**31)


class Workspace:
    """Memory for the transforms of a batch's radiators."""

    def __init__(self, batch: PatchBatch) -> None:
        arrays, count, m = batch.libraries.arrays, batch.together, batch.mla_samples
        self.rows = arrays.empty((count, batch.pupil.shape[1], m), np.complex64)
        longest = max(_largest(_blocks(size, m, batch.sizes.block)) for size in (batch.samples, m))
        self.columns = arrays.empty((count, longest, m), np.complex64)
        self.plane = arrays.empty((0 if batch.separable else count, m, batch.samples), np.complex64)
        self.field = arrays.empty((count, batch.samples, batch.samples), np.complex64)


class PatchBatch:
    """The fields of radiators whose patches have one size, ready to be transformed.

    Parameters
    ----------
    grid : Grid
        The grid that they lie on.
    placement : Placement
        Of these radiators.
    positions : float64 array (n, 3)
        Scene points in the frame of the lattice.
    amplitudes : float64 array (n,)
        Factors on the fields.
    weights : PupilWeights, optional
        Relative power over the pupil.
    """

    def __init__(
        self,
        grid: Grid,
        placement: Placement,
        positions: NDArray[np.float64],
        amplitudes: NDArray[np.float64],
        weights: PupilWeights | None,
    ) -> None:
        self.libraries = backend()
        self.sizes = _CUDA if self.libraries.is_cuda else _PROCESSOR
        self.samples = int(placement.samples[0])
        self.corner = placement.corner
        step = in_millimetres(grid.wavelength) / (self.samples * grid.pitch)
        finest = float(step.min())
        half = 2 * grid.cosine / finest
        # Orders that would fold back into the kept band are cut; a few more samples keep those of use.
        self.mla_samples = max(self.samples, fast_length(0.87 * (self.samples + half)))
        highest = min(self.samples + half, 2 * self.mla_samples - self.samples - half) / 2 * finest
        self.chief = (placement.first + placement.last) // 2
        self.pupil, power = self._pupil(grid, placement, positions, step, weights)
        arrays = self.libraries.arrays
        lit = power > 0
        scale = arrays.asarray(step.prod() * amplitudes) / arrays.sqrt(arrays.where(lit, power, 1))
        scale = arrays.where(lit, scale, 0)
        scale /= in_millimetres(grid.wavelength) * float(self.mla_samples) ** 2
        self.separable = is_separable(grid.camera)
        self.along_x, self.along_y = self._curvature_and_lenses(grid, placement, scale, highest)
        self.lenses = None if self.separable else self._lenses(grid, placement, highest)
        self.transfer = self._transfer(grid, step)

    def _pupil(
        self,
        grid: Grid,
        placement: Placement,
        positions: NDArray[np.float64],
        step: NDArray[np.float64],
        weights: PupilWeights | None,
    ) -> tuple[Field, NDArray[np.float64]]:
        """Plane waves from the pupil, (n, directions, directions), and each radiator's power through it."""
        types = self.libraries.types
        lens, lam = main_lens(grid.camera), in_millimetres(grid.wavelength)
        count = len(positions)
        size = int((placement.last - placement.first).max()) + 1
        index = dr.arange(types.UInt32, count * size * size)
        radiator, row, column = split(types, index, size, size)

        def value(numbers: NDArray[Any]) -> Any:
            return dr.gather(types.Float64, types.Float64(np.ascontiguousarray(numbers, np.float64)), radiator)

        def constant(number: float) -> Any:
            return dr.opaque(types.Float64, number)

        start = grid.origin + placement.corner * grid.pitch - placement.image
        chief_path = np.sqrt((placement.image**2).sum(1) + lens.pupil_distance**2)
        nx = types.Float64(column) + value(placement.first[:, 0])
        ny = types.Float64(row) + value(placement.first[:, 1])
        sx, sy = nx * constant(step[0]), ny * constant(step[1])
        b = constant(lens.pupil_distance)
        R = b / dr.sqrt(1 - sx * sx - sy * sy)
        pupil = Px, Py = value(placement.image[:, 0]) - R * sx, value(placement.image[:, 1]) - R * sy
        point = value(positions[:, 0]), value(positions[:, 1]), value(positions[:, 2])
        waves = lens.path(pupil, point, grid.wavelength) + (R - value(chief_path)) / constant(lam)
        start[:, 1] *= grid.pitch[0] / grid.pitch[1]
        waves += (nx * value(start[:, 0]) + ny * value(start[:, 1])) / constant(self.samples * grid.pitch[0])
        # The power is that of the hard edge.
        sample = R * constant(math.sqrt(step.prod()) * grid.band.edge)
        cover = soft_edge(types.Float(lens.inside(pupil) / sample))
        bright = types.Float(lens.amplitude(pupil, point) * R * R / b)
        power = types.Float64(bright * bright * cover)
        if weights is not None:
            passed, amplitude = weights.at(radiator, *turn(Px, Py, grid.rotation), lens.pupil_radius, sample)
            power *= types.Float64(passed)
            cover *= amplitude
        power = dr.block_sum(power, size * size) * step.prod()
        packed = pack(phasor(waves) * (bright * cover))
        dr.eval(packed, power)
        return as_field(packed, (count, size, size)), self.libraries.from_drjit(power)

    def _curvature_and_lenses(
        self, grid: Grid, placement: Placement, scale: Any, highest: float
    ) -> tuple[Field, Field]:
        """Factors on the MLA along x and along y, (n, samples); those along y carry the scale.

        The microlenses are among them if they are such a product.
        """
        types = self.libraries.types
        camera, lam = grid.camera, in_millimetres(grid.wavelength)
        lenses = axis_transmission(camera, grid.wavelength, highest) if self.separable else None
        index = dr.arange(types.UInt32, len(scale) * self.mla_samples)
        _, radiator, sample = split(types, index, len(scale), self.mla_samples)
        square = (placement.image**2).sum(1) + main_lens(camera).pupil_distance ** 2
        factors = []
        for axis, size in ((0, np.ones(len(scale))), (1, scale)):

            def value(numbers: Any) -> Any:
                if isinstance(numbers, np.ndarray):
                    numbers = np.ascontiguousarray(numbers)
                return dr.gather(types.Float64, types.Float64(numbers), radiator)

            m = value(self._corner(grid, placement)[:, axis])
            m += types.Float64(sample) * dr.opaque(types.Float64, self._mla_pitch(grid)[axis])
            mu = m - value(placement.image[:, axis])
            # path from the pupil: (mu^2 - (s mu)^2) / 2 R, of which the part along the other axis is tiny
            curvature = (1 - placement.image[:, axis] ** 2 / square) / (2 * lam * np.sqrt(square))
            shift = (placement.first - self.chief)[:, axis] + self.samples // 2
            factor = phasor(mu * mu * value(curvature) + types.Float64(sample) * value(shift / self.mla_samples))
            if lenses is not None:
                factor *= lenses.along(m, axis)
            factor *= types.Float(value(size))
            factors.append(as_field(pack(factor), (len(scale), self.mla_samples)))
        return factors[0], factors[1]

    def _lenses(self, grid: Grid, placement: Placement, highest: float) -> Field:
        """Transmission of the microlenses, (n, samples along y, samples along x)."""
        types = self.libraries.types
        count, size = len(placement.image), self.mla_samples
        radiator, row, column = split(types, dr.arange(types.UInt32, count * size * size), size, size)
        corner, pitch = self._corner(grid, placement), self._mla_pitch(grid)
        x, y = (
            dr.gather(types.Float64, types.Float64(np.ascontiguousarray(corner[:, axis])), radiator)
            + types.Float64(index) * dr.opaque(types.Float64, pitch[axis])
            for axis, index in ((0, column), (1, row))
        )
        lenses = plane_transmission(grid.camera, grid.wavelength, highest).at(x, y)
        return as_field(pack(lenses), (count, size, size))

    def _corner(self, grid: Grid, placement: Placement) -> NDArray[np.float64]:
        """Places of the first samples on the MLA, (n, 2)."""
        return grid.origin + placement.corner * grid.pitch

    def _mla_pitch(self, grid: Grid) -> NDArray[np.float64]:
        """Distance between samples on the MLA along x and y."""
        return self.samples * grid.pitch / self.mla_samples

    def _transfer(self, grid: Grid, step: NDArray[np.float64]) -> Field:
        """Transfer function from MLA to detector, (along x, along y), of all directions of all the radiators."""
        types = self.libraries.types
        low, high = self.chief.min(0), self.chief.max(0)
        columns, rows = (int(size) for size in high - low + self.samples)
        index = dr.arange(types.UInt32, rows * columns)
        _, row, column = split(types, index, rows, columns)
        first = low - self.samples // 2
        sx = (types.Float64(column) + dr.opaque(types.Float64, float(first[0]))) * dr.opaque(types.Float64, step[0])
        sy = (types.Float64(row) + dr.opaque(types.Float64, float(first[1]))) * dr.opaque(types.Float64, step[1])
        packed = pack(transfer(sx, sy, grid.camera.detector_distance, grid.wavelength))
        return self.libraries.arrays.ascontiguousarray(as_field(packed, (rows, columns)).T)

    @property
    def together(self) -> int:
        """Radiators to transform at a time: small ones in groups, so that the calls cost little."""
        return min(len(self.chief), max(1, self.sizes.group // self.mla_samples**2))

    def to_detector(self, start: int, stop: int, work: Workspace) -> Iterator[tuple[int, slice, Field]]:
        """Transform the fields of radiators start ... stop to the detector.

        Everything is done on blocks that stay in a core's own cache: along x for the directions of the pupil; then,
        turned over, along y to the MLA, to the spectrum and to the detector; at last along x to the detector.

        Parameters
        ----------
        start, stop : int
            Which radiators of the batch, at most `together`.
        work : Workspace
            Overwritten.

        Yields
        ------
        radiator : int
            Number in the batch.
        along_y : slice
            Which samples along y the part of its field has.
        field : complex64 array (samples along x, samples along y)
            The part, in memory that is used again.
        """
        n, field = self.samples, work.field[: stop - start]
        if self.lenses is None:
            self._pass_product(start, stop, work)
        else:
            self._pass_plane(start, stop, work, self.lenses)
        for block in _blocks(n, n, self.sizes.block):
            detector = _inverse(field[..., block], axis=1)
            for part, radiator in zip(detector, range(start, stop), strict=True):
                yield radiator, block, part

    def _pass_product(self, start: int, stop: int, work: Workspace) -> None:
        """Take the fields from the pupil to the detector, along y only: through microlenses axis by axis."""
        n, m, count = self.samples, self.mla_samples, stop - start
        directions = self.pupil.shape[1]
        rows = work.rows[:count]
        rows[..., :directions] = self.pupil[start:stop]
        rows[..., directions:] = 0
        rows = _inverse(rows, axis=2)
        rows *= self.along_x[start:stop, None, :]
        rows = _forward(rows, axis=2)
        for block in _blocks(n, m, self.sizes.block):
            columns = work.columns[:count, : block.stop - block.start]
            columns[..., :directions] = rows[..., block].transpose(0, 2, 1)
            columns[..., directions:] = 0
            columns = _inverse(columns, axis=2)
            columns *= self.along_y[start:stop, None, :]
            self._across_space(columns, block, start, stop, work)

    def _pass_plane(self, start: int, stop: int, work: Workspace, lenses: Field) -> None:
        """Take the fields from the pupil to the detector, along y only: through microlenses of both axes at once."""
        n, m, count = self.samples, self.mla_samples, stop - start
        directions = self.pupil.shape[1]
        rows = work.rows[:count]
        rows[..., :directions] = self.pupil[start:stop].transpose(0, 2, 1)
        rows[..., directions:] = 0
        rows = _inverse(rows, axis=2)
        rows *= self.along_y[start:stop, None, :]
        for block in _blocks(m, m, self.sizes.block):
            columns = work.columns[:count, : block.stop - block.start]
            columns[..., :directions] = rows[..., block].transpose(0, 2, 1)
            columns[..., directions:] = 0
            columns = _inverse(columns, axis=2)
            columns *= self.along_x[start:stop, None, :]
            columns *= lenses[start:stop, block]
            work.plane[:count, block] = _forward(columns, axis=2)[..., :n]
        for block in _blocks(n, m, self.sizes.block):
            columns = work.columns[:count, : block.stop - block.start]
            columns[...] = work.plane[:count, :, block].transpose(0, 2, 1)
            self._across_space(columns, block, start, stop, work)

    def _across_space(self, columns: Field, block: slice, start: int, stop: int, work: Workspace) -> None:
        """Take some columns of the fields, spectra along x and places on the MLA along y, to the detector along y."""
        n = self.samples
        chief = self.chief[start:stop] - self.chief.min(0)
        spectrum = _forward(columns, axis=2)[..., :n]
        for part, (x, y) in zip(spectrum, chief, strict=True):
            part *= self.transfer[x + block.start : x + block.stop, y : y + n]
        work.field[: stop - start, block] = _inverse(spectrum, axis=2)


def _blocks(count: int, length: int, samples: int) -> Iterator[slice]:
    """Cut `count` rows of some length into blocks of about so many samples."""
    parts = max(1, round(count * length / samples))
    edges = [count * part // parts for part in range(parts + 1)]
    return (slice(*pair) for pair in itertools.pairwise(edges))


def _largest(blocks: Iterator[slice]) -> int:
    return max(block.stop - block.start for block in blocks)


def _forward(field: Field, axis: int) -> Field:
    """Transform unscaled, on this thread alone."""
    return fft(field, axis=axis, workers=1)


def _inverse(field: Field, axis: int) -> Field:
    """Transform back unscaled, on this thread alone."""
    return fft(field, axis=axis, inverse=True, norm="forward", workers=1)
