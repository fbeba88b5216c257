"""The derivatives of a camera's images with respect to its numbers, over all wavelengths."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ...camera import PlenopticCamera
from ...errors import InputError
from ...optics import guards
from ...runtime.batches import Threads
from ...runtime.jobs import Job, Task
from ...runtime.limits import single_threaded_blas
from ...system.optical_system import OpticalSystem
from ..mixing import groups, mix
from ..pupil_weights import PupilWeights
from .plan import DerivativePlan, Direction


class Differentials:
    """The derivatives of the sum of all point spreads, planned for each wavelength when they are first asked for."""

    def __init__(
        self,
        camera: PlenopticCamera,
        points: NDArray[np.float64],
        pupil_weights: PupilWeights | None,
        accuracy: float,
        system_at: Callable[[float], OpticalSystem],
    ) -> None:
        self._system_at = system_at
        self._camera, self._points, self._pupil_weights, self._accuracy = camera, points, pupil_weights, accuracy
        self._plans: dict[float, DerivativePlan] = {}

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
            step = self._planned(wavelength).together(job.workers, len(some), len(directions))
            numbers = list(range(len(directions)))
            parts += [(wavelength, some, numbers[first : first + step]) for first in range(0, len(directions), step)]

        def tasks() -> Iterator[Task]:
            for wavelength, some, which in parts:
                plan = self._plan(wavelength, job, len(which) * len(some))
                change = partial(plan.jvp, weights[:, some], [directions[number] for number in which])
                own = np.kron(np.eye(len(directions), dtype=np.float32)[:, which], matrix[:, some])
                yield Task(len(self._points), change, partial(mix, matrix=own))

        with guards.watch():
            shape = (*self._camera.shape, len(directions) * len(matrix))
            return job.run(tasks(), shape, len(parts) * len(self._points))

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
                plan = self._plan(wavelength, job, len(some))
                counted = done * len(self._points), self._items(wavelengths)
                found = plan.vjp(weights[:, some], given, names, job, *counted)
                total = {name: found[name] + total.get(name, 0.0) for name in names}
        return total

    def _items(self, wavelengths: tuple[float, ...]) -> int:
        """Return the point spreads of all sums."""
        return len(set(wavelengths)) * len(self._points)

    def _plan(self, wavelength: float, job: Job, channels: int) -> DerivativePlan:
        """Return the plan at a wavelength, or refuse what it takes."""
        plan = self._planned(wavelength)
        plan.check_memory(job.workers, channels)
        return plan

    def _planned(self, wavelength: float) -> DerivativePlan:
        """Return the plan at a wavelength, made where there is none yet."""
        if wavelength not in self._plans:
            system = self._system_at(wavelength)
            self._plans[wavelength] = DerivativePlan(system, self._points, self._pupil_weights, self._accuracy)
        return self._plans[wavelength]


def _require_threads(job: Job) -> None:
    """Refuse jobs by which derivatives are not computed."""
    if not isinstance(job.workers, Threads):
        raise InputError("job: derivatives are computed by threads of this process only")
