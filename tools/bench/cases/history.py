"""Ten figures at sizes that take seconds: what is slow, what takes memory, and how exact it is; asv follows them."""

from __future__ import annotations

import functools
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, load_scene, point_spread_function, reconstruct
from mitsuba_plenoptic import render_capture as render
from mitsuba_plenoptic.views import depth_map

from .. import Row, case, figure, pick
from ..measures import relative
from ..timing import alone, in_process, peak_memory

SMALL = {"detector_width": 2.048, "resolution": 1024, "letter_scale": 0.25}
DISTANCES = (210.0, 240.0, 280.0)


def letters() -> Any:
    """Load the letters before a quarter of the paper's camera."""
    return load_scene("letters", parameters=SMALL)


@functools.cache
def captured(model: str) -> Capture:
    """Render them."""
    return render(letters(), model=model, spp=16)


def _seconds(work: Callable[[], object]) -> float:
    return alone(work, 3).seconds


def _import_time() -> float:
    return _seconds(lambda: subprocess.run([sys.executable, "-c", "import mitsuba_plenoptic"], check=True))


def _capture_time(model: str, spp: int) -> float:
    scene = letters()
    return _seconds(lambda: render(scene, model=model, spp=spp))


def _wave_memory() -> float:
    render(letters(), model="wave", spp=16)
    return peak_memory()


def _energy() -> float:
    return float(captured("wave").image.sum() / captured("ray").image.sum())


def _reconstruction_time(method: str) -> float:
    return _seconds(lambda: reconstruct(captured("wave"), DISTANCES, method=method))


def _patch_error() -> float:
    camera = PlenopticCamera(detector_width=1.024, resolution=(512, 512))
    quick, exact = (
        point_spread_function(camera, (0.1, -0.2, 215.0), wavelength=633.0, method=method).astype(np.float64)
        for method in ("patch", "full_field")
    )
    return relative(quick, exact)


def _depth_time() -> float:
    lf = decode(captured("ray"))
    return _seconds(lambda: depth_map(lf, 200.0, 300.0))


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
