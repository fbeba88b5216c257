"""The response of a camera to the bins of object planes: from radiance to the capture, and the adjoint."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...capture.grid import Grid
from ...capture.recorder import Recorder
from ...runtime.jobs import Job
from .cells import Cells
from .kernels import make_kernel
from .plane import PlaneResponse, Zone, zones
from .wave_spreads import wave_batches, wave_grid

_ZONE = 16

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

    Attributes
    ----------
    planes : list of PlaneResponse
        One for each distance.
    cells : Cells
        How bins and samples are gathered.
    """

    def __init__(
        self,
        camera: PlenopticCamera,
        distances: Sequence[float],
        *,
        wavelength: float,
        oversample: int,
        job: Job | None = None,
    ) -> None:
        job = job or Job()
        grid = wave_grid(camera, distances, wavelength)
        self.cells = Cells(grid, oversample)
        all_pixels = np.full((1, 2), -_EVERYWHERE), np.full((1, 2), _EVERYWHERE)
        self._recorder = Recorder(camera, grid, *all_pixels)
        self._sampled = self.cells.holding(self._recorder.box)
        self.planes = [self._plane(distance, job, k, len(distances)) for k, distance in enumerate(distances)]

    def _plane(self, distance: float, job: Job, done: int, planes: int) -> PlaneResponse:
        index = self._sampled.index
        groups = zones(self._sampled, _ZONE)
        found = []
        bins = self.cells.bins[0] * self.cells.bins[1]
        before, total = done * len(groups) * bins, planes * len(groups) * bins
        for number, members in enumerate(groups):
            cell = index[members[len(members) // 2]]
            batches = wave_batches(self.cells, distance, cell)
            flat = list(itertools.chain(*batches))
            parts = job.each(flat, [0] * len(flat), before + number * bins, total)
            kernel = make_kernel(self.cells, cell, ([next(parts) for _ in some] for some in batches))
            found.append(Zone(members, kernel))
        return PlaneResponse(self.cells, self._sampled, found)

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
        samples = np.zeros((len(self._sampled), height, width), np.float32)
        for plane, radiance in zip(self.planes, values, strict=True):
            plane.add_forward(radiance, samples)
        sums = self.cells.join(samples, self._sampled, self._recorder.box)
        return self._recorder.record(sums[None])[..., 0]

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
        sums = self._recorder.spread(image[..., None])[0]
        samples = self.cells.split(sums, self._recorder.box, self._sampled)
        return [plane.adjoint(samples) for plane in self.planes]
