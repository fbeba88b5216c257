"""The response of a camera to the bins of object planes: from radiance to the capture, and the adjoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...operator.recorder import Recorder
from ...runtime.backend import backend
from ...runtime.jobs import Job
from .cells import BinCells, to_bins
from .kernels import Kernel, PlaneResponse, SampleBlock, StoredResponse, make_kernel, require_response_memory, zones
from .spreads import ray_batches, ray_grid, wave_batches, wave_grid
from .variation import TotalVariation

Batches = Callable[[BinCells, float, NDArray[np.int64]], Sequence[Sequence[Any]]]
"""From the cells, a distance and a cell to the batches of each of its bins."""

_ZONE = 16
"""Lenses along an axis for which one kernel serves, where there is memory for as many as that makes."""

_MEMORY = 2 * 2**30
"""Bytes of a plane's kernels beyond which zones grow, and of all planes' beyond which they are kept on disk."""

_LIT = 0.6
"""Fraction of a kernel's blocks that hold light, at most."""

_EVERYWHERE = 2**40


class Response(StoredResponse):
    r"""The capture of object planes made of bins of even radiance: :math:`I = \sum_k A_k x_k`."""

    def __init__(
        self,
        camera: PlenopticCamera,
        distances: Sequence[float],
        *,
        wavelength: float | None,
        oversample: int,
        job: Job | None = None,
    ) -> None:
        job = job or Job()
        grid = ray_grid(camera) if wavelength is None else wave_grid(camera, distances, wavelength)
        self._batches: Batches = ray_batches if wavelength is None else wave_batches
        self.cells, self._camera, self._distances = BinCells(grid, oversample), camera, tuple(distances)
        all_pixels = np.full((1, 2), -_EVERYWHERE), np.full((1, 2), _EVERYWHERE)
        self._recorder = Recorder(camera, grid, *all_pixels)
        self._sampled = self.cells.holding(self._recorder.box)
        each = [self._kernel_memory(distance, oversample) for distance in distances]
        alike = _alike(camera, wavelength)
        groups = self._zones(max(each), alike)
        # Where all lenses are alike one kernel serves all zones, which share the work among the cores.
        asked = groups[len(groups) // 2 :][:1] if alike else groups
        super().__init__(len(distances) > 1 and _LIT * len(asked) * sum(each) > _MEMORY)
        self._require_memory(len(asked))
        bins, total = self.cells.bins[0] * self.cells.bins[1], len(distances) * len(asked)
        self.planes: list[PlaneResponse] = []
        for distance in distances:
            kernels: list[Kernel] = []
            for members in asked:
                done = (len(self.planes) * len(asked) + len(kernels)) * bins
                kernels.append(self._kernel(distance, members, job, done, total * bins))
            kernels = self._on_disk(kernels) * (len(groups) // len(kernels))
            self.planes.append(PlaneResponse(self.cells, self._sampled, groups, kernels))

    def _on_disk(self, kernels: list[Kernel]) -> list[Kernel]:
        """Return kernels whose matrices are read from the folder, if there is one."""
        matrices = [block.matrix for kernel in kernels for block in kernel.blocks]
        stored = iter(self._stored(matrices, f"{len(self.planes)}"))
        return [
            Kernel(kernel.steps, [SampleBlock(b.rows, b.columns, b.steps, next(stored)) for b in kernel.blocks])
            for kernel in kernels
        ]

    def _kernel(self, distance: float, members: NDArray[np.int64], job: Job, done: int, total: int) -> Kernel:
        """Compute the kernel of a zone from the spreads of the cell in its middle."""
        cell = self._sampled.index[members[len(members) // 2]]
        batches = self._batches(self.cells, distance, cell)
        flat = [batch for some in batches for batch in some]
        share = [int(number == len(some) - 1) for some in batches for number in range(len(some))]
        parts = job.each(flat, share, done, total)
        return make_kernel(self.cells, cell, ([next(parts) for _ in some] for some in batches))

    def _zones(self, kernels: float, alike: bool) -> list[NDArray[np.int64]]:
        """Cut the cells into zones, so few that their kernels fit where each has its own."""
        width, rows = _ZONE, len(self._sampled.count)
        widest = max(rows, int(self._sampled.count.max()))
        while True:
            groups = zones(self._sampled, width)
            if alike or width >= widest or len(groups) * kernels <= _MEMORY:
                return groups
            width *= 2

    def _kernel_memory(self, distance: float, oversample: int) -> float:
        """Estimate the bytes of one kernel of a plane, with all of its blocks."""
        camera, grid = self.cells.camera, self.cells.grid
        samples = 1.1 * camera.blur_diameter(distance) / grid.pitch.min() + 8 / grid.pitch.min() * camera.pixel_size
        across, down = (samples / size + 2 for size in self.cells.size)
        return float(4 * across * down * oversample**2 * np.prod(grid.lens_samples.diagonal()) * _period(camera))

    def _require_memory(self, groups: int) -> None:
        def memory(oversample: int) -> float:
            each = [self._kernel_memory(distance, oversample) for distance in self._distances]
            bins = 4.0 * len(self._sampled) * _period(self.cells.camera) * oversample**2 * len(each)
            samples = 4.0 * self._recorder.box.rows * self._recorder.box.columns
            kernels = _LIT * groups * (max(each) if self._folder else sum(each))
            return kernels + 2 * max(each) + 12 * bins + 4 * samples + self._recorder.memory

        require_response_memory(memory, self.cells.oversample, self._distances)

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Cells and their bins, of each plane."""
        return [plane.shape for plane in self.planes]

    def variation(self) -> TotalVariation:
        """Return the total variation of its planes."""
        return TotalVariation.of_cells(self.cells, [plane.lit for plane in self.planes])

    def to_image(self, values: NDArray[np.float32], plane: int) -> NDArray[np.float32]:
        """Return numbers of a plane's bins, (cells, bins), as those of the upright bins of a reconstruction."""
        lit, distance = self.planes[plane].lit, self._distances[plane]
        return to_bins(values, self.cells, lit, self._camera, distance, self.cells.oversample)

    def forward(self, values: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        """Record planes."""
        width, height = self.cells.size
        libraries = backend()
        samples = libraries.arrays.zeros((len(self._sampled), height, width), np.float32)
        for plane, radiance in zip(self.planes, values, strict=True):
            plane.add_forward(radiance, samples)
        sums = self.cells.join(libraries.to_host(samples), self._sampled, self._recorder.box)
        return self._recorder.record(libraries.arrays.asarray(sums[None]))[..., 0]

    def adjoint(self, image: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Apply the transpose of `forward`."""
        libraries = backend()
        sums = libraries.to_host(self._recorder.spread(image[..., None])[0])
        samples = libraries.arrays.asarray(self.cells.split(sums, self._recorder.box, self._sampled))
        return [plane.adjoint(samples) for plane in self.planes]


def _alike(camera: PlenopticCamera, wavelength: float | None) -> bool:
    """Whether points a lens apart have one spread: behind an objective, and by rays where there are no aberrations."""
    by_rays = wavelength is None and camera.lens_model == "ideal" and not any(camera.wavefront)
    return by_rays or camera.objective is not None


def _period(camera: PlenopticCamera) -> int:
    """Return how many lenses a cell stands for."""
    return len(camera.mla_focal_lengths)
