"""What sharing the propagations of points saves, what processes take to start, and ten figures that asv follows.

The ten figures, at sizes that take seconds, are what is slow, what takes memory, and how exact it is.
"""

from __future__ import annotations

import functools
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from cases import relative

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, load_scene, point_spread_function, reconstruct
from mitsuba_plenoptic import render_capture as render
from mitsuba_plenoptic.views import depth_map
from mitsuba_plenoptic.waves.accuracy import DEFAULT_ACCURACY

from .. import Row, at_most, case, figure, pick
from ..speed import SCENES, SPEED, ScenePoints
from ..timing import alone, in_process, once, peak_memory

_STILL_LIFE = SCENES["still_life"]
# name, scene, parameters, centre on the microlens array in millimetres, lenses across
_PARTS = (
    ("letters, '8' at 210 mm", "letters", {}, (-2.15, 0.475), 5),
    ("letters, 'F' in focus", "letters", {}, (-0.4, -0.58), 7),
    ("letters, '#' at 280 mm", "letters", {}, (1.84, -0.07), 5),
    ("still life, table", "still_life", _STILL_LIFE, (-0.5, 0.5), 7),
    ("still life, edges", "still_life", _STILL_LIFE, (0.5, -0.83), 5),
)


@case(
    "speed.sharing",
    "Sums of point spreads of the default accuracy against sums in which nothing is shared: how many times faster, and "
    "the error, on parts of scenes",
    SPEED,
    (at_most("difference", DEFAULT_ACCURACY),),
    page="docs/theory/accuracy.md",
    quick={"count": 1},
)
def sharing(*, scene: str = "", count: int = 5) -> Iterator[Row]:
    """Compare parts; a scene that is named is summed whole, which takes up to an hour."""
    if scene:
        points = ScenePoints.of(scene, pick(SCENES, [scene])[scene])
        yield _compare_accuracies(f"{scene}, {points}, all of them", points)
        return
    for name, scene_name, parameters, centre, across in _PARTS[:count]:
        points = ScenePoints.of(scene_name, parameters)
        camera, positions = points.camera, points.positions
        image = -positions[:, :2] * (camera.mla_distance / positions[:, 2:])
        part = points.take(np.flatnonzero((np.abs(image - centre) < across / 2 * camera.row_pitch).all(1)))
        yield _compare_accuracies(f"{name}: {len(part.positions)} points on {across} x {across} lenses", part)


def _compare_accuracies(what: str, points: ScenePoints) -> Row:
    (image, ours, busy), (exact, theirs, exact_busy) = (
        once(lambda a=accuracy: points.operator(a).forward(points.weights)) for accuracy in (DEFAULT_ACCURACY, 0.0)
    )
    return {
        "what": what, "unit": "s", "ours": ours, "against": "accuracy = 0", "theirs": theirs, "ratio": theirs / ours,
        "cpu_ratio": exact_busy / busy, "difference": relative(image, exact), "note": "times faster, each run once",
    }  # fmt: skip


_COMPLETE = {"_MITSUBA_PLENOPTIC_COMPLETE": "complete_bash", "COMP_WORDS": "mitsuba-plenoptic re", "COMP_CWORD": "1"}

# What is run, the environment, and the largest ratio.
STARTS: dict[str, tuple[list[str], dict[str, str], float | None]] = {
    "import mitsuba_plenoptic": (["-c", "import mitsuba_plenoptic"], {}, 2.0),
    "--help": (["-m", "mitsuba_plenoptic", "--help"], {}, 3.0),
    "completion of a command": (["-m", "mitsuba_plenoptic"], _COMPLETE, 3.0),
    "a misspelt command": (["-m", "mitsuba_plenoptic", "rendr"], {}, 3.0),
    "render --help": (["-m", "mitsuba_plenoptic", "render", "--help"], {}, 3.0),
    "a misspelt option of render": (["-m", "mitsuba_plenoptic", "render", "--misspelt"], {}, 3.0),
    "reconstruct --help": (["-m", "mitsuba_plenoptic", "reconstruct", "--help"], {}, 3.0),
    "view --help": (["-m", "mitsuba_plenoptic", "view", "--help"], {}, 3.0),
}


