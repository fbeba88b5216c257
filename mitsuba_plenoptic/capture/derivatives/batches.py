"""Batches of point spreads that are differentiated: forward, by changes of the numbers, and in reverse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...runtime.backend import array_module
from ...runtime.batches import Box, Part
from ...runtime.fft import Field, as_field, as_words, pack, unpack
from ..patch import PatchBatch
from ..patch_batches import Fields
from ..patch_factors import PatchFactors
from .chain import Changes, Factors, Way
from .numbers import VaryingNumbers


@dataclass(frozen=True)
class _Drawn:
    """The factors of all radiators of a batch, as Complex2f of Dr.Jit that carry gradients."""

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
        elements = numbers.elements(fields.grid, made.highest)
        pupil, power = made.pupil(elements)
        scale = made.scale(elements, power)
        along_x, along_y = (made.along(elements, axis, scale) for axis in (0, 1))
        lenses = None if made.separable else made.lenses(elements)
        return cls(pupil, along_x, along_y, lenses, made.transfer(elements)), made

    @property
    def parts(self) -> list[Any]:
        """All of them, as `Factors` has them."""
        return [self.pupil, self.along_x, self.along_y, self.lenses, self.transfer]


def _shapes(fields: Fields, made: PatchFactors) -> list[tuple[int, ...]]:
    """Return the shapes of `_Drawn.parts`."""
    n, d, m = len(fields.positions), made.directions, made.mla_samples
    return [(n, d, d), (n, m), (n, m), (n, m, m), made.transfer_shape]


def _of_radiator(parts: list[Field | None], made: Any, radiator: int) -> list[Any]:
    """Take one radiator's factors from those of a batch."""
    *own, transfer = parts
    rows, columns = _directions(made, radiator)
    mine = [None if part is None else part[radiator] for part in own]
    return [*mine, None if transfer is None else transfer[rows, columns]]


def _directions(made: Any, radiator: int) -> tuple[slice, slice]:
    """Return which of a batch's directions, along y and x, one radiator's field has."""
    x, y = (made.chief[radiator] - made.chief.min(0)).tolist()
    return slice(y, y + made.samples), slice(x, x + made.samples)


def _plain(batch: PatchBatch) -> list[Field | None]:
    """Return the factors of a batch as `_of_radiator` takes them."""
    return [batch.pupil, batch.along_x, batch.along_y, batch.lenses, batch.transfer.T]


def _changed(fields: Fields, numbers: VaryingNumbers) -> list[Field | None]:
    """Return the changes of the factors of a batch with the tangents of the numbers."""
    drawn, made = _Drawn.of(fields, numbers)
    varying = [part for part in drawn.parts if part is not None and dr.grad_enabled(part)]
    if varying:
        dr.forward_to(*varying)
    return [
        as_field(pack(dr.grad(part)), shape) if part is not None and dr.grad_enabled(part) else None
        for part, shape in zip(drawn.parts, _shapes(fields, made), strict=True)
    ]


def _extent(batch: Any) -> Box:
    """Return what the patches of a batch take of the grid of half their distances."""
    return Box.between(2 * batch.corner.min(0), 2 * (batch.corner.max(0) + batch.samples))


def _window(batch: Any, box: Box, radiator: int) -> tuple[slice, slice]:
    """Return the rows and columns of a box that one radiator's patch takes."""
    x, y = (2 * batch.corner[radiator] - np.array([box.left, box.top])).tolist()
    return slice(y, y + 2 * batch.samples), slice(x, x + 2 * batch.samples)


@dataclass(frozen=True)
class Push:
    """Changes of point spreads, to be added with weights, and the point spreads beside them.

    Attributes
    ----------
    fields : Fields
        What they are made of.
    weights : float32 array (n, channels)
        Of the radiators.
    directions : tuple of VaryingNumbers
        Of the camera, with the tangents set, for each change.
    """

    fields: Fields
    weights: NDArray[np.float32]
    directions: tuple[VaryingNumbers, ...]

    @property
    def samples(self) -> int:
        """Samples of all patches."""
        return self.fields.samples

    def prepare(self) -> Callable[[], Part]:
        """Make the fields and the changes of their factors, and return the function that adds what they give."""
        changes = [_changed(self.fields, numbers) for numbers in self.directions]
        return partial(_push, self.fields.make(np.ones(len(self.weights))), changes, self.weights)


def _push(batch: PatchBatch, changes: list[list[Field | None]], weights: NDArray[np.float32]) -> Part:
    """Add the changes, direction by direction, and the point spreads last."""
    arrays, box, channels = batch.libraries.arrays, _extent(batch), weights.shape[1]
    sums = arrays.zeros(((len(changes) + 1) * channels, box.rows, box.columns), np.float32)
    plain = _plain(batch)
    for radiator, given in enumerate(weights):
        way = Way(Factors(*_of_radiator(plain, batch, radiator)), arrays)
        window, lit = _window(batch, box, radiator), np.flatnonzero(given).tolist()
        for first, direction in enumerate(changes):
            change = way.tangent(Changes(*_of_radiator(direction, batch, radiator)))
            if change is None:
                continue
            moved = 2 * (way.field.real * change.real + way.field.imag * change.imag)
            for channel in lit:
                sums[(first * channels + channel, *window)] += given[channel] * moved
        spread = arrays.abs(way.field) ** 2
        for channel in lit:
            sums[(len(changes) * channels + channel, *window)] += given[channel] * spread
    return Part(box, sums)


@dataclass(frozen=True)
class Pulled:
    """What a batch in reverse gives.

    Attributes
    ----------
    factors : list of complex64 arrays, or None
        Cotangents of its factors.
    moves : float64 array (moves,)
        Products of the point spreads, with their weights, and the further samples.
    """

    factors: list[Field | None]
    moves: NDArray[np.float64]


@dataclass(frozen=True)
class Pull:
    """Point spreads through which the gradient of an image is taken back to the factors on their fields.

    Attributes
    ----------
    fields : Fields
        What they are made of.
    weights : float32 array (n, channels)
        Of the radiators.
    tile : float32 array (1 + moves, channels, rows, columns)
        The gradient with respect to the samples that they reach, and further ones that are only multiplied with them.
    """

    fields: Fields
    weights: NDArray[np.float32]
    tile: NDArray[np.float32]

    @property
    def samples(self) -> int:
        """Samples of all patches."""
        return self.fields.samples

    def prepare(self) -> Callable[[], Pulled]:
        """Make the fields, and return the function that goes back."""
        return partial(_pull, self.fields.make(np.ones(len(self.weights))), self.weights, self.tile)

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


def _pull(batch: PatchBatch, weights: NDArray[np.float32], tile: NDArray[np.float32]) -> Pulled:
    arrays, box = batch.libraries.arrays, _extent(batch)
    plain = _plain(batch)
    result = [None if part is None else arrays.zeros(part.shape, np.complex64) for part in plain]
    moves = np.zeros(len(tile) - 1)
    for radiator, given in enumerate(weights):
        way = Way(Factors(*_of_radiator(plain, batch, radiator)), arrays)
        gradient, *others = arrays.einsum("kcij,c->kij", tile[(..., *_window(batch, box, radiator))], given)
        if others:
            spread = arrays.abs(way.field) ** 2
            moves += [float((other * spread).sum(dtype=np.float64)) for other in others]
        *own, transfer = way.back(2 * gradient * way.field).parts
        *targets, total = result
        for target, part in zip(targets, own, strict=True):
            if target is not None:
                target[radiator] = part
        if total is not None:
            total[_directions(batch, radiator)] += transfer
    return Pulled(result, moves)
