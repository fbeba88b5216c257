"""Derivatives of a sum of point spreads at one wavelength, forward and in reverse."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from ...camera import PlenopticCamera
from ...errors import InputError
from ...fields import OpticalSystem
from ...optics import guards
from ...runtime import (
    MEMORY_LIMIT,
    BatchMap,
    Doubles,
    Flags,
    Floats,
    Integers,
    Job,
    Numbers,
    PartialSum,
    SumTask,
    Threads,
    active_backend,
    add,
    largest_fitting,
    single_threaded_blas,
    turn,
    work_limit,
)
from ..accuracy import derivative_band_for, derivatives_share
from ..mixing import WavelengthPlans, groups, mix
from ..patch_factors import Fields
from ..patch_plan import PatchPlan
from ..pupil_weights import PupilWeights
from ..recorder import STEPS, Recorder
from ..tile import reached
from .by_parameter import MOVES, VaryingParameters
from .point_batches import (
    MOVED_COPIES,
    MOVED_LENSES,
    SHIFTED_COPIES,
    JvpBatch,
    SpreadCopies,
    VjpBatch,
    copy_slopes,
    varying_factors,
)

Direction = dict[str, Doubles]
"""Changes of parameters, by name."""


class DerivativePlan(PatchPlan):
    """Point spreads and their copies in other lenses, with the derivatives of their sum.

    In sums of many points, points share spreads as they do for images; otherwise each point has its own spread, whose
    intensity is sampled twice as finely as the field. The intensity has twice the field's bandwidth, and frequencies
    that would be aliased change fastest; in sums of many points they average out.
    """

    def __init__(self, system: OpticalSystem, points: Doubles, pupil_weights: PupilWeights | None, accuracy: float):
        # Behind a real lens the changes of copies differ from each other.
        shared = system.lens.is_uniform and derivatives_share(accuracy, len(points))
        band = derivative_band_for(accuracy, len(points))
        super().__init__(system, points, pupil_weights, accuracy, band=band, shared=shared)
        camera = system.camera
        self._wavelength = system.wavelength
        self._accuracy = accuracy
        self._finer = 1 if shared else 2
        low = self._finer * self._placement.corner
        size = self._finer * self._placement.samples[:, None]
        pattern = np.repeat(np.arange(len(self._first)), self._last - self._first)
        low = low[pattern] + self._finer * self._shifts
        size = size[pattern]
        fine = replace(self._grid, pitch=self._grid.pitch / self._finer)
        self._recorder = Recorder(camera, fine, low, low + size)
        # From samples of the patch between copies to the distance of their lenses.
        self._per_sample = self._grid.pitch / camera.image_growth

    def jvp(self, weights: Doubles, directions: list[Direction]) -> JvpSum:
        """Return the derivatives, not yet computed, of the sum with weights (n, channels) in some directions."""
        return JvpSum(self, weights, directions)

    def vjp(
        self, weights: Doubles, image: Floats, names: tuple[str, ...], job: Job, done: int, total: int
    ) -> dict[str, Doubles]:
        """Return gradients with respect to parameters, from the image's gradient (rows, columns, channels).

        `done` of the job's `total` points are already complete.
        """
        parameters = VaryingParameters(self._camera, self._wavelength, names)
        moves, copied = ([name for name in some if name in names] for some in (MOVES, MOVED_COPIES))
        shifted = self._shifted(names)
        summed = 3 if shifted else bool(moves)
        samples = self._recorder.spread(image)
        chunks, items = self.lit_chunks(weights)
        moving = self.moving(weights)
        offset = self.offset_for(names)
        varies = varying_factors(self._fields(chunks[0][:1]), parameters) if chunks else ()
        waiting = []

        def batches() -> Iterator[VjpBatch]:
            for chunk in chunks:
                fields, copies = self.lit(chunk, weights, moving)
                placement = fields.placement
                covered = reached(placement.corner, int(placement.samples[0]), copies, self._finer)
                tile = self._tile(samples, covered)
                waiting.append(VjpBatch(fields, copies, self._finer, offset, tile, int(summed), varies))
                yield waiting[-1]

        products = np.zeros((2, 2, 2))
        box = self._recorder.box
        sums = active_backend().arrays.zeros((summed * image.shape[2], box.rows, box.columns), np.float32)
        for result in job.each(batches(), items.tolist(), done + self._count - int(items.sum()), total):
            waiting.pop(0).gather(result, parameters)
            products[0] += result.products
            if result.spreads is not None:
                add(result.spreads, box, sums)
        plain, *placed = np.split(sums, summed) if summed else [sums]
        if placed:
            stepped = [self._recorder.spread(image, move) for move in STEPS]
            for axis, place in enumerate(placed):
                x, y = (float((step * place).sum(dtype=np.float64)) for step in stepped)
                products[1, :, axis] = turn(x, y, -self._grid.rotation)
        gradients = parameters.gradients()
        for name in copied:
            slopes = copy_slopes(self._camera, self._wavelength, name)
            gradients[name] = gradients[name] + np.einsum("cijk,ijk->c", slopes, products)
        for name in moves:
            change = self._recorder.record(plain, name)
            gradients[name] = gradients[name] + float(np.einsum("ijk,ijk->", change, image, dtype=np.float64))
        return gradients

    def _shifted(self, names: Iterable[str]) -> bool:
        """Return whether copies of spreads shift when some parameters change."""
        return bool(self._shifts.any()) and any(name in SHIFTED_COPIES for name in names)

    def offset_for(self, names: Iterable[str]) -> VaryingParameters | None:
        """Return parameters with a varying ``mla_offset``, if the changes of copies by `names` depend on the offset."""
        if not self._shifts.any() or not any(name in MOVED_LENSES for name in names):
            return None
        return VaryingParameters(self._camera, self._wavelength, ["mla_offset"])

    def moving(self, weights: Doubles) -> Flags:
        """Return a mask of the spreads whose copies are moved with the lattice relative to their points.

        The effect is proportional to the copies' weights and distances. Spreads with few or near copies take as long as
        others; those with the least effect, together a small fraction of the total, are omitted.
        """
        distances = np.abs(self._shifts * self._per_sample).sum(1) * np.abs(weights[self._order]).sum(1)
        amounts = np.add.reduceat(distances, self._first) if len(self._first) else distances
        order = np.argsort(amounts, kind="stable")
        counted = np.zeros(len(amounts), bool)
        # Fraction of the effect of a moved lattice on copies that may be neglected, over the accuracy.
        counted[order] = np.cumsum(amounts[order]) > 0.1 * self._accuracy * amounts.sum()
        return counted

    def lit(self, chunk: Integers, weights: Doubles, moving: Flags) -> tuple[Fields, list[SpreadCopies]]:
        """Return the spreads of a chunk with a nonzero weight, and their copies; `moving` marks moving patterns."""
        lit_spreads = []
        copies = []
        for pattern, shifts, factors in self._lit_copies(chunk, weights):
            lit_spreads.append(pattern)
            positions = shifts * self._per_sample
            moves = np.full(len(shifts), moving[pattern])
            copies.append(SpreadCopies(shifts, factors.astype(np.float32), positions, moves))
        return self._fields(np.array(lit_spreads, np.int64)), copies

    def check_memory(self, batch_map: BatchMap, channels: int = 1) -> None:
        """Refuse derivatives of all channels in all directions that are too large for the memory."""
        super().check_memory(batch_map, self._kept(channels))

    def together(self, batch_map: BatchMap, channels: int, directions: int) -> int:
        """Return the number of directions, at least 1, in which sums of some channels are differentiated together."""

        def memory(count: int) -> float:
            return self.memory(batch_map, self._kept(count * channels))

        return max(1, largest_fitting(memory, min(MEMORY_LIMIT, work_limit(memory(directions))), directions))

    def _kept(self, channels: int) -> int:
        """Return the number of images in memory for the derivatives of some channels."""
        return channels + 3 if self._finer == 1 else 4 * channels


class JvpSum:
    """Changes of a sum in several directions, batch by batch, with the interface of `runtime.batches.LongSum`."""

    def __init__(self, plan: DerivativePlan, weights: Doubles, directions: list[Direction]):
        self._plan = plan
        self._weights = weights
        self._directions = directions
        self._chunks, self.items = plan.lit_chunks(weights)
        self.arrays = active_backend().arrays
        self._placed = plan._shifted(name for changes in directions for name in changes)
        self.box = plan._recorder.box
        self.channels = (len(directions) + (3 if self._placed else 1)) * weights.shape[1]
        self._slopes = [
            sum(
                (
                    np.tensordot(change, copy_slopes(plan._camera, plan._wavelength, name), 1)
                    for name, change in changes.items()
                    if name in MOVED_COPIES
                ),
                start=np.zeros((2, 2, 2)),
            )
            for changes in directions
        ]

    def batches(self, first: int) -> Iterator[JvpBatch]:
        """Yield the batches in order, from index `first` on."""
        plan = self._plan
        slopes = tuple(lattice for lattice, _ in self._slopes)
        offset = plan.offset_for(name for changes in self._directions for name in changes)
        moving = plan.moving(self._weights)
        for chunk in self._chunks[first:]:
            varied = tuple(VaryingParameters(plan._camera, plan._wavelength, changes) for changes in self._directions)
            for varying, changes in zip(varied, self._directions, strict=True):
                varying.set_tangents(changes)
            fields, copies = plan.lit(chunk, self._weights, moving)
            yield JvpBatch(fields, copies, plan._finer, varied, slopes, offset, self._placed)

    def image(self, total: PartialSum) -> Floats:
        """Return the changes integrated over the recorded pixels, plus the changes due to the pixels' motion."""
        recorder = self._plan._recorder
        channels = self._weights.shape[1]
        count = len(self._directions) * channels
        image = recorder.record(total.sums[:count])
        plain = total.sums[count : count + channels]
        for first, (changes, (_, shifts)) in enumerate(zip(self._directions, self._slopes, strict=True)):
            channel_image = image[..., first * channels : (first + 1) * channels]
            for name in MOVES:
                change = changes.get(name, np.zeros(1))
                if change.any():
                    channel_image += float(change[0]) * recorder.record(plain, name)
            if self._placed and shifts.any():
                placed = np.split(total.sums[count + channels :], 2)
                turned = np.array(turn(shifts[0], shifts[1], self._plan._grid.rotation))
                for move, factors in zip(STEPS, turned, strict=True):
                    along_x, along_y = (float(factor) * place for factor, place in zip(factors, placed, strict=True))
                    channel_image += recorder.record(along_x + along_y, move)
        return image


