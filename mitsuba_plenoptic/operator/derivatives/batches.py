"""Batches of point spreads that are differentiated: forward, by changes of the numbers, and in reverse."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...lattice import turn
from ...runtime.backend import array_module
from ...runtime.batches import Part
from ...runtime.fft import Field, as_field, as_words, pack, unpack
from ..patch import PatchBatch
from ..patch_factors import Elements, PatchFactors
from ..tile import Fields
from .chain import Changes, Factors, Memory, Way
from .copies import SpreadCopies, SpreadSum, Window, covered, gathered
from .numbers import VaryingNumbers


@dataclass(frozen=True)
class _Drawn:
    """The factors of all points of a batch, as Complex2f of Dr.Jit that carry gradients."""

    pupil: Any
    along_x: Any
    along_y: Any
    lenses: Any
    transfer: Any

    @classmethod
    def of(cls, fields: Fields, numbers: VaryingNumbers) -> tuple[_Drawn, PatchFactors]:
        """Make them from the numbers."""
        made = PatchFactors(
            fields.grid,
            fields.placement,
            fields.positions,
            np.ones(len(fields.positions)),
            fields.pupil_weights,
            numbers.types,
        )

        def elements(shape: tuple[int, ...]) -> Elements:
            return numbers.elements(fields.grid, made.highest, math.prod(shape))

        of_pupil, of_axis, _, of_lenses, of_transfer = _shapes(fields, made)
        pupil, power = made.pupil(elements(of_pupil))
        scale = made.scale(elements(of_pupil[:1]), power)
        along_x, along_y = (made.along(elements(of_axis), axis, scale) for axis in (0, 1))
        lenses = None if made.separable else made.lenses(elements(of_lenses))
        return cls(pupil, along_x, along_y, lenses, made.transfer(elements(of_transfer))), made

    @property
    def parts(self) -> list[Any]:
        """All of them, as `Factors` has them."""
        return [self.pupil, self.along_x, self.along_y, self.lenses, self.transfer]


def varying_factors(fields: Fields, numbers: VaryingNumbers) -> tuple[bool, ...]:
    """Tell which of the factors change with numbers, as `Factors` has them."""
    drawn, _ = _Drawn.of(fields, numbers)
    return tuple(part is not None and dr.grad_enabled(part) for part in drawn.parts)


def _shapes(fields: Fields, made: PatchFactors) -> list[tuple[int, ...]]:
    """Return the shapes of `_Drawn.parts`."""
    n, d, m = len(fields.positions), made.directions, made.mla_samples
    return [(n, d, d), (n, m), (n, m), (n, m, m), made.transfer_shape]


def _of_point(parts: list[Field | None], made: Any, point: int) -> list[Any]:
    """Take one point's factors from those of a batch."""
    *own, transfer = parts
    rows, columns = _directions(made, point)
    mine = [None if part is None else part[point] for part in own]
    return [*mine, None if transfer is None else transfer[rows, columns]]


def _directions(made: Any, point: int) -> tuple[slice, slice]:
    """Return which of a batch's directions, along y and x, one point's field has."""
    x, y = (made.chief[point] - made.chief.min(0)).tolist()
    return slice(y, y + made.samples), slice(x, x + made.samples)


def _plain(batch: PatchBatch) -> list[Field | None]:
    """Return the factors of a batch as `_of_point` takes them."""
    # Fields are multiplied with it row by row.
    transfer = batch.libraries.arrays.ascontiguousarray(batch.transfer.T)
    return [batch.pupil, batch.along_x, batch.along_y, batch.lenses, transfer]


def _moved_lattice(
    fields: Fields, numbers: VaryingNumbers | None, copies: list[SpreadCopies]
) -> list[list[Field | None]]:
    """Return the changes of the factors of a batch as the lattice moves along its own x, and along its y."""
    if numbers is None or not any(own.moving for own in copies):
        return []
    moves = []
    for vector in ((1.0, 0.0), (0.0, 1.0)):
        numbers.set_tangents({"mla_offset": np.array(turn(*vector, fields.grid.rotation))})
        moves.append(_changed(fields, numbers))
    return moves


