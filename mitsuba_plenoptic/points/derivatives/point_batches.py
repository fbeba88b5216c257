"""Batches of differentiated point spreads: forward, along changes of parameters, and in reverse."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...lattice import turn
from ...runtime.backend import array_module, drjit_array
from ...runtime.batches import Box, Part
from ...runtime.fft import as_field, as_words, pack, unpack
from ..patch import FieldChain, Memory, Parts, PatchBatch
from ..patch_factors import Fields, PatchFactors
from ..tile import Copies, CopySum, FieldBatch, reached
from .by_parameter import VaryingParameters

MOVED_LENSES = ("mla_pitch", "mla_distance", "mla_rotation")
"""Parameters that move the lattice against the points, so that A is not zero."""

SHIFTED_COPIES = ("mla_distance", "mla_rotation", "detector_distance", "wavelength")
"""Parameters that shift copies, so that B is not zero."""

MOVED_COPIES = ("mla_pitch", *SHIFTED_COPIES)
"""Parameters that change copies differently from their spreads."""


def copy_slopes(camera: PlenopticCamera, wavelength: float, name: str) -> NDArray[np.float64]:
    """Return the matrices A and B of moving copies for a unit change of each component of a parameter.

    The result is (components, 2, 2, 2), for a parameter in `MOVED_COPIES`: for each component A and B, each as (x and y
    of the move, x and y of the copy's position). ``mla_rotation`` is in degrees, ``wavelength`` in nanometres.
    """
    one, none = np.eye(2), np.zeros((2, 2))
    growth, b = camera.image_growth, camera.mla_distance
    if name == "mla_pitch":
        along = [np.diag(one[axis]) / camera.mla_pitches[axis] for axis in (0, 1)]
        return np.array([[moved, none] for moved in along])
    if name == "mla_distance":
        return np.array([[-one / b, -one / b]])
    if name == "detector_distance":
        return np.array([[none, -one / (b * camera.mla_medium)]])
    if name == "mla_rotation":
        turn = math.pi / 180 * np.array([[0.0, -1.0], [1.0, 0.0]])
        return np.array([[turn, growth * turn]])
    return np.array([[none, growth / wavelength * one]])


Window = tuple[slice, slice]
"""Rows and columns of a box of the grid."""

_BLOCK = 2**18
"""Number of samples that are gathered together: they fit into the cache of one core."""


@dataclass(frozen=True)
class SpreadCopies(Copies):
    """Positions and weights of the copies of a point spread, and the changes of the copies."""

    places: NDArray[np.float64]  # shifts on the microlens array in millimetres, (copies, 2)
    moving: bool  # whether the motion of the lattice against the points is included

    def summed(self, sums: int) -> SpreadCopies:
        """Return the copies with weights repeated for 1 or 3 sums; of 3, the last two have weights times positions."""
        factors = [np.ones(len(self.places)), *self.places.T][:sums]
        weights = np.hstack([self.weights * factor[:, None].astype(np.float32) for factor in factors])
        return replace(self, weights=weights)

    def windows(self, corner: NDArray[np.int64], samples: int, box: Box, finer: int) -> list[Window]:
        """Return the window of each copy of a patch in a box of the grid, which is finer than the patches."""
        start = finer * (corner + self.shifts) - np.array([box.left, box.top])
        size = finer * samples
        return [(slice(y, y + size), slice(x, x + size)) for x, y in start.tolist()]


def gathered(tile: Any, windows: list[Window], copies: SpreadCopies, moments: bool, arrays: Any) -> list[Any]:
    """Return the weighted sum of the windows of the copies in a tile.

    The tile (channels, rows, columns) covers the box of the windows. With `moments` two more sums follow, with weights
    multiplied by the copies' x and by their y.
    """
    along = [np.ones(len(windows)), *copies.places.T] if moments else [np.ones(len(windows))]
    which, channels = np.nonzero(copies.weights)
    factors = arrays.asarray((np.array(along)[:, which] * copies.weights[which, channels]).astype(np.float32))
    rows, columns = (part.stop - part.start for part in windows[0])
    result = arrays.empty((len(along), rows, columns), np.float32)
    block = max(1, _BLOCK // max(1, len(which) * columns))
    for first in range(0, rows, block):
        last = min(rows, first + block)
        held = arrays.empty((len(which), last - first, columns), np.float32)
        for part, copy, channel in zip(held, which.tolist(), channels.tolist(), strict=True):
            window_rows, window_columns = windows[copy]
            part[...] = tile[channel, window_rows.start + first : window_rows.start + last, window_columns]
        result[:, first:last] = (factors @ held.reshape(len(which), -1)).reshape(len(along), last - first, columns)
    return list(result)


def varying_factors(fields: Fields, parameters: VaryingParameters) -> tuple[bool, ...]:
    """Return, for each factor of fields, whether it changes with given parameters."""
    # Single values serve all lanes where nothing is computed.
    elements = parameters.elements(fields.grid, 1)
    made = PatchFactors(fields, np.ones(len(fields.positions)), lambda lanes: elements, parameters.types)
    return tuple(dr.grad_enabled(value) for value in made.values())


def _factors(fields: Fields, parameters: VaryingParameters) -> PatchFactors:
    """Return the factors of fields as functions of parameters that carry gradients."""
    elements = partial(parameters.elements, fields.grid)
    return PatchFactors(fields, np.ones(len(fields.positions)), elements, parameters.types)


def _moved_lattice(fields: Fields, parameters: VaryingParameters | None, copies: Sequence[SpreadCopies]) -> list[Parts]:
    """Return the changes of a batch's factors as the lattice moves along its x axis, and along its y axis."""
    if parameters is None or not any(own.moving for own in copies):
        return []
    moves = []
    for vector in ((1.0, 0.0), (0.0, 1.0)):
        parameters.set_tangents({"mla_offset": np.array(turn(*vector, fields.grid.rotation))})
        moves.append(_changed(fields, parameters))
    return moves


def _changed(fields: Fields, parameters: VaryingParameters) -> Parts:
    """Return the changes of a batch's factors along the tangents of the parameters."""
    made = _factors(fields, parameters)
    values = list(made.values())
    if varying := [value for value in values if dr.grad_enabled(value)]:
        dr.forward_to(*varying)
    changes = [
        as_field(pack(dr.grad(value)), shape) if dr.grad_enabled(value) else None
        for value, shape in zip(values, made.shapes, strict=True)
    ]
    # A parameter of several components, of which some are fixed, leaves factors as they are.
    return [change if change is not None and change.any() else None for change in changes]


@dataclass(frozen=True)
class JvpBatch(FieldBatch):
    """Changes of point spreads and of their copies, to be added with weights, and the spreads themselves."""

    copies: list[SpreadCopies]
    finer: int  # as in `FieldChain`
    directions: tuple[VaryingParameters, ...]  # with the tangents set
    slopes: tuple[NDArray[np.float64], ...]  # for each direction (2, 2), A of `copies.copy_slopes`
    offset: VaryingParameters | None  # those of which ``mla_offset`` varies; None where no A is needed
    placed: bool  # whether the point spreads are added times the copies' positions along x and y, too

    def prepare(self) -> Callable[[], Part]:
        """Compute the fields and the changes of their factors, and return the function that adds the results."""
        changes = [_changed(self.fields, parameters) for parameters in self.directions]
        lattice = _moved_lattice(self.fields, self.offset, self.copies)
        return partial(_jvp, self, PatchBatch(self.fields, np.ones(len(self.copies))), changes, lattice)


def _jvp(work: JvpBatch, batch: PatchBatch, changes: list[Parts], lattice: list[Parts]) -> Part:
    """Return the sum of the changes for each direction, with the point spreads last."""
    arrays, finer, channels = batch.libraries.arrays, work.finer, work.copies[0].weights.shape[1]
    box = reached(batch.corner, batch.samples, work.copies, finer)
    parts = len(changes) + (3 if work.placed else 1)
    sums = arrays.zeros((parts, channels, box.rows, box.columns), np.float32)
    of_point, memory = batch.factors.of_point, Memory(arrays)
    for point, copies in enumerate(work.copies):
        memory.restart()
        chain = FieldChain(of_point(batch.parts, point), batch.factors.axes, finer, memory)
        windows = copies.windows(batch.corner[point], batch.samples, box, finer)
        one, moved = np.ones(len(windows)), []
        if copies.moving:
            moved = [chain.spectrum_jvp(of_point(move, point)) for move in lattice]
        for part, direction, slopes in zip(sums, changes, work.slopes, strict=False):
            terms = [(chain.jvp(of_point(direction, point)), one)]
            for axis in (0, 1) if moved and slopes.any() else ():
                both = sum(arrays.float32(slope) * move for slope, move in zip(slopes[:, axis], moved, strict=True))
                terms.append((chain.jvp_of_spectrum(both), copies.places[:, axis]))
            lit = [(slope, given) for slope, given in terms if slope is not None]
            _add(part, lit, copies, windows, arrays)
        intensity = chain.intensity
        for part, given in zip(sums[len(changes) :], (one, *copies.places.T), strict=False):
            _add(part, [(intensity, given)], copies, windows, arrays)
    return Part(box, sums.reshape(-1, box.rows, box.columns))


def _add(
    sums: Any, terms: list[tuple[Any, NDArray[np.float64]]], copies: SpreadCopies, windows: list[Window], arrays: Any
) -> None:
    """Add terms, multiplied by each copy's factors and weights, to the window of each copy."""
    for copy, window in enumerate(windows if terms else []):
        total = sum(value if given[copy] == 1 else arrays.float32(given[copy]) * value for value, given in terms)
        for channel in np.flatnonzero(copies.weights[copy]).tolist():
            sums[(channel, *window)] += copies.weights[copy, channel] * total


@dataclass(frozen=True)
class VjpResult:
    """Cotangents of a batch's factors, with sums of the batch's point spreads."""

    factors: Parts
    products: NDArray[np.float64]  # gradient times the effect of a moved lattice on the spreads, laid out as A, (2, 2)
    spreads: Part | None


@dataclass(frozen=True)
class VjpBatch(FieldBatch):
    """Point spreads through which an image's gradient is propagated back to the factors of their fields."""

    copies: list[SpreadCopies]
    finer: int  # as in `FieldChain`
    offset: VaryingParameters | None  # as in `JvpBatch`
    tile: NDArray[np.float32]  # gradient by the samples that the spreads cover, (channels, rows, columns)
    summed: int  # sums of the point spreads: 0, 1 (with their weights) or 3 (also times the copies' x, and y)
    varies: tuple[bool, ...]  # the factors whose cotangents are asked for

    def prepare(self) -> Callable[[], VjpResult]:
        """Compute the fields, and return the function that propagates the gradient back."""
        lattice = _moved_lattice(self.fields, self.offset, self.copies)
        return partial(_vjp, self, PatchBatch(self.fields, np.ones(len(self.copies))), lattice)

    def gather(self, result: VjpResult, parameters: VaryingParameters) -> None:
        """Add a batch's gradients to the gradients of the parameters."""
        total, words = 0, array_module().ad.UInt64
        for part, cotangent in zip(_factors(self.fields, parameters).values(), result.factors, strict=True):
            if cotangent is not None and dr.grad_enabled(part):
                given = unpack(drjit_array(words, as_words(cotangent)))
                products = part.real * given.real + part.imag * given.imag
                total = total + dr.sum(parameters.types.Float64(products))
        if dr.grad_enabled(total):
            dr.backward(total)
            # What the kernels read of the cotangents must not be dropped before.
            dr.eval()
            dr.sync_thread()


def _vjp(work: VjpBatch, batch: PatchBatch, lattice: list[Parts]) -> VjpResult:
    arrays, finer, made = batch.libraries.arrays, work.finer, batch.factors
    box = reached(batch.corner, batch.samples, work.copies, finer)
    # The intensity changes by twice the product of the field and its change.
    tile = 2 * arrays.asarray(work.tile)
    cotangents = [
        arrays.zeros(part.shape, np.complex64) if varies else None
        for part, varies in zip(batch.parts, work.varies, strict=True)
    ]
    *per_point, total = cotangents
    returning = arrays.conj(batch.parts[-1])
    spreads = None
    if work.summed:
        own, low = [copies.summed(work.summed) for copies in work.copies], np.array([box.left, box.top])
        places = [
            (finer * (corner + each.shifts) - low)[:, ::-1] for corner, each in zip(batch.corner, own, strict=True)
        ]
        spreads = CopySum(own, places, finer * batch.samples, np.array([box.rows, box.columns]), 1)
    products, memory = np.zeros((2, 2)), Memory(arrays)
    for point, copies in enumerate(work.copies):
        memory.restart()
        directions = made.directions_of(point)
        chain = FieldChain(made.of_point(batch.parts, point), made.axes, finer, memory, returning[directions])
        windows = copies.windows(batch.corner[point], batch.samples, box, finer)
        gradient, *moments = gathered(tile, windows, copies, bool(lattice) and copies.moving, arrays)
        moved = [chain.spectrum_jvp(made.of_point(move, point)) for move in lattice if moments]
        for axis, moment in enumerate(moments):
            with memory.lent():
                products[:, axis] += chain.products(moment, moved)
        if spreads is not None:
            spreads.add(point, (slice(0, finer * batch.samples),) * 2, chain.intensity)
        *found, transfer = chain.vjp(gradient, work.varies)
        for target, part in zip(per_point, found, strict=True):
            if target is not None:
                target[point] = part
        if total is not None:
            total[directions] += transfer
    return VjpResult(cotangents, products, None if spreads is None else Part(box, spreads.total()))
