"""The plan of the point spreads of some points: their batches, and the shifts of their copies."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import InputError
from ..fields import OpticalSystem, clear, has_response
from ..optics import guards
from ..runtime import (
    BatchMap,
    Box,
    Doubles,
    Floats,
    Integers,
    Job,
    PartialSum,
    active_backend,
    backend_of,
    check_memory,
    on_cuda,
)
from .accuracy import ZONES, band_for, find_patterns, wavefront_step
from .field_grid import Band, Grid, place
from .patch_factors import Fields, chunks_of, fields_memory
from .pupil_weights import PupilWeights
from .recorder import Recorder
from .seen_pupil import passed_part
from .tile import Copies, Gather, Scatter, aperture_power, arrived_power, reached

_CHUNK = 64
"""Largest number of point spreads that are computed together and added into one tile."""

_FEW = 4
_CHUNKS = 32
"""Smallest limit on the point spreads of a chunk, and the least number of chunks if there are few point spreads, so
that all threads have work."""

_PATCH_LIMIT = 2**26
"""Bytes of one point's field above which many are refused: if each covers thousands of pixels, they take days."""


_BEHIND_GAPS = 64
"""Patterns from which light beyond patches is estimated behind gaps; far light of fewer does not come back."""


class PatchPlan:
    """Points grouped into patterns, and patterns grouped into chunks of one patch size and neighbourhood.

    A pattern is a point spread shared by several points; each point has a copy at its own position. Each chunk is a
    batch, whose patterns are added in order into the chunk's tile.

    Unless `shared` is false, points may share patterns within the allowed error `accuracy`; the default `band` is that
    of images for this error.
    """

    def __init__(
        self,
        system: OpticalSystem,
        points: Doubles,
        pupil_weights: PupilWeights | None,
        accuracy: float,
        *,
        band: Band | None = None,
        shared: bool = True,
    ):
        camera = system.camera
        wavelength = system.wavelength
        self._camera, self._pupil_weights, self._count = camera, pupil_weights, len(points)
        self._grid = Grid.of(system, band or band_for(accuracy, len(points)), points)
        upright = self._grid.camera
        lens = self._grid.lens
        turned = self._grid.to_frame(points)
        # Lenses at uneven distances share nothing, nor do lenses of uneven light.
        shared &= bool(self._grid.lens_samples.any()) and camera.lattice.displacement is None
        shared &= camera.vignetting is None and camera.mla_transmissions is None
        step = wavefront_step(accuracy, upright, lens, turned) if shared else 0.0
        patterns = find_patterns(upright, lens, turned, pupil_weights, wavelength, step)
        placement = place(self._grid, patterns.positions)
        shifts = patterns.shift @ self._grid.lens_samples
        low = placement.corner[patterns.pattern] + shifts
        high = low + placement.samples[patterns.pattern, None]
        self._recorder = Recorder(camera, self._grid, low, high)
        box = self._recorder.box
        start = np.array([box.left, box.top])
        size = np.array([box.columns, box.rows])
        # The points whose light reaches the recorded window, pattern by pattern.
        order = np.flatnonzero(((high > start) & (low < start + size)).all(1))
        self._order = order = order[np.argsort(patterns.pattern[order], kind="stable")]
        self._shifts = shifts[order]
        pattern_numbers, self._first = np.unique(patterns.pattern[order], return_index=True)
        self._last = np.append(self._first[1:], len(order))
        self._positions, self._placement = patterns.positions[pattern_numbers], placement.take(pattern_numbers)
        self._passed = passed_part(camera.vignetting, self._grid.lens, points)
        self._slant = None if patterns.slant is None else patterns.slant[pattern_numbers]
        # The patterns divided into chunks.
        self._chunks: list[Integers] = []
        samples = self._placement.samples
        corner = self._placement.corner
        if not len(samples):
            return
        area = _areas(samples)
        alone = self._last - self._first == 1
        keys = corner[:, 0] // area, corner[:, 1] // area, samples, alone
        sorted_patterns = np.lexsort(keys)
        changes = np.any([np.diff(key[sorted_patterns]) != 0 for key in keys], axis=0)
        # A device takes all work from one thread.
        most = _CHUNK if on_cuda() else min(_CHUNK, max(_FEW, len(samples) // _CHUNKS))
        for group in np.split(sorted_patterns, np.flatnonzero(changes) + 1):
            self._chunks += chunks_of(self._grid, self._placement, group, most)

    # -- forward ---------------------------------------------------------------------------------------

    def sum(self, weights: Doubles) -> PatchSum:
        """Return the sum, not yet computed, of the point spreads with weights (n, channels)."""
        return PatchSum(self, weights)

    def scatter(self, chunk: Integers, weights: Doubles) -> Scatter:
        """Return the data of a chunk's fields, scaled by the largest weights of their copies.

        Copies are weighted relative to these. Patterns without weight are omitted, but not those whose weights cancel.
        """
        scattered = []
        amplitudes = []
        copies = []
        for pattern, shifts, factors in self._lit_copies(chunk, weights):
            largest = float(np.abs(factors).max()) or 1.0
            scattered.append(pattern)
            amplitudes.append((largest * self.gain) ** 0.5)
            copies.append(Copies(shifts, (factors / largest).astype(np.float32)))
        return Scatter(self._fields(np.array(scattered, np.int64)), np.array(amplitudes), copies)

    def _lit_copies(self, chunk: Integers, weights: Doubles) -> Iterator[tuple[int, Integers, Doubles]]:
        """Yield each pattern of a chunk that has nonzero weights, with the shifts and summed weights of its copies."""
        for pattern in chunk.tolist():
            members = slice(self._first[pattern], self._last[pattern])
            members_weights = weights[self._order[members]]
            if len(members_weights) == 1 and members_weights.any():
                yield pattern, self._shifts[members], members_weights  # as most are, more quickly
            elif members_weights.any():
                shifts, copy = np.unique(self._shifts[members], axis=0, return_inverse=True)
                factors = np.zeros((len(shifts), weights.shape[1]))
                np.add.at(factors, copy.reshape(-1), members_weights)
                yield pattern, shifts, factors

    @cached_property
    def gain(self) -> float:
        """Factor on the total power that compensates for light diffracted beyond the patches.

        In sums of many points that light is a uniform background, exchanged between neighbouring patches. The factor is
        computed for open pupils and equal lenses, since it differs little from pattern to pattern; what falls between
        apertures is lost. It is 1 for few points, behind gaps also for few patterns, and for high accuracy.
        """
        fewest = 1 if self._grid.microlenses.fills else _BEHIND_GAPS
        if math.isinf(self._grid.band.beyond) or len(self._positions) < fewest:
            return 1.0
        grid = replace(self._grid, camera=clear(self._grid.camera).replace(mla_transmissions=None, vignetting=None))
        # Points in focus lose more where they are near a gap.
        some = _some(np.arange(len(self._positions)), 16 if grid.microlenses.fills else _BEHIND_GAPS)
        fields = [
            Fields(grid, self._placement.take(chunk), self._positions[chunk], None) for chunk in self._alike(some)
        ]
        arrived = sum(float(arrived_power(chunk).sum()) for chunk in fields)
        passed = (
            sum(float(aperture_power(chunk).sum()) for chunk in fields) if not grid.microlenses.fills else len(some)
        )
        return passed / (arrived * float(self._grid.pitch.prod())) if arrived else 1.0

    def _alike(self, patterns: Integers) -> list[Integers]:
        """Return patterns in chunks of one patch size."""
        samples = self._placement.samples[patterns]
        groups = []
        for size in np.unique(samples):
            groups += chunks_of(self._grid, self._placement, patterns[samples == size], _CHUNK)
        return groups

    def _fields(self, points: Integers, grid: Grid | None = None) -> Fields:
        """Return the data of the fields of a selection of patterns, by default on the plan's grid."""
        weights = self._pupil_weights and self._pupil_weights.take(self._order[self._first[points]])
        if weights is not None and self._slant is not None:
            weights = replace(weights, slant=self._slant[points])
        return Fields(grid or self._grid, self._placement.take(points), self._positions[points], weights)

    def lit_chunks(self, weights: Doubles) -> tuple[list[Integers], Integers]:
        """Return the chunks that have nonzero weights, and the points, divided among them as their time is."""
        if not self._chunks:
            return [], np.zeros(0, np.int64)
        lit = np.add.reduceat(weights[self._order].any(1), self._first) > 0
        chunks = [chunk for chunk in self._chunks if lit[chunk].any()]
        points = sum(int((self._last - self._first)[chunk].sum()) for chunk in chunks)
        # The chunks are in the order of the size of their patches.
        work = np.cumsum([(self._placement.samples[chunk].astype(float) ** 2).sum() for chunk in chunks])
        return chunks, np.diff((points * work / work[-1:]).round().astype(np.int64), prepend=0)

    def loss(self, chunks: list[Integers], weights: Doubles, arrived: float) -> float | None:
        """Return the fraction of the power through the microlenses' apertures that falls outside the patches.

        If there are gaps between the apertures, or lenses differ, the fraction is estimated from a few patterns.

        `arrived` is the sum of all samples, without the `gain`. The result is None if there is nothing to sum or a
        weight is negative.
        """
        if not chunks or weights.min() < 0:
            return None
        if not self._passes_all:
            chunks = self._alike(_some(np.concatenate(chunks)))
            # As if pixels recorded all of the light there.
            grid = replace(self._grid, camera=clear(self._grid.camera))
            power = np.add.reduceat(weights[self._order].sum(1), self._first)
            arrived = sum(float(power[chunk] @ arrived_power(self._fields(chunk, grid))) for chunk in chunks)
        sent = self._sent(chunks, weights)
        return 1 - arrived / sent if sent else None

    def _sent(self, chunks: list[Integers], weights: Doubles) -> float:
        """Return the sum of all samples if all power through the apertures fell on the patches."""
        power = weights[self._order].sum(1) * self._passed[self._order]
        if self._pupil_weights is not None:
            power = power * self._pupil_weights.lit()[self._order]
        per_pattern = np.add.reduceat(power, self._first)
        if not self._passes_all:
            for chunk in chunks:
                per_pattern[chunk] *= aperture_power(self._fields(chunk))
        return float(per_pattern[np.concatenate(chunks)].sum() / self._grid.pitch.prod())

    @property
    def _passes_all(self) -> bool:
        """Whether pixels record all light that their patches hold."""
        camera = self._camera
        return self._grid.microlenses.fills and camera.mla_transmissions is None and not has_response(camera)

    # -- adjoint ---------------------------------------------------------------------------------------

    def gather(self, image: Floats, job: Job, done: int, total: int) -> Doubles:
        """Return each point spread's inner product with an image.

        `done` of the `total` points of a job are already complete.
        """
        samples = self._recorder.spread(image)
        result = np.zeros((self._count, image.shape[2]))
        gain = self.gain
        copies = [
            [np.unique(self._shifts[self._first[p] : self._last[p]], axis=0, return_inverse=True) for p in chunk]
            for chunk in self._chunks
        ]

        def batches() -> Iterator[Gather]:
            for chunk, some in zip(self._chunks, copies, strict=True):
                fields = self._fields(chunk)
                moved = [Copies(shifts, np.ones((len(shifts), 1), np.float32)) for shifts, _ in some]
                box = reached(fields.placement.corner, int(fields.placement.samples[0]), moved)
                yield Gather(fields, moved, self._tile(samples, box))

        members = [int((self._last - self._first)[chunk].sum()) for chunk in self._chunks]
        results = job.each(batches(), members, done + self._count - sum(members), total)
        for chunk, some, products in zip(self._chunks, copies, results, strict=True):
            for pattern, (_, copy), product in zip(chunk, some, products, strict=True):
                result[self._order[self._first[pattern] : self._last[pattern]]] = gain * product[copy.reshape(-1)]
        return result

    def _tile(self, samples: Floats, box: Box) -> Floats:
        """Return a rectangle of recorded samples (channels, rows, columns), padded with zeros, where they lie."""
        recorded = self._recorder.box
        tile = backend_of(samples).arrays.zeros((len(samples), box.rows, box.columns), np.float32)
        top = box.top - recorded.top
        left = box.left - recorded.left
        rows = slice(max(top, 0), min(top + box.rows, recorded.rows))
        columns = slice(max(left, 0), min(left + box.columns, recorded.columns))
        if rows.start < rows.stop and columns.start < columns.stop:
            inner = slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)
            tile[(slice(None), *inner)] = samples[:, rows, columns]
        return tile

    # -- memory ----------------------------------------------------------------------------------------

    def memory(self, batch_map: BatchMap, channels: int = 1) -> float:
        """Return the memory in bytes that a sum takes in this process."""
        samples = float(self._placement.samples.max(initial=0))
        across = samples + float(_areas(samples)) + ZONES[-1] * float(self._grid.lens_samples.max())
        tile = 4 * channels * across**2
        # No more batches are under way than there are.
        workers, threads = (min(count, len(self._chunks)) for count in (batch_map.workers, batch_map.threads))
        fields = (threads + 1) * fields_memory(samples)
        return channels * self._recorder.memory + (workers + 1) * tile + fields

    def check_memory(self, batch_map: BatchMap, channels: int = 1) -> None:
        """Refuse sums too large for the memory."""
        memory = self.memory(batch_map, channels)
        largest = int(self._placement.samples.max(initial=0))
        patterns = len(self._positions)
        label = f"{self._count} points by patches of {largest} x {largest} samples"
        check_memory(memory, label)
        bytes_of_field = 8.0 * largest**2
        if patterns > _CHUNK and bytes_of_field > _PATCH_LIMIT:
            raise InputError(
                f"{label}: {patterns} patches, the largest of {bytes_of_field / 2**30:.2f} GiB, "
                f"{memory / 2**30:.1f} GiB at a time; for more than {_CHUNK} patches each may take "
                f"{_PATCH_LIMIT / 2**30:.2f} GiB"
            )


def _areas(samples: Any) -> Any:
    """Return the width in samples, for each patch size, of the region whose patches are added in one tile."""
    if on_cuda():
        # On a device a larger tile costs less than the kernels of more chunks.
        return np.maximum(4096, samples // 3)
    # Approximate number of samples across the region in which the corners of a chunk's patches lie.
    return np.clip(1024, samples // 3, 4 * samples)


def _some(patterns: Integers, count: int = 16) -> Integers:
    """Return a few of some patterns, at regular intervals: as many as losses are estimated from."""
    return np.unique(patterns[np.linspace(0, len(patterns) - 1, count).round().astype(np.int64)])


class PatchSum:
    """A sum of point spreads, computed batch by batch, with the interface of `runtime.batches.LongSum`."""

    def __init__(self, plan: PatchPlan, weights: Doubles):
        self._plan = plan
        self._weights = weights
        self._chunks, self.items = plan.lit_chunks(weights)
        self.arrays = active_backend().arrays
        self.box = plan._recorder.box
        self.channels = weights.shape[1]

    def batches(self, first: int) -> Iterator[Scatter]:
        """Yield the batches from index `first` on, in order."""
        return (self._plan.scatter(chunk, self._weights) for chunk in self._chunks[first:])

    def image(self, total: PartialSum) -> Floats:
        """Return the sum integrated over the recorded pixels, after a check of the fraction of light that arrived."""
        loss = self._plan.loss(self._chunks, self._weights, total.arrived / self._plan.gain)
        if loss is not None:
            guards.check(guards.PATCH, loss)
        return self._plan._recorder.record(total.sums)
