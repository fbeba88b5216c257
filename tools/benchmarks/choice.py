"""Which method `auto` chooses for captures by waves, and what the estimates of both are."""

from __future__ import annotations

from collections.abc import Iterator

from mitsuba_plenoptic import InputError, estimate_capture, load_scene
from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.capture.accuracy import DEFAULT_ACCURACY
from mitsuba_plenoptic.capture.choice import bank_is_better
from mitsuba_plenoptic.capture.sight import Sight

from .table import Row

_SCENES = ("letters", "still_life", "vitrine")
_WIDTHS = (512, 1024, 2048, 4096)
"""Pixels across the detectors, all of the paper's size of pixel."""

_PER_LENS = 8


def run() -> Iterator[Row]:
    """Estimate captures of some scenes and sizes by the chosen method and by the other; both have been compiled."""
    for name in _SCENES:
        for width in _WIDTHS:
            scene = load_scene(name, parameters={"resolution": str(width), "detector_width": str(width * 0.002)})
            sensor = scene.sensors()[0]
            camera = PlenopticCamera.from_sensor(sensor)
            sight = Sight.of(scene, sensor, scene.integrator(), None)
            bank = bank_is_better(camera, sight, 633.0, _PER_LENS**2, DEFAULT_ACCURACY, 0)
            methods = ("bank", "patch") if bank else ("patch", "bank")
            ours, theirs = (_least(scene, method) for method in methods)
            yield Row(
                f"{name}, {width} x {width}, `auto` takes {methods[0]}", "s estimated",
                ours, methods[1], theirs, ours and theirs and ours / theirs,
                note="" if theirs else f"{methods[1]} is refused",
            )  # fmt: skip


def _least(scene: object, method: str) -> float | None:
    """Return the estimated time, None where it would take too much memory."""
    try:
        return min(estimate_capture(scene, model="wave", method=method).seconds for _ in range(2))
    except InputError:
        return None