def _changed(fields: Fields, numbers: VaryingNumbers) -> list[Field | None]:
    """Return the changes of the factors of a batch with the tangents of the numbers."""
    drawn, made = _Drawn.of(fields, numbers)
    varying = [part for part in drawn.parts if part is not None and dr.grad_enabled(part)]
    if varying:
        dr.forward_to(*varying)
    changes = [
        as_field(pack(dr.grad(part)), shape) if part is not None and dr.grad_enabled(part) else None
        for part, shape in zip(drawn.parts, _shapes(fields, made), strict=True)
    ]
    # A number with parts, of which some stay, leaves factors as they are.
    return [change if change is not None and change.any() else None for change in changes]


@dataclass(frozen=True)
class Push:
    """Changes of point spreads and of their copies, to be added with weights, and the point spreads beside them.

    Attributes
    ----------
    fields : Fields
        What they are made of.
    copies : list of SpreadCopies
        Of each.
    finer : int
        As of `Way`.
    directions : tuple of VaryingNumbers
        Of the camera, with the tangents set, for each change.
    slopes : tuple of float64 arrays (2, 2)
        For each direction, A of `copies.copy_slopes`.
    offset : VaryingNumbers, optional
        Those of which ``mla_offset`` varies; None where no A is needed.
    placed : bool
        Whether the point spreads are added times the copies' places along x and y, too.
    """

    fields: Fields
    copies: list[SpreadCopies]
    finer: int
    directions: tuple[VaryingNumbers, ...]
    slopes: tuple[NDArray[np.float64], ...]
    offset: VaryingNumbers | None
    placed: bool

    @property
    def samples(self) -> int:
        """Samples of all patches."""
        return self.fields.samples

    def prepare(self) -> Callable[[], Part]:
        """Make the fields and the changes of their factors, and return the function that adds what they give."""
        changes = [_changed(self.fields, numbers) for numbers in self.directions]
        lattice = _moved_lattice(self.fields, self.offset, self.copies)
        return partial(_push, self, self.fields.make(np.ones(len(self.copies))), changes, lattice)


def _push(push: Push, batch: PatchBatch, changes: list[list[Field | None]], lattice: list[list[Field | None]]) -> Part:
    """Add the changes, direction by direction, and the point spreads last."""
    arrays, finer, channels = batch.libraries.arrays, push.finer, push.copies[0].weights.shape[1]
    box = covered(batch.corner, batch.samples, push.copies, finer)
    parts = len(changes) + (3 if push.placed else 1)
    sums = arrays.zeros((parts, channels, box.rows, box.columns), np.float32)
    plain, memory = _plain(batch), Memory(arrays)
    for point, copies in enumerate(push.copies):
        memory.restart()
        way = Way(Factors(*_of_point(plain, batch, point)), finer, memory)
        windows = copies.windows(batch.corner[point], batch.samples, box, finer)
        one, moved = np.ones(len(windows)), []
        if copies.moving:
            moved = [way.moved(Changes(*_of_point(move, batch, point))) for move in lattice]
        for part, direction, slopes in zip(sums, changes, push.slopes, strict=False):
            terms = [(way.tangent(Changes(*_of_point(direction, batch, point))), one)]
            for axis in (0, 1) if moved and slopes.any() else ():
                both = sum(arrays.float32(slope) * move for slope, move in zip(slopes[:, axis], moved, strict=True))
                terms.append((way.slope(both), copies.places[:, axis]))
            lit = [(slope, given) for slope, given in terms if slope is not None]
            _add(part, lit, copies, windows, arrays)
        intensity = way.intensity
        for part, given in zip(sums[len(changes) :], (one, *copies.places.T), strict=False):
            _add(part, [(intensity, given)], copies, windows, arrays)
    return Part(box, sums.reshape(-1, box.rows, box.columns))


def _add(
    sums: Any, terms: list[tuple[Any, NDArray[np.float64]]], copies: SpreadCopies, windows: list[Window], arrays: Any
) -> None:
    """Add to each copy's window the terms with its factors, times its weights."""
    for copy, window in enumerate(windows if terms else []):
        total = sum(value if given[copy] == 1 else arrays.float32(given[copy]) * value for value, given in terms)
        for channel in np.flatnonzero(copies.weights[copy]).tolist():
            sums[(channel, *window)] += copies.weights[copy, channel] * total


