"""The response of a camera to the bins of object planes: from radiance to the capture, and the adjoint."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...operator.recorder import Recorder
from ...runtime.backend import backend
from ...runtime.jobs import Job
from ...runtime.limits import largest_fitting, require_memory
from .cells import Cells, to_bins
from .kernels import Kernel, PlaneResponse, Zone, make_kernel, on_disk, zones
from .spreads import ray_batches, ray_grid, wave_batches, wave_grid
from .variation import TotalVariation

Batches = Callable[[Cells, float, NDArray[np.int64]], Sequence[Sequence[Any]]]
"""From the cells, a distance and a cell to the batches of each of its bins."""

_ZONE = 16
"""Lenses along an axis for which one kernel serves, where there is memory for as many as that makes."""

_MEMORY = 2 * 2**30
"""Bytes of a plane's kernels beyond which zones grow, and of all planes' beyond which they are kept on disk."""

_LIT = 0.6
"""Fraction of a kernel's blocks that hold light, at most."""

_EVERYWHERE = 2**40


class Response:
    r"""The capture of object planes made of bins of even radiance: :math:`I = \sum_k A_k x_k`.

    Parameters
    ----------
    camera : PlenopticCamera
        The camera; its recorded window may be a crop.
    distances : sequence of float
        Of the planes.
    wavelength : float, optional
        Wavelength in nanometres; None: light goes by rays.
    oversample : int
        Bins along a lens pitch.
    job : Job, optional
        Who computes the point spreads, and who is told of the progress.

    Kernels of many planes are kept in a temporary folder; as a context it removes the folder when it is left, else that
    is done when nothing refers to it any more.

    Attributes
    ----------
    planes : list of PlaneResponse
        One for each distance.
    cells : Cells
        How bins and samples are gathered.

    Raises
    ------
    InputError
        If it would need too much memory.
    """

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
        self.cells, self._camera, self._distances = Cells(grid, oversample), camera, tuple(distances)
        all_pixels = np.full((1, 2), -_EVERYWHERE), np.full((1, 2), _EVERYWHERE)
        self._recorder = Recorder(camera, grid, *all_pixels)
        self._sampled = self.cells.holding(self._recorder.box)
        each = [self._kernel_memory(distance, oversample) for distance in distances]
        alike = _alike(camera, wavelength)
        groups = self._zones(max(each), alike)
        # Where all lenses are alike one kernel serves all zones, which share the work among the cores.
        asked = groups[len(groups) // 2 :][:1] if alike else groups
        self._folder = None
        if _LIT * len(asked) * sum(each) > _MEMORY and len(distances) > 1:
            self._folder = tempfile.TemporaryDirectory(prefix="deconvolution-")
        self._require_memory(distances, len(asked), oversample)
        bins, total = self.cells.bins[0] * self.cells.bins[1], len(distances) * len(asked)
        self.planes: list[PlaneResponse] = []
        for distance in distances:
            kernels: list[Kernel] = []
            for members in asked:
                done = (len(self.planes) * len(asked) + len(kernels)) * bins
                kernels.append(self._kernel(distance, members, job, done, total * bins))
            if self._folder:
                kernels = on_disk(kernels, Path(self._folder.name) / f"{len(self.planes)}")
            each_zone = kernels * len(groups) if alike else kernels
            found = [Zone(members, kernel) for members, kernel in zip(groups, each_zone, strict=True)]
            self.planes.append(PlaneResponse(self.cells, self._sampled, found))

    def __enter__(self) -> Response:
        return self

    def __exit__(self, *error: object) -> None:
        if self._folder:
            self._folder.cleanup()

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

    def _require_memory(self, distances: Sequence[float], groups: int, oversample: int) -> None:
        """Refuse what does not fit, before anything is allocated."""

        def memory(oversample: int) -> float:
            each = [self._kernel_memory(distance, oversample) for distance in distances]
            bins = 4.0 * len(self._sampled) * _period(self.cells.camera) * oversample**2 * len(distances)
            samples = 4.0 * self._recorder.box.rows * self._recorder.box.columns
            kernels = _LIT * groups * (max(each) if self._folder else sum(each))
            return kernels + 2 * max(each) + 12 * bins + 4 * samples + self._recorder.memory

        def fitting(limit: float) -> str | None:
            largest = largest_fitting(memory, limit, oversample)
            return f"oversample = {largest}" if largest else None

        planes = f"{len(distances)} planes" if len(distances) > 1 else f"the plane at {distances[0]:g}"
        require_memory(memory(oversample), f"oversample = {oversample}: deconvolution of {planes}", fitting)

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
        """Record planes.

        Parameters
        ----------
        values : sequence of float32 arrays (cells, bins)
            Radiance, for each plane.

        Returns
        -------
        float32 array (rows, columns)
        """
        width, height = self.cells.size
        libraries = backend()
        samples = libraries.arrays.zeros((len(self._sampled), height, width), np.float32)
        for plane, radiance in zip(self.planes, values, strict=True):
            plane.add_forward(radiance, samples)
        sums = self.cells.join(libraries.to_host(samples), self._sampled, self._recorder.box)
        return self._recorder.record(libraries.arrays.asarray(sums[None]))[..., 0]

    def adjoint(self, image: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Apply the transpose of `forward`.

        Parameters
        ----------
        image : float32 array (rows, columns)
            Of the recorded pixels.

        Returns
        -------
        list of float32 arrays (cells, bins)
        """
        libraries = backend()
        sums = libraries.to_host(self._recorder.spread(image[..., None])[0])
        samples = libraries.arrays.asarray(self.cells.split(sums, self._recorder.box, self._sampled))
        return [plane.adjoint(samples) for plane in self.planes]


def _alike(camera: PlenopticCamera, wavelength: float | None) -> bool:
    """Whether points a lens apart have one spread: behind an objective, and by rays where there are no aberrations."""
    by_rays = wavelength is None and camera.lens_model == "ideal" and not any(camera.wavefront)
    return by_rays or not camera.lens_data.converges


def _period(camera: PlenopticCamera) -> int:
    """Return how many lenses a cell stands for."""
    return len(camera.mla_focal_lengths)
