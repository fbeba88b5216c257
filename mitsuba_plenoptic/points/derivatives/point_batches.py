"""Batches of differentiated point spreads: forward, along changes of parameters, and in reverse."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import drjit as dr
import numpy as np

from ...camera import PlenopticCamera
from ...runtime import Box, Doubles, Flags, Floats, Part, active_backend, array_module, drjit_array, fft, turn
from ..patch import FieldChain, Memory, Parts, PatchBatch
from ..patch_factors import Fields, PatchFactors
from ..tile import Copies, FieldBatch, reached
from ..windows import Windows, add_to_windows, gathered
from .by_parameter import VaryingParameters

MOVED_LENSES = ("mla_pitch", "mla_distance", "mla_rotation")
"""Parameters that move the lattice against the points, so that A is not zero."""

SHIFTED_COPIES = ("mla_distance", "mla_rotation", "detector_distance", "wavelength")
"""Parameters that shift copies, so that B is not zero."""

MOVED_COPIES = ("mla_pitch", *SHIFTED_COPIES)
"""Parameters that change copies differently from their spreads."""


def copy_slopes(camera: PlenopticCamera, wavelength: float, name: str) -> Doubles:
    """Return the matrices A and B of moving copies for a unit change of each component of a parameter.

    The result is (components, 2, 2, 2), for a parameter in `MOVED_COPIES`: for each component A and B, each as (x and y
    of the move, x and y of the copy's position). ``mla_rotation`` is in degrees, ``wavelength`` in nanometres.
    """
    identity = np.eye(2)
    none = np.zeros((2, 2))
    growth = camera.image_growth
    b = camera.mla_distance
    if name == "mla_pitch":
        along = [np.diag(identity[axis]) / camera.mla_pitches[axis] for axis in (0, 1)]
        return np.array([[moved, none] for moved in along])
    if name == "mla_distance":
        return np.array([[-identity / b, -identity / b]])
    if name == "detector_distance":
        return np.array([[none, -identity / (b * camera.mla_medium)]])
    if name == "mla_rotation":
        turn = math.pi / 180 * np.array([[0.0, -1.0], [1.0, 0.0]])
        return np.array([[turn, growth * turn]])
    return np.array([[none, growth / wavelength * identity]])


@dataclass(frozen=True)
class SpreadCopies(Copies):
    """Positions and weights of the copies of a point spread, and the changes of the copies."""

    places: Doubles  # shifts on the microlens array in millimetres, (copies, 2)
    moving: Flags  # whether the motion of the lattice against the point is included, (copies,)

    @classmethod
    def joined(cls, batches: Sequence[SpreadCopies]) -> SpreadCopies:
        """Return the copies of several point spreads, one after another."""
        return cls(*(np.concatenate([getattr(batch, field.name) for batch in batches]) for field in fields(cls)))

    def scaled(self, scale: Doubles) -> Floats:
        """Return the weights, each times the scale of its copy."""
        return np.asarray(scale[:, None] * self.weights, np.float32)


def _windows(work: JvpBatch | VjpBatch, batch: PatchBatch, box: Box) -> Windows:
    """Return the windows of all copies in a box of the grid, which is finer than the patches."""
    low = np.array([box.left, box.top])
    corners = zip(batch.corner, work.copies, strict=True)
    return Windows.of([(work.finer * (corner + copies.shifts) - low)[:, ::-1] for corner, copies in corners])


def varying_factors(fields: Fields, parameters: VaryingParameters) -> tuple[bool, ...]:
    """Return, for each factor of fields, whether it changes with given parameters."""
    # Single values serve all lanes where nothing is computed.
    elements = parameters.elements(fields.grid, 1)
    factors = PatchFactors(fields, np.ones(len(fields.positions)), lambda lanes: elements, parameters.types)
    return tuple(dr.grad_enabled(value) for value in factors.values())


def _factors(fields: Fields, parameters: VaryingParameters) -> PatchFactors:
    """Return the factors of fields as functions of parameters that carry gradients."""
    elements = partial(parameters.elements, fields.grid)
    return PatchFactors(fields, np.ones(len(fields.positions)), elements, parameters.types)


def _moved_lattice(fields: Fields, parameters: VaryingParameters | None, copies: Sequence[SpreadCopies]) -> list[Parts]:
    """Return the changes of a batch's factors as the lattice moves along its x axis, and along its y axis."""
    if parameters is None or not any(copy.moving.any() for copy in copies):
        return []
    moves = []
    for vector in ((1.0, 0.0), (0.0, 1.0)):
        parameters.set_tangents({"mla_offset": np.array(turn(*vector, fields.grid.rotation))})
        moves.append(_changed(fields, parameters))
    return moves


def _changed(fields: Fields, parameters: VaryingParameters) -> Parts:
    """Return the changes of a batch's factors along the tangents of the parameters."""
    factors = _factors(fields, parameters)
    values = list(factors.values())
    if varying := [value for value in values if dr.grad_enabled(value)]:
        dr.forward_to(*varying)
    changes = [
        fft.as_field(fft.pack(dr.grad(value)), shape) if dr.grad_enabled(value) else None
        for value, shape in zip(values, factors.shapes, strict=True)
    ]
    # A parameter of several components, of which some are fixed, leaves factors as they are.
    nonzero = [change for change in changes if change is not None]
    if not nonzero:
        return changes
    libraries = active_backend()
    moved = iter(libraries.to_host(libraries.arrays.stack([change.any() for change in nonzero])).tolist())
    return [change if change is not None and next(moved) else None for change in changes]


@dataclass(frozen=True)
class JvpBatch(FieldBatch):
    """Changes of point spreads and of their copies, to be added with weights, and the spreads themselves."""

    copies: list[SpreadCopies]
    finer: int  # as in `FieldChain`
    directions: tuple[VaryingParameters, ...]  # with the tangents set
    slopes: tuple[Doubles, ...]  # for each direction (2, 2), A of `copies.copy_slopes`
    offset: VaryingParameters | None  # those of which ``mla_offset`` varies; None where no A is needed
    placed: bool  # whether the point spreads are added times the copies' positions along x and y, too

    def prepare(self) -> Callable[[], Part]:
        """Compute the fields and the changes of their factors, and return the function that adds the results."""
        changes = [_changed(self.fields, parameters) for parameters in self.directions]
        lattice = _moved_lattice(self.fields, self.offset, self.copies)
        return partial(_jvp, self, PatchBatch(self.fields, np.ones(len(self.copies))), changes, lattice)


def _jvp(work: JvpBatch, batch: PatchBatch, changes: list[Parts], lattice: list[Parts]) -> Part:
    """Return the sum of the changes for each direction, with the point spreads last."""
    arrays = batch.libraries.arrays
    finer = work.finer
    channels = work.copies[0].weights.shape[1]
    box = reached(batch.corner, batch.samples, work.copies, finer)
    parts = len(changes) + (3 if work.placed else 1)
    sums = arrays.zeros((parts, channels, box.rows, box.columns), np.float32)
    of_points = batch.factors.of_points
    memory = Memory(arrays)
    all_windows = _windows(work, batch, box)
    for points in batch.chained(finer):
        memory.restart()
        chain = FieldChain(of_points(batch.parts, points), batch.factors.axes, finer, memory)
        windows = all_windows.take(all_windows.of_patches(points.start, points.stop), points.start)
        copies = SpreadCopies.joined(work.copies[points])
        unchanged = np.ones(len(copies.weights))
        moved = []
        if copies.moving.any():
            moved = [chain.spectrum_jvp(of_points(move, points)) for move in lattice]
        places = copies.places * copies.moving[:, None]
        for number, direction, slopes in zip(range(parts), changes, work.slopes, strict=False):
            terms = [(chain.jvp(of_points(direction, points)), unchanged)]
            for axis in (0, 1) if moved and slopes.any() else ():
                both: Any = sum(np.float32(slope) * move for slope, move in zip(slopes[:, axis], moved, strict=True))
                terms.append((chain.jvp_of_spectrum(both), places[:, axis]))
            for slope, scale in terms:
                if slope is not None:
                    add_to_windows(sums[number], slope, windows, copies.scaled(scale))
        intensity = chain.intensity
        for number, scale in zip(range(len(changes), parts), (unchanged, *copies.places.T), strict=False):
            add_to_windows(sums[number], intensity, windows, copies.scaled(scale))
    return Part(box, sums.reshape(-1, box.rows, box.columns))


@dataclass(frozen=True)
class VjpResult:
    """Cotangents of a batch's factors, with sums of the batch's point spreads."""

    factors: Parts
    products: Doubles  # gradient times the effect of a moved lattice on the spreads, laid out as A, (2, 2)
    spreads: Part | None


@dataclass(frozen=True)
class VjpBatch(FieldBatch):
    """Point spreads through which an image's gradient is propagated back to the factors of their fields."""

    copies: list[SpreadCopies]
    finer: int  # as in `FieldChain`
    offset: VaryingParameters | None  # as in `JvpBatch`
    tile: Floats  # gradient by the samples that the spreads cover, (channels, rows, columns)
    summed: int  # sums of the point spreads: 0, 1 (with their weights) or 3 (also times the copies' x, and y)
    varies: tuple[bool, ...]  # the factors whose cotangents are asked for

    def prepare(self) -> Callable[[], VjpResult]:
        """Compute the fields, and return the function that propagates the gradient back."""
        lattice = _moved_lattice(self.fields, self.offset, self.copies)
        return partial(_vjp, self, PatchBatch(self.fields, np.ones(len(self.copies))), lattice)

    def gather(self, result: VjpResult, parameters: VaryingParameters) -> None:
        """Add a batch's gradients to the gradients of the parameters."""
        total = 0
        words = array_module().ad.UInt64
        for factor, cotangent in zip(_factors(self.fields, parameters).values(), result.factors, strict=True):
            if cotangent is not None and dr.grad_enabled(factor):
                field = fft.unpack(drjit_array(words, fft.as_words(cotangent)))
                products = factor.real * field.real + factor.imag * field.imag
                total = total + dr.sum(parameters.types.Float64(products))
        if dr.grad_enabled(total):
            dr.backward(total)
            # What the kernels read of the cotangents must not be dropped before.
            dr.eval()
            dr.sync_thread()


def _vjp(work: VjpBatch, batch: PatchBatch, lattice: list[Parts]) -> VjpResult:
    arrays = batch.libraries.arrays
    finer = work.finer
    factors = batch.factors
    box = reached(batch.corner, batch.samples, work.copies, finer)
    # The intensity changes by twice the product of the field and its change.
    tile = 2 * arrays.asarray(work.tile)
    cotangents = [
        arrays.zeros(factor.shape, np.complex64) if varies else None
        for factor, varies in zip(batch.parts, work.varies, strict=True)
    ]
    *per_point, total = cotangents
    returning = arrays.conj(batch.parts[-1])
    spreads = None
    finer_samples = finer * batch.samples
    all_windows = _windows(work, batch, box)
    if work.summed:
        # With the weights, and if there are 3 sums, with the weights times the positions.
        every = SpreadCopies.joined(work.copies)
        factors_of = [np.ones(len(every.places)), *every.places.T][: work.summed]
        weights = np.hstack([every.scaled(factor) for factor in factors_of])
        spreads = arrays.zeros((weights.shape[1], box.rows, box.columns), np.float32)
    products = arrays.zeros((2, 2))
    memory = Memory(arrays)
    for points in batch.chained(finer):
        memory.restart()
        conjugate = factors.directions_of(returning, points)
        chain = FieldChain(factors.of_points(batch.parts, points), factors.axes, finer, memory, conjugate)
        some = all_windows.of_patches(points.start, points.stop)
        windows = all_windows.take(some, points.start)
        copies = SpreadCopies.joined(work.copies[points])
        along = [np.ones(len(copies.places))]
        if lattice and copies.moving.any():
            along += list((copies.places * copies.moving[:, None]).T)
        gradient, *moments = gathered(tile, windows, copies.weights, np.array(along), finer_samples)
        moved = [chain.spectrum_jvp(factors.of_points(move, points)) for move in lattice if moments]
        for axis, moment in enumerate(moments):
            with memory.lent():
                products[:, axis] += chain.products(moment, moved)
        if spreads is not None:
            add_to_windows(spreads, chain.intensity, windows, weights[some])
        *of_factors, transfer = chain.vjp(gradient, work.varies)
        for target, factor in zip(per_point, of_factors, strict=True):
            if target is not None:
                target[points] = factor
        if total is not None and transfer is not None:
            # Real and imaginary parts as neighbouring columns.
            starts = factors.first_directions[points, ::-1] * np.array([1, 2])
            real, values = (array.view(np.float32) for array in (total, transfer))
            ones = np.ones((len(values), 1), np.float32)
            add_to_windows(real[None], values, Windows(np.arange(len(values)), starts), ones)
    cotangents = [*per_point, total]
    products = batch.libraries.to_host(products)
    return VjpResult(cotangents, products, None if spreads is None else Part(box, spreads))
