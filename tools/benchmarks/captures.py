"""Ray captures against Mitsuba's own `thinlens`, and what the command takes for one."""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from mitsuba_plenoptic import cli, load_scene
from mitsuba_plenoptic.runtime.fft import worker_count

from .table import Row, on_cores, peak_memory, side_by_side


def samples_per_second(resolution: int, runs: int) -> list[Row]:
    """Compare samples per second of the sensor with those of `thinlens`, same film, same scene, `path`."""
    scene = load_scene("letters", parameters={"resolution": str(resolution)})
    camera = scene.sensors()[0].camera
    thin_lens = mi.load_dict(
        {
            "type": "thinlens",
            "aperture_radius": camera.aperture_radius,
            "focus_distance": camera.focus_distance,
            "fov": math.degrees(2 * math.atan(camera.detector_width / (2 * camera.mla_distance))),
            "film": scene.sensors()[0].film(),
        }
    )
    path = mi.load_dict({"type": "path"})

    def render(sensor: Any) -> None:
        # Until the image is computed: rendering returns before that.
        dr.eval(path.render(scene, sensor, seed=0, spp=1))
        dr.sync_thread()

    timings = side_by_side({"ours": lambda: render(scene.sensors()[0]), "theirs": lambda: render(thin_lens)}, runs)
    samples = resolution**2 / 1e6
    ours, theirs = timings["ours"], timings["theirs"]
    return [
        Row(
            f"ray capture, letters, {resolution} x {resolution}, `path`", "million samples per s",
            samples / ours.seconds, "`thinlens`", samples / theirs.seconds, theirs.ratio, theirs.cpu_ratio,
        )
    ]  # fmt: skip


def command(resolution: int, spp: int) -> list[Row]:
    """Measure peak memory and time of the command that renders a capture, against the size of the capture itself."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["render", "letters", "-o", str(Path(folder) / "raw.exr"), "--spp", str(spp)]
        words += ["-D", f"resolution={resolution}"]
        gib, seconds = on_cores(worker_count(), _run_command, words)
    size = resolution**2 * 4 / 2**30
    what = f"`render letters --spp {spp}`, {resolution} x {resolution}"
    return [Row(what, "GiB", gib, "the capture's own size", size, gib / size), Row(what, "s", seconds)]


def _run_command(words: list[str]) -> tuple[float, float]:
    """Return the peak memory in GiB and the seconds."""
    start = time.perf_counter()
    if status := cli.main(words):
        raise RuntimeError(f"mitsuba-plenoptic {' '.join(words)} ended with status {status}")
    return peak_memory(), time.perf_counter() - start