class Differentials:
    """Derivatives of the sum of all point spreads, planned for each wavelength on first use."""

    def __init__(self, camera: PlenopticCamera, points: int, plans: WavelengthPlans):
        self._camera = camera
        self._points = points
        self._plans = plans

    @single_threaded_blas()
    def jvp(
        self, weights: Doubles, directions: list[Direction], wavelengths: Numbers, matrix: Floats, job: Job
    ) -> Floats:
        """Return the changes of the image in some directions, (rows, columns, directions times channels).

        The columns of `weights` have the given `wavelengths`; `matrix` maps them to the image's channels.
        """
        _require_threads(job)

        # Process as many directions together as fit into memory.
        parts = []
        for wavelength, some in groups(wavelengths):
            step = self._plans.at(wavelength).together(job.workers, len(some), len(directions))
            all_directions = list(range(len(directions)))
            parts += [
                (wavelength, some, all_directions[first : first + step]) for first in range(0, len(directions), step)
            ]

        def tasks() -> Iterator[SumTask]:
            for wavelength, some, numbers in parts:
                plan = self._plans.checked(wavelength, job, len(numbers) * len(some))
                change = partial(plan.jvp, weights[:, some], [directions[index] for index in numbers])
                columns = np.kron(np.eye(len(directions), dtype=np.float32)[:, numbers], matrix[:, some])
                yield SumTask(self._points, change, partial(mix, matrix=columns))

        with guards.watch():
            shape = (*self._camera.shape, len(directions) * len(matrix))
            return job.run(tasks(), shape, len(parts) * self._points)

    @single_threaded_blas()
    def vjp(
        self,
        weights: Doubles,
        image: Floats,
        names: tuple[str, ...],
        wavelengths: Numbers,
        matrix: Floats,
        job: Job,
    ) -> dict[str, Doubles]:
        """Return gradients with respect to parameters, by name, from the image's gradient (rows, columns, channels)."""
        _require_threads(job)
        total: dict[str, Doubles] = {}
        with guards.watch():
            for done, (wavelength, some) in enumerate(groups(wavelengths)):
                cotangent = mix(image, matrix[:, some].T)
                plan = self._plans.checked(wavelength, job, len(some))
                counted = done * self._points, len(set(wavelengths)) * self._points
                gradients = plan.vjp(weights[:, some], cotangent, names, job, *counted)
                total = {name: gradients[name] + total.get(name, 0.0) for name in names}
        return total


def _require_threads(job: Job) -> None:
    """Refuse jobs that derivatives do not support."""
    if not isinstance(job.workers, Threads):
        raise InputError("job: derivatives are computed by threads of this process only")
