"""Baselines of the benchmark: methods of this package that answer its tasks.

Each baseline is a function of a `Question` and returns answers by task name; a new one is one more entry in
`BASELINES`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.ndimage
import xarray as xr

from ...camera import PlenopticCamera
from ...errors import refuse_if, require_choice
from ...io.captures import Capture
from ...refocus import reconstruct
from ...runtime.backend import DEFAULT_VARIANT, set_variant
from ...runtime.batches import Progress, counted
from ...runtime.files import atomic_output
from ...views import decode, depth_map, distance_of, micro_images, view
from .contents import CAPTURES, DISTANCES, FINER, PUPIL_POINTS, WAVELENGTH, Benchmark, capture_of, model_of
from .score import answer_folder

Answers = dict[str, np.ndarray]


@dataclass(frozen=True)
class Question:
    """A capture for which a benchmark asks answers, with the white capture of its camera."""

    capture: Capture
    white: Capture
    # What depends on the white capture alone, by method: questions of one camera share it.
    of_white: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def camera(self) -> PlenopticCamera:
        """Camera of the capture."""
        return self.capture.camera

    @cached_property
    def light_field(self) -> xr.DataArray:
        """Light field decoded from the capture."""
        return decode(self.capture, white=self.white)


def _plain(question: Question) -> Answers:
    """Return answers for a scene entirely in focus, which every method should exceed."""
    lf = question.light_field
    central = view(lf, u=0.0, v=0.0).values
    return {
        "depth": np.full(central.shape, question.camera.focus_distance),
        "refocus": np.stack([central] * len(DISTANCES)),
        "views": np.stack([_finer(central)] * len(PUPIL_POINTS)),
    }


def _ray(question: Question) -> Answers:
    """Return answers by rays: depth from views, refocusing by footprints of lenses, and interpolated views."""
    lf, radius = question.light_field, question.camera.aperture_radius
    found = depth_map(lf, micro_images=micro_images(question.capture, white=question.white))
    views = [lf.interp(u=x * radius, v=y * radius, kwargs={"fill_value": None}).values for x, y in PUPIL_POINTS]
    return {
        # The best guess, also where it is not sure.
        "depth": distance_of(lf, found.disparity.values),
        "refocus": _images(question.capture, method="ray", white=question.white),
        "views": np.stack([_finer(view) for view in views]),
    }


def _finer(picture: np.ndarray) -> np.ndarray:
    """Return a picture interpolated to `FINER` pixels per bin by cubic splines."""
    across = (np.arange(FINER * picture.shape[1]) + 0.5) / FINER - 0.5
    down = (np.arange(FINER * picture.shape[0]) + 0.5) / FINER - 0.5
    return np.asarray(scipy.ndimage.map_coordinates(picture, np.meshgrid(down, across, indexing="ij"), mode="nearest"))


def _images(capture: Capture, **options: Any) -> np.ndarray:
    return np.stack([each.image for each in reconstruct(capture, DISTANCES, **options)])


def _by_waves(question: Question, *, method: str) -> Answers:
    """Return the capture refocused by waves over the white capture refocused alike; displacements stay, for speed."""
    options = {"method": method, "wavelength": WAVELENGTH}
    if method not in question.of_white:
        question.of_white[method] = _images(question.white, **options)
    return {"refocus": _images(question.capture, **options) / question.of_white[method]}


def _deconvolved(question: Question) -> Answers:
    """Refocus by deconvolution, which finds planes whose simulated captures equal the recorded one."""
    return {"refocus": _images(question.capture, method="deconvolved")}


BASELINES: dict[str, Callable[[Question], Answers]] = {
    "plain": _plain,
    "ray": _ray,
    "coherent": functools.partial(_by_waves, method="coherent"),
    # Four coherent waves, of every second lens.
    "partial": functools.partial(_by_waves, method="partial"),
    "deconvolved": _deconvolved,
}
"""Baselines by name."""


def run_baseline(
    name: str,
    made: Benchmark,
    folder: str | Path,
    captures: Sequence[str] = CAPTURES,
    *,
    progress: Progress | None = None,
) -> None:
    """Answer the tasks of a benchmark by a baseline, as NumPy files.

    Parameters
    ----------
    name : str
        Name of the baseline.
    made : Benchmark
        The benchmark.
    folder : path
        Folder for the answers, which `score` reads.
    captures : sequence of str
        Kinds of captures to answer.
    progress : callable, optional
        Called with the captures done and their number.

    Raises
    ------
    InputError
        If there is no such baseline or kind of capture, or a file cannot be written.
    """
    refuse_if(name == "network", "baseline = network: it is gone since version 2.0; use ray")
    answer = BASELINES[require_choice("baseline", name, BASELINES)]
    wanted = [require_choice("captures", capture, CAPTURES) for capture in captures]
    set_variant(DEFAULT_VARIANT)
    # White captures are read once for each camera and model, and so is what follows from them.
    tasks = [
        (index % len(made.cameras), model_of(capture), capture, index) for index in made.entries() for capture in wanted
    ]
    shared: dict[tuple[int, str], tuple[Capture, dict[str, np.ndarray]]] = {}
    for camera, model, capture, index in counted(sorted(tasks), progress):
        if (camera, model) not in shared:
            shared = {(camera, model): (made.white(index, model), {})}
        found = answer(Question(capture_of(made[index], capture), *shared[camera, model]))
        place = answer_folder(Path(folder), made, index, capture)
        place.mkdir(parents=True, exist_ok=True)
        for task, array in found.items():
            with atomic_output(place / f"{task}.npy") as temporary:
                np.save(temporary, np.asarray(array, np.float32))
