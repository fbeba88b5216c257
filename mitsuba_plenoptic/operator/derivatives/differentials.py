"""The derivatives of a camera's images with respect to its numbers, over all wavelengths."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...errors import InputError
from ...optics import guards
from ...runtime.batches import Threads
from ...runtime.jobs import Job, SumTask
from ...runtime.limits import single_threaded_blas
from ..mixing import WavelengthPlans, groups, mix
from .plan import Direction


class Differentials:
    """The derivatives of the sum of all point spreads, planned for each wavelength when they are first asked for."""

    def __init__(self, camera: PlenopticCamera, points: int, plans: WavelengthPlans) -> None:
        self._camera, self._points, self._plans = camera, points, plans

    @single_threaded_blas()
    def jvp(
        self,
        weights: NDArray[np.float64],
        directions: list[Direction],
        wavelengths: tuple[float, ...],
        matrix: NDArray[np.float32],
        job: Job,
    ) -> NDArray[np.float32]:
        """Return the changes of the image in some directions, (rows, columns, directions times channels).

        The columns of `weights` have the `wavelengths` given, and `matrix` leads from them to the image's channels.
        """
        _require_threads(job)

        # As many directions at once as fit into memory.
        parts: list[tuple[float, list[int], list[int]]] = []
        for wavelength, some in groups(wavelengths):
            step = self._plans.at(wavelength).together(job.workers, len(some), len(directions))
            numbers = list(range(len(directions)))
            parts += [(wavelength, some, numbers[first : first + step]) for first in range(0, len(directions), step)]

        def tasks() -> Iterator[SumTask]:
            for wavelength, some, which in parts:
                plan = self._plans.checked(wavelength, job, len(which) * len(some))
                change = partial(plan.jvp, weights[:, some], [directions[number] for number in which])
                own = np.kron(np.eye(len(directions), dtype=np.float32)[:, which], matrix[:, some])
                yield SumTask(self._points, change, partial(mix, matrix=own))

        with guards.watch():
            shape = (*self._camera.shape, len(directions) * len(matrix))
            return job.run(tasks(), shape, len(parts) * self._points)

    @single_threaded_blas()
    def vjp(
        self,
        weights: NDArray[np.float64],
        image: NDArray[np.float32],
        names: tuple[str, ...],
        wavelengths: tuple[float, ...],
        matrix: NDArray[np.float32],
        job: Job,
    ) -> dict[str, NDArray[np.float64]]:
        """Return the gradients of numbers, by name, from that of the image, (rows, columns, channels)."""
        _require_threads(job)
        total: dict[str, NDArray[np.float64]] = {}
        with guards.watch():
            for done, (wavelength, some) in enumerate(groups(wavelengths)):
                given = mix(image, matrix[:, some].T)
                plan = self._plans.checked(wavelength, job, len(some))
                counted = done * self._points, len(set(wavelengths)) * self._points
                found = plan.vjp(weights[:, some], given, names, job, *counted)
                total = {name: found[name] + total.get(name, 0.0) for name in names}
        return total


def _require_threads(job: Job) -> None:
    """Refuse jobs by which derivatives are not computed."""
    if not isinstance(job.workers, Threads):
        raise InputError("job: derivatives are computed by threads of this process only")
