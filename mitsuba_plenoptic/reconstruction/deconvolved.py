"""Deconvolution: the planes whose capture by this very camera is the one that was recorded."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..design import resolution_limit
from ..errors import InputError
from ..runtime.jobs import Job
from .deconvolution.noise import Noise
from .deconvolution.response import Response
from .deconvolution.solver import Solution, richardson_lucy
from .deconvolution.to_bins import to_bins
from .methods import Found, Task, method

DEFAULT_ITERATIONS, MOST_ITERATIONS = 30, 100
"""Steps where nothing is known of the noise, and at most where it is."""

_LEAST_SEEN = 0.01
"""Light of a bin, over that of the best one, below which it is NaN."""

_PLANNING = 0.3
"""Fraction of the progress that counts for the point spreads."""


@method("deconvolved", options=("response", "iterations", "accelerate", "photons", "volume"), waves=True, as_it_is=True)
def refocus(
    task: Task,
    *,
    response: str,
    iterations: int | None,
    accelerate: bool,
    photons: float | None,
    volume: bool,
) -> list[Found]:
    """Invert the response of the camera by Richardson's and Lucy's iteration (see `deconvolution.solver`).

    Each plane alone explains the whole capture, or all of them do together as a volume. Light from elsewhere is put
    down to the planes all the same.

    Returns
    -------
    list of Found
        Radiance, and what is known of it.
    """
    if task.white is not None:
        raise InputError("white: method deconvolved knows the light of every bin itself; it takes no white capture")
    noise = Noise.of(task.exposure, photons)
    _require_light(task.image, noise)
    groups: list[Sequence[float]] = [task.distances] if volume else [[distance] for distance in task.distances]
    channels = task.image.shape[2]
    work = len(groups) * channels
    found: list[list[tuple[NDArray[np.float32], Solution]]] = [[] for _ in task.distances]
    for number, (channel, group) in enumerate((c, g) for c in range(channels) for g in range(len(groups))):

        def report(done: float, number: int = number) -> None:
            task.progress((number + done) / work)

        first = 0 if volume else group
        solved = _solve(task, groups[group], channel, response, iterations, accelerate, noise, report)
        for k, result in enumerate(solved):
            found[first + k].append(result)
    return [
        Found(np.stack([image for image, _ in of_plane], axis=-1), _facts(task, distance, of_plane, response))
        for distance, of_plane in zip(task.distances, found, strict=True)
    ]


def _solve(
    task: Task,
    distances: Sequence[float],
    channel: int,
    response: str,
    iterations: int | None,
    accelerate: bool,
    noise: Noise | None,
    report: Any,
) -> Iterator[tuple[NDArray[np.float32], Solution]]:
    """Yield image and solution of each plane, from one channel."""
    image = np.ascontiguousarray(task.image[..., channel])
    job = Job(progress=lambda done, total: report(_PLANNING * done / total))
    made = Response(
        task.camera,
        distances,
        wavelength=None if response == "ray" else task.wavelengths[channel],
        oversample=task.oversample,
        job=job,
    )
    known = iterations is None and noise is not None
    solution = richardson_lucy(
        made,
        image,
        iterations=iterations or (MOST_ITERATIONS if known else DEFAULT_ITERATIONS),
        accelerate=accelerate,
        misfit=noise.misfit if known and noise else None,
        shift=noise.shift if noise else 0.0,
        progress=lambda done: report(_PLANNING + (1 - _PLANNING) * done),
    )
    for plane, values, seen in zip(made.planes, solution.values, solution.seen, strict=True):
        radiance, light = (
            to_bins(part, made.cells, plane.lit, task.camera, task.oversample) for part in (values, seen)
        )
        yield np.where(light >= _LEAST_SEEN, radiance, np.float32(np.nan)), solution


def _facts(
    task: Task, distance: float, of_plane: list[tuple[NDArray[np.float32], Solution]], response: str
) -> dict[str, Any]:
    """Return what is known of a plane."""
    wavelengths: Sequence[float | None] = task.wavelengths or [None]
    limits = [resolution_limit(task.camera, distance, wavelength) for wavelength in wavelengths]
    return {
        "iterations": max(solution.iterations for _, solution in of_plane),
        "residual": max(solution.residual for _, solution in of_plane),
        "stopped_by_noise": all(solution.stopped for _, solution in of_plane),
        "resolution_limit": min(limit.frequency for limit in limits),
        "in_focus": any(limit.in_focus for limit in limits),
    }


def _require_light(image: NDArray[np.float32], noise: Noise | None) -> None:
    """Refuse what no light can have made."""
    if not (image > 0).any():
        raise InputError("capture: none of its pixels is lit: there is nothing to deconvolve")
    negative = int(np.count_nonzero(image < 0))
    if negative and noise is None:
        raise InputError(
            f"capture: {negative} of its pixels are below 0, the least of them {float(image.min()):.3g}: no light "
            "makes these; photons= or the exposure of the capture tells what noise does"
        )
    if float(image.sum(dtype=np.float64)) <= 0:
        raise InputError("capture: the sum of its pixels is not above 0: there is no light to deconvolve")