@dataclass(frozen=True)
class Pulled:
    """What a batch in reverse gives.

    Attributes
    ----------
    factors : list of complex64 arrays, or None
        Cotangents of its factors.
    products : float64 array (2, 2)
        The gradient times what the spreads show of a moved lattice, as A of `copies.copy_slopes` has it.
    spreads : Part, optional
        The point spreads, as they were asked for.
    """

    factors: list[Field | None]
    products: NDArray[np.float64]
    spreads: Part | None


@dataclass(frozen=True)
class Pull:
    """Point spreads through which the gradient of an image is taken back to the factors on their fields.

    Attributes
    ----------
    fields, copies, finer, offset
        As of `Push`.
    tile : float32 array (channels, rows, columns)
        The gradient with respect to the samples that they reach.
    summed : {0, 1, 3}
        Which sums of the point spreads are asked for: none, that with their weights, or also those with these times
        the copies' places along x and y.
    varies : tuple of bool
        Of which of the factors the cotangents are, as `varying_factors` tells.
    """

    fields: Fields
    copies: list[SpreadCopies]
    finer: int
    offset: VaryingNumbers | None
    tile: NDArray[np.float32]
    summed: int
    varies: tuple[bool, ...]

    @property
    def samples(self) -> int:
        """Samples of all patches."""
        return self.fields.samples

    def prepare(self) -> Callable[[], Pulled]:
        """Make the fields, and return the function that goes back."""
        lattice = _moved_lattice(self.fields, self.offset, self.copies)
        return partial(_pull, self, self.fields.make(np.ones(len(self.copies))), lattice)

    def gather(self, pulled: Pulled, numbers: VaryingNumbers) -> None:
        """Add the gradients that follow to those of the numbers."""
        drawn, _ = _Drawn.of(self.fields, numbers)
        total, words = 0, array_module().ad.UInt64
        for part, cotangent in zip(drawn.parts, pulled.factors, strict=True):
            if part is not None and cotangent is not None and dr.grad_enabled(part):
                given = unpack(words(as_words(np.ascontiguousarray(cotangent))))
                products = part.real * given.real + part.imag * given.imag
                total = total + dr.sum(numbers.types.Float64(products))
        if dr.grad_enabled(total):
            dr.backward(total)
            # What the kernels read of the cotangents must not be dropped before.
            dr.eval()
            dr.sync_thread()


def _pull(pull: Pull, batch: PatchBatch, lattice: list[list[Field | None]]) -> Pulled:
    arrays, finer = batch.libraries.arrays, pull.finer
    box = covered(batch.corner, batch.samples, pull.copies, finer)
    # The intensity changes by twice the product of the field and its change.
    tile, plain = 2 * arrays.asarray(pull.tile), _plain(batch)
    result = [
        arrays.zeros(part.shape, np.complex64) if part is not None and varies else None
        for part, varies in zip(plain, pull.varies, strict=True)
    ]
    returning = arrays.conj(plain[-1])
    spreads = SpreadSum(box, batch, [own.summed(pull.summed) for own in pull.copies], finer) if pull.summed else None
    products, memory = np.zeros((2, 2)), Memory(arrays)
    for point, copies in enumerate(pull.copies):
        memory.restart()
        rows, columns = _directions(batch, point)
        way = Way(Factors(*_of_point(plain, batch, point)), finer, memory, returning[rows, columns])
        windows = copies.windows(batch.corner[point], batch.samples, box, finer)
        gradient, *moments = gathered(tile, windows, copies, bool(lattice) and copies.moving, arrays)
        moved = [way.moved(Changes(*_of_point(move, batch, point))) for move in lattice if moments]
        for axis, moment in enumerate(moments):
            with memory.lent():
                products[:, axis] += way.products(moment, moved)
        if spreads is not None:
            spreads.add(point, way.intensity)
        *targets, total = result
        *own, transfer = way.back(gradient, total is not None).parts
        for target, part in zip(targets, own, strict=True):
            if target is not None:
                target[point] = part
        if total is not None:
            total[rows, columns] += transfer
    return Pulled(result, products, None if spreads is None else Part(box, spreads.total()))
