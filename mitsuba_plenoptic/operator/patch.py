r"""Fields of points on a patch of the detector, many at a time.

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
from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..runtime.backend import backend
from ..runtime.fft import Field, as_field, fft, pack
from .grid import Grid, Placement
from .patch_factors import Elements, PatchFactors
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
    """Memory for the transforms of a batch's points."""

    def __init__(self, batch: PatchBatch) -> None:
        arrays, count, m = batch.libraries.arrays, batch.together, batch.mla_samples
        self.rows = arrays.empty((count, batch.pupil.shape[1], m), np.complex64)
        longest = max(_largest(_blocks(size, m, batch.sizes.block)) for size in (batch.samples, m))
        self.columns = arrays.empty((count, longest, m), np.complex64)
        self.plane = arrays.empty((0 if batch.separable else count, m, batch.samples), np.complex64)
        self.field = arrays.empty((count, batch.samples, batch.samples), np.complex64)


class PatchBatch:
    """The fields of points whose patches have one size, ready to be transformed.

    Parameters
    ----------
    grid : Grid
        The grid that they lie on.
    placement : Placement
        Of these points.
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
        made = PatchFactors(grid, placement, positions, amplitudes, weights)
        elements = Elements.of(grid, made.highest)
        self.samples, self.mla_samples = made.samples, made.mla_samples
        self.corner, self.chief = placement.corner, made.chief
        count, directions = len(positions), made.directions
        packed, power = made.pupil(elements)
        packed = pack(packed)
        dr.eval(packed, power)
        self.pupil = as_field(packed, (count, directions, directions))
        self.separable = made.separable
        scale = made.scale(elements, power)
        self.along_x, self.along_y = (
            as_field(pack(made.along(elements, axis, scale)), (count, self.mla_samples)) for axis in (0, 1)
        )
        self.lenses = None
        if not self.separable:
            self.lenses = as_field(pack(made.lenses(elements)), (count, self.mla_samples, self.mla_samples))
        transfer = as_field(pack(made.transfer(elements)), made.transfer_shape)
        self.transfer = self.libraries.arrays.ascontiguousarray(transfer.T)

    @property
    def together(self) -> int:
        """Points to transform at a time: small ones in groups, so that the calls cost little."""
        return min(len(self.chief), max(1, self.sizes.group // self.mla_samples**2))

    def to_detector(self, start: int, stop: int, work: Workspace) -> Iterator[tuple[int, slice, Field]]:
        """Transform the fields of points start ... stop to the detector.

        Everything is done on blocks that stay in a core's own cache: along x for the directions of the pupil; then,
        turned over, along y to the MLA, to the spectrum and to the detector; at last along x to the detector.

        Parameters
        ----------
        start, stop : int
            Which points of the batch, at most `together`.
        work : Workspace
            Overwritten.

        Yields
        ------
        point : int
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
            for part, point in zip(detector, range(start, stop), strict=True):
                yield point, block, part

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
