"""Where the time of a wave capture goes on one thread: profiled seconds of functions that do not call each other."""

from __future__ import annotations

import cProfile
import pstats
from collections.abc import Callable, Generator, Iterable
from typing import Any

import numpy as np

from mitsuba_plenoptic.operator.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.operator.patch import PatchBatch
from mitsuba_plenoptic.operator.recorder import Recorder
from mitsuba_plenoptic.operator.sharing import find_patterns
from mitsuba_plenoptic.operator.tile import PatchTile
from mitsuba_plenoptic.runtime.batches import Batch, add
from mitsuba_plenoptic.runtime.fft import fft
from mitsuba_plenoptic.runtime.jobs import Job

from .point_spreads import ScenePoints
from .table import Row, on_cores

# A function's time, less that of another which it calls.
_KINDS: dict[str, tuple[Callable[..., Any], ...]] = {
    "Fourier transforms": (fft,),
    "squares, added to tiles": (PatchTile.sum, PatchBatch.to_detector),
    "pupils, curvatures, transfer functions (Dr.Jit)": (PatchBatch.__init__,),
    "finding shared patterns": (find_patterns,),
    "tiles, added to the image": (add,),
    "integrals over pixels": (Recorder.record,),
}
_PARAMETERS = {"resolution": "512", "detector_width": "1.024"}
_EVERY = 20
"""Where nothing is shared, every which radiator is taken."""


def run() -> list[Row]:
    """Profile the middle of the letters, with the default accuracy and with nothing shared."""
    return on_cores(1, _rows)


def _rows() -> list[Row]:
    letters = ScenePoints.of("letters", _PARAMETERS)
    rows = []
    for accuracy, points in ((DEFAULT_ACCURACY, letters), (0.0, letters.take(np.s_[::_EVERY]))):
        _capture(letters.take(np.s_[:: len(letters.positions) // 64]), accuracy)  # compiles the kernels
        profile = cProfile.Profile()
        profile.runcall(_capture, points, accuracy)
        rows += _parts(f"letters, {points}, accuracy {accuracy:g}", profile)
    return rows


def _capture(points: ScenePoints, accuracy: float) -> None:
    points.operator(accuracy).forward(points.weights, job=Job(batch_map=_ThisThread()))


class _ThisThread:
    """Computes batches where they are profiled."""

    workers = threads = 1

    def __call__(self, batches: Iterable[Batch]) -> Generator[Any, None, None]:
        for batch in batches:
            yield batch.prepare()()


def _parts(what: str, profile: cProfile.Profile) -> list[Row]:
    statistics: Any = pstats.Stats(profile)

    def seconds(function: Callable[..., Any]) -> float:
        code = function.__code__
        key = (code.co_filename, code.co_firstlineno, code.co_name)
        return float(statistics.stats[key][3]) if key in statistics.stats else 0.0

    total = statistics.total_tt
    spent = {name: seconds(outer) - sum(map(seconds, inner)) for name, (outer, *inner) in _KINDS.items()}
    spent["the rest: products, turned blocks, the order of work"] = total - sum(spent.values())
    return [
        Row(f"{what}: {name}", "s", s, "the whole sum", total, s / total, note="fraction") for name, s in spent.items()
    ]
