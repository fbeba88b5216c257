"""Plan of the sum of points' spreads from the kernels of signed rays: images of coefficients, and one convolution.

The kernels are those of captures of scenes (`system.phase_space`), and serve all points together. `bank_rays` gives the
coefficients of each point in the cells that it lights. The work is done by blocks of the detector, each of which traces
all points whose light reaches it, in an order that depends on the points alone.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from ..camera import PlenopticCamera, has_small_lenses
from ..errors import refuse_if
from ..light.array_kernels import REACH
from ..light.convolution import Block, Convolution, blocks_of, box_of, cost_of, margin_of
from ..light.optical_system import OpticalSystem
from ..light.phase_space import FINE, PhaseSpace, parts_of, plan_of
from ..light.sampling import check_memory
from ..runtime.batches import BatchMap, Box, PartialSum
from ..runtime.fft import busy_drjit
from ..runtime.jobs import Job
from .bank_rays import BankRays, Lanes
from .patch_plan import Cost
from .pupil_weights import PupilWeights

_WINDOWS, _SAMPLES = (7, 9), (1, 2)
"""Windows of the table in lenses, and points of a cell along each axis, of usual and of finer plans. Captures of scenes
have wider windows: there the tails of the diffraction add up."""

_PARTS = 2
"""Smallest count of cells across a pixel: there is no random position within cells that would suppress aliasing."""

_BLOCK_BYTES = 2**29
"""Bytes of the images of one block of the detector."""

_TRIED = 8
"""Points that are timed for an estimate."""


class BankPlan:
    """The operator by kernels of signed rays, with the parameters of `PatchPlan`."""

    def __init__(
        self,
        system: OpticalSystem,
        points: NDArray[np.float64],
        pupil_weights: PupilWeights | None,
        accuracy: float,
    ) -> None:
        camera, fine = system.camera, accuracy < FINE
        refuse_if(
            has_small_lenses(camera, system.wavelength),
            f"mla_pitch = {camera.mla_pitch:g}: method bank takes lenses of at least 20 wavelengths; use patch",
        )
        refuse_if(
            pupil_weights is not None,
            "pupil_weights: method bank takes none, as their edges diffract; use patch",
        )
        refuse_if(
            camera.mla_medium != 1,
            f"mla_medium = {camera.mla_medium:g}: method bank takes 1 only; use patch",
        )
        self._plan = _plan(camera, system.wavelength, fine)
        refuse_if(
            self._plan.by_points,
            f"detector_distance = {camera.detector_distance:g}: method bank takes detectors near the focus of all "
            "microlenses; use patch",
        )
        self._system, self._camera, self._points = system, camera, points
        self._samples = _SAMPLES[fine]
        self._step = camera.pixel_size / max(_PARTS, parts_of(camera, system.wavelength, fine))

    @cached_property
    def rays(self) -> BankRays:
        """The rays of the points."""
        with busy_drjit():
            return BankRays(self._system, self._points, self._plan, self._step, self._samples)

    @cached_property
    def kernels(self) -> list[NDArray[np.float32]]:
        """The kernels of the coefficients, for one kind of lenses after another."""
        reach = REACH * max(self._camera.mla_pitches)
        return [
            kernel.astype(np.float32)
            for kind in range(len(self._plan.kinds))
            for kernel in self._plan.kernels(self._step, reach, kind)
        ]

    def blocks(self, channels: int) -> list[Box]:
        """Return the blocks of the detector's grid that are traced one after another."""
        bins = box_of(self._camera, self._step, margin_of(self.kernels))
        return blocks_of(bins, _BLOCK_BYTES // (4 * len(self.kernels) * channels))

    def convolution(self, blocks: list[Box]) -> Convolution:
        """Return the convolution of the images of blocks; cells, within which light is added, are parts of pixels."""
        return Convolution(self._camera, self.kernels, self._step, (blocks[0].rows, blocks[0].columns))

    def images(self, which: NDArray[np.int64], weights: NDArray[np.float64], block: Box) -> list[NDArray[np.float32]]:
        """Return for each channel of weights (n, channels) the images (kernels, rows, columns) of some points."""
        kinds, count = len(self._plan.kinds), self._plan.values
        sums = np.zeros((weights.shape[1], count, kinds * block.rows * block.columns), np.float32)
        for lanes, values in self.lots(which, block):
            used, row = np.unique(self._cells(lanes, block), return_inverse=True)
            own, size = weights[lanes.point.numpy()].astype(np.float32), (len(used), len(row))
            for total, factor in zip(sums, own.T, strict=True):
                adder = scipy.sparse.csr_matrix((factor, (row, np.arange(len(row)))), shape=size)
                for image, value in zip(total, values, strict=True):
                    image[used] += adder @ value
        shape = count, kinds, block.rows, block.columns
        return [np.moveaxis(total.reshape(shape), 1, 0).reshape(-1, block.rows, block.columns) for total in sums]

    def products(self, which: NDArray[np.int64], images: NDArray[np.float32], block: Box) -> NDArray[np.float64]:
        """Return for every point the products of its coefficients with images (channels, kernels, rows, columns)."""
        kinds, count = len(self._plan.kinds), self._plan.values
        every = np.moveaxis(images.reshape(len(images), kinds, count, -1), 2, 1).reshape(len(images), count, -1)
        made = np.zeros((len(self._points), len(images)))
        for lanes, values in self.lots(which, block):
            cells, point = self._cells(lanes, block), lanes.point.numpy()
            for channel, own in enumerate(every):
                products = sum(value * image[cells] for value, image in zip(values, own, strict=True))
                made[:, channel] += np.bincount(point, products, len(made))
        return made

    def lots(self, which: NDArray[np.int64], block: Box) -> Iterator[tuple[Lanes, list[NDArray[np.float32]]]]:
        """Yield the cells of a block that points light, and their coefficients."""
        lots = self.rays.lots(which, block)
        while True:
            # Dr.Jit's own threads rest while others convolve; here they are needed.
            with busy_drjit():
                found = next(lots, None)
            if found is None:
                return
            yield found

    def _cells(self, lanes: Lanes, block: Box) -> NDArray[np.int64]:
        """Return the positions of cells in the images of a block, one kind of lenses after another."""
        column, row = lanes.column.numpy() - block.left, lanes.row.numpy() - block.top
        kind = self.rays.kind(lanes).numpy().astype(np.int64) if len(self._plan.kinds) > 1 else 0
        return np.asarray((kind * block.rows + row) * block.columns + column, np.int64)

    def sum(self, weights: NDArray[np.float64]) -> BankSum:
        """Return the sum of the point spreads with these weights, (n, channels), yet to be computed."""
        return BankSum(self, self._camera, weights)

    def gather(self, image: NDArray[np.float32], job: Job, done: int, total: int) -> NDArray[np.float64]:
        """Return for every point the image weighted by its point spread; see `PatchPlan.gather`."""
        channels, result = image.shape[2], np.zeros((len(self._points), image.shape[2]))
        blocks = self.blocks(channels)
        reaching = [self.rays.reaching(block) for block in blocks]
        convolution = self.convolution(blocks)

        def batches() -> Iterator[_Made]:
            for block, which in zip(blocks, reaching, strict=True):
                images = [np.stack(list(convolution.adjoint(image[..., n], block))) for n in range(channels)]
                yield _Made(self.products(which, np.stack(images), block))

        items = _counts(reaching, len(self._points))
        left = done + len(self._points) - sum(items)
        for part in job.each(batches(), items, left, total):
            result += part
        return result

    def memory(self, channels: int = 1) -> float:
        """Return the memory in bytes that a sum takes."""
        block = self.blocks(channels)[0]
        images = 4.0 * len(self.kernels) * channels * block.rows * block.columns
        table = 4.0 * self._plan.values * sum((node.angular + 1) * math.prod(node.counts) for node in self._plan.nodes)
        # A block is traced, in two layouts, while others wait and are convolved; tables are averaged in a copy.
        return 4 * images + 3 * table

    def check_memory(self, batch_map: BatchMap, channels: int = 1) -> float:
        """Return the memory in bytes that a sum takes, or refuse it."""
        memory = self.memory(channels)
        check_memory(memory, f"{len(self._points)} points by the kernels of signed rays")
        return memory

    def cost(self, batch_map: BatchMap) -> Cost:
        """Estimate the cost of a sum from a few points and one tile of the convolutions."""
        memory, blocks = self.check_memory(batch_map), self.blocks(1)
        lit = np.unique(np.concatenate([self.rays.reaching(block) for block in blocks]))
        seconds, _ = cost_of([self.convolution(blocks)], blocks[0], sum(each.rows * each.columns for each in blocks))
        some, taken = lit[:: max(1, len(lit) // _TRIED)], 0.0
        # The first run compiles the kernels.
        for _ in range(2):
            start = time.perf_counter()
            self.images(some, np.ones((len(self._points), 1)), blocks[0])
            taken = time.perf_counter() - start
        return Cost(len(lit), len(lit), seconds + taken / max(len(some), 1) * len(lit), memory)


@functools.lru_cache(maxsize=16)
def _plan(camera: PlenopticCamera, wavelength: float, fine: bool) -> PhaseSpace:
    """Return a usual or a finer plan of the table and the kernels."""
    plan = plan_of(camera, wavelength, fine, wavelength)
    return replace(plan, window=_WINDOWS[fine])


def _counts(reaching: list[NDArray[np.int64]], count: int) -> list[int]:
    """Return for each block the number of points that reach it and no block before."""
    seen, made = np.zeros(count, bool), []
    for which in reaching:
        made.append(int(np.count_nonzero(~seen[which])))
        seen[which] = True
    return made


@dataclass(frozen=True)
class _Made:
    """A batch whose result is already computed."""

    result: NDArray[np.float64]

    @property
    def samples(self) -> int:
        """Number of results."""
        return self.result.size

    def prepare(self) -> Callable[[], NDArray[np.float64]]:
        """Return a function that returns the result."""
        return lambda: self.result


class BankSum:
    """A sum by the kernels of signed rays, block by block, with the interface of `runtime.jobs.LongSum`."""

    def __init__(self, plan: BankPlan, camera: PlenopticCamera, weights: NDArray[np.float64]) -> None:
        self._plan, self._weights = plan, weights
        self.arrays: Any = np
        self.box, self.channels = Box(0, 0, camera.shape[1], camera.shape[0]), weights.shape[1]
        self._all = plan.blocks(self.channels)
        lit = np.asarray(weights.any(1))
        reaching = [which[lit[which]] for which in (plan.rays.reaching(block) for block in self._all)]
        self._blocks = [(block, which) for block, which in zip(self._all, reaching, strict=True) if len(which)]
        self.items = np.array(_counts([which for _, which in self._blocks], len(weights)), np.int64)

    def batches(self, first: int) -> Iterator[Block]:
        """Trace the points of the blocks from index `first`, and yield their images, which are to be convolved."""
        for block, which in self._blocks[first:]:
            images = self._plan.images(which, self._weights, block)
            yield Block(block, images, [self._convolution] * self.channels, range(self.channels))

    @cached_property
    def _convolution(self) -> Convolution:
        return self._plan.convolution(self._all)

    def image(self, total: PartialSum) -> NDArray[np.float32]:
        """Move the channels to the last axis."""
        return np.ascontiguousarray(np.moveaxis(total.sums, 0, -1))