@case(
    "command.start",
    "Processor time of a new process, over that of one that imports Mitsuba alone",
    {"what": "{what}", "seconds": "{seconds:.2f}", "over `import mitsuba`": "{ratio:.1f}"},
    (at_most("ratio", "limit"),),
    page="docs/theory/accuracy.md",
    quick={"runs": 1, "names": ("--help",)},
)
def start(*, runs: int = 7, names: tuple[str, ...] = tuple(STARTS)) -> Iterator[Row]:
    """Start each process several times, in turn with one that imports Mitsuba."""
    for name in names:
        words, environment, limit = STARTS[name]
        times = np.array([(_seconds(["-c", "import mitsuba"], {}), _seconds(words, environment)) for _ in range(runs)])
        ratio = np.median(times[:, 1] / times[:, 0])
        yield {"what": name, "seconds": np.median(times[:, 1]), "ratio": ratio, "limit": limit}


def _seconds(words: list[str], environment: dict[str, str]) -> float:
    """Return the processor time of a process of Python, which may refuse what it is asked."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *words],
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


SMALL = {"detector_width": 2.048, "resolution": 1024, "letter_scale": 0.25}
DISTANCES = (210.0, 240.0, 280.0)


def letters() -> Any:
    """Load the letters before a quarter of the paper's camera."""
    return load_scene("letters", parameters=SMALL)


@functools.cache
def captured(model: str) -> Capture:
    """Render them."""
    return render(letters(), model=model, spp=16)


def _alone_seconds(work: Callable[[], object]) -> float:
    return alone(work, 3).seconds


def _import_time() -> float:
    return _alone_seconds(lambda: subprocess.run([sys.executable, "-c", "import mitsuba_plenoptic"], check=True))


def _capture_time(model: str, spp: int) -> float:
    scene = letters()
    return _alone_seconds(lambda: render(scene, model=model, spp=spp))


def _wave_memory() -> float:
    render(letters(), model="wave", spp=16)
    return peak_memory()


def _energy() -> float:
    return float(captured("wave").image.sum() / captured("ray").image.sum())


def _reconstruction_time(method: str) -> float:
    return _alone_seconds(lambda: reconstruct(captured("wave"), DISTANCES, method=method))


def _patch_error() -> float:
    camera = PlenopticCamera(detector_width=1.024, resolution=(512, 512))
    quick, exact = (
        point_spread_function(camera, (0.1, -0.2, 215.0), wavelength=633.0, method=method).astype(np.float64)
        for method in ("patch", "full_field")
    )
    return relative(quick, exact)


def _depth_time() -> float:
    lf = decode(captured("ray"))
    return _alone_seconds(lambda: depth_map(lf, 200.0, 300.0))


HISTORY: dict[str, tuple[Callable[[], float], str]] = {
    "import": (_import_time, "s"),
    "ray capture": (functools.partial(_capture_time, "ray", 64), "s"),
    "wave capture": (functools.partial(_capture_time, "wave", 16), "s"),
    "wave capture, peak memory": (functools.partial(in_process, _wave_memory), "GiB"),
    "wave capture, energy over the ray capture's": (_energy, ""),
    "reconstruction, ray": (functools.partial(_reconstruction_time, "ray"), "s"),
    "reconstruction, coherent": (functools.partial(_reconstruction_time, "coherent"), "s"),
    "reconstruction, partial": (functools.partial(_reconstruction_time, "partial"), "s"),
    "patch off the full field": (_patch_error, ""),
    "depth map": (_depth_time, "s"),
}
LIMITS = {"patch off the full field": 0.005}


@case("history", "The ten figures that `asv run` follows from commit to commit", quick={"only": ("patch", "import")})
def history(*, only: tuple[str, ...] = ()) -> Iterator[Row]:
    """Measure each."""
    for name, (measure, unit) in pick(HISTORY, only).items():
        yield figure(name, measure(), unit=unit, at_most=LIMITS.get(name))
