"""Captures: samples per second, the command, whole scenes, sums on several processes, and their parts."""

from __future__ import annotations

import cProfile
import math
import pstats
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import Cluster, Job, cli, estimate_capture, load_scene, render_capture
from mitsuba_plenoptic.points.accuracy import DEFAULT_ACCURACY, find_patterns
from mitsuba_plenoptic.points.patch import PatchBatch
from mitsuba_plenoptic.points.recorder import Recorder
from mitsuba_plenoptic.points.tile import PatchTile
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.runtime.batches import Batch, BatchMap, Threads, add
from mitsuba_plenoptic.runtime.fft import fft, worker_count

from .. import Row, at_most, case, figure, pick
from ..speed import SPEED, ScenePoints, compared
from ..timing import in_process, once, paired, peak_memory


@case(
    "speed.rays",
    "Samples per second of ray captures against Mitsuba's own `thinlens`: the same film, the same scene, `path`",
    SPEED,
    page="docs/theory/cost.md",
    quick={"resolution": 512, "runs": 2},
)
def samples_per_second(*, resolution: int = 4096, runs: int = 5) -> Iterator[Row]:
    """Render in turn."""
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
    works = {
        # Until the image is computed: rendering returns before that.
        name: lambda sensor=sensor: dr.eval(path.render(scene, sensor, seed=0, spp=1))
        for name, sensor in (("ours", scene.sensors()[0]), ("theirs", thin_lens))
    }
    timings = paired(works, runs)
    what, note = f"ray capture, letters, {resolution} x {resolution}, `path`", "of samples per second"
    row = compared(what, "million samples per s", timings["ours"], "`thinlens`", timings["theirs"], note, faster=True)
    yield row | {key: resolution**2 / 1e6 / row[key] for key in ("ours", "theirs")}


@case(
    "speed.command",
    "Peak memory and time of the command that renders a capture",
    page="docs/theory/cost.md",
    quick={"resolution": 512},
)
def command(*, resolution: int = 4096, spp: int = 16) -> Iterator[Row]:
    """Run it in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["render", "letters", "-o", str(Path(folder) / "raw.exr"), "--spp", str(spp)]
        words += ["-D", f"resolution={resolution}"]
        gib, seconds = in_process(_run_command, words, cores=worker_count())
    what = f"`render letters --spp {spp}`, {resolution} x {resolution}"
    yield figure(what, seconds, unit="s")
    yield figure(f"{what}, of which the capture {resolution**2 * 4 / 2**30:.2g} GiB", gib, unit="GiB")


def _run_command(words: list[str]) -> tuple[float, float]:
    status, seconds, _ = once(lambda: cli.main(words))
    if status:
        raise RuntimeError(f"mitsuba-plenoptic {' '.join(words)} ended with status {status}")
    return peak_memory(), seconds


WHOLE_SCENES = {
    "still_life": ("llvm_ad_mono", 150.0, 4.0),
    "still_life, three wavelengths": ("llvm_ad_rgb", None, None),
    "vitrine": ("llvm_ad_mono", 300.0, None),
    "letters": ("llvm_ad_mono", None, None),
}
"""Variants, and limits in seconds and GiB."""


@case(
    "speed.scenes",
    "Wave captures of whole scenes at full size, in a process each, and estimates before",
    {
        "scene": "{scene}", "estimate (s)": "{estimate:.0f}", "estimated after (s)": "{estimating:.1f}",
        "median (s)": "{seconds:.1f}", "limit (s)": "{most_seconds}", "GiB": "{memory:.2f}",
        "limit (GiB)": "{most_memory}", "over one wavelength": "{ratio:.2f}",
    },
    (at_most("seconds", "most_seconds"), at_most("memory", "most_memory"), at_most("ratio", 2.3)),
    quick={"only": ("letters",), "size": 512, "spp": 4},
)  # fmt: skip
def whole_scenes(
    output: Path, *, only: tuple[str, ...] = (), spp: int = 16, size: int = 4096, runs: int = 1
) -> Iterator[Row]:
    """Capture in turn; medians count."""
    chosen = pick(WHOLE_SCENES, only)
    found: dict[str, list[Row]] = {name: [] for name in chosen}
    for _ in range(runs):
        for name, (variant, _, _) in chosen.items():
            given = name.split(",")[0], spp, size, output / f"{name.replace(', ', '_').replace(' ', '_')}.png"
            estimate = in_process(_estimate, *given, variant=variant)
            found[name].append(estimate | in_process(_capture, *given, variant=variant))
    one = 0.0
    for name, (_, most_seconds, most_memory) in chosen.items():
        row: Row = {
            "scene": name, **{key: float(np.median([run[key] for run in found[name]])) for key in found[name][0]},
            "most_seconds": most_seconds, "most_memory": most_memory,
        }  # fmt: skip
        if name.endswith("three wavelengths") and one:
            row["ratio"] = row["seconds"] / one
        one = row["seconds"]
        yield row


def _estimate(name: str, spp: int, size: int, _: Path) -> Row:
    scene = load_scene(name, parameters={"resolution": str(size)})
    cost, seconds, _ = once(lambda: estimate_capture(scene, model="wave", method="signed_rays", spp=spp))
    return {"estimate": cost.seconds, "estimating": seconds}


def _capture(name: str, spp: int, size: int, file: Path) -> Row:
    scene = load_scene(name, parameters={"resolution": str(size)})
    capture, seconds, _ = once(lambda: render_capture(scene, model="wave", method="signed_rays", spp=spp))
    write_png(file, capture.image, peak=float(np.percentile(capture.image, 99.5)))
    return {"seconds": seconds, "memory": peak_memory()}


@case(
    "speed.workers",
    "Sums of point spreads on worker processes against one process, with the same bits",
    {**SPEED, "pixels of other bits": "{other}"},
    (at_most("other", 0),),
    page="docs/theory/cost.md",
    quick={"resolution": 256, "runs": 1},
)
def workers(*, resolution: int = 1024, runs: int = 5, count: int = 2) -> Iterator[Row]:
    """Sum the letters at an eighth of their size on one thread, on several, and on processes of one thread each."""
    width = str(0.002 * resolution)
    size = {"resolution": str(resolution), "detector_width": width, "letter_scale": "0.125"}
    points = ScenePoints.of("letters", size)
    images = {}

    def add_up(name: str, batch_map: BatchMap) -> None:
        images[name] = points.operator().forward(points.weights, job=Job(batch_map=batch_map))

    with Cluster(workers=count) as cluster:
        maps = {"processes": cluster, "thread": Threads(1), "threads": Threads(count)}
        timings = paired({name: lambda n=name, m=each: add_up(n, m) for name, each in maps.items()}, runs)
    for name, against in (("thread", "one process, one thread"), ("threads", f"one process, {count} threads")):
        what = f"letters, {points}, sum on {count} processes"
        row = compared(what, "s", timings["processes"], against, timings[name], "times faster", faster=True)
        other = int((images["processes"] != images[name]).sum())
        yield {**row, "cpu_ratio": None, "other": other}


# A function's time, less that of another which it calls.
_KINDS: dict[str, tuple[Callable[..., Any], ...]] = {
    "Fourier transforms": (fft,),
    "squares, added to tiles": (PatchTile.sum, PatchBatch.to_detector),
    "pupils, curvatures, transfer functions (Dr.Jit)": (PatchBatch.__init__,),
    "finding shared patterns": (find_patterns,),
    "tiles, added to the image": (add,),
    "integrals over pixels": (Recorder.record,),
}

_EVERY = 20
"""Where nothing is shared, every which radiator is taken."""


@case(
    "speed.parts",
    "Where the time of a wave capture by points goes on one thread: profiled seconds of functions that do not call "
    "each other, over the whole sum",
    {"points": "{points}", "part": "{part}", "s": "{seconds:.3g}", "fraction": "{fraction:.2f}"},
    quick={"resolution": 128},
)
def parts(*, resolution: int = 512) -> Iterator[Row]:
    """Profile the middle of the letters, with the default accuracy and with nothing shared."""
    yield from in_process(_parts, resolution, cores=1)


def _parts(resolution: int) -> list[Row]:
    letters = ScenePoints.of("letters", {"resolution": str(resolution), "detector_width": str(0.002 * resolution)})
    rows = []
    for accuracy, points in ((DEFAULT_ACCURACY, letters), (0.0, letters.take(np.s_[::_EVERY]))):
        _sum(letters.take(np.s_[:: max(1, len(letters.positions) // 64)]), accuracy)  # compiles the kernels
        profile = cProfile.Profile()
        profile.runcall(_sum, points, accuracy)
        statistics: Any = pstats.Stats(profile)

        def seconds(function: Callable[..., Any], statistics: Any = statistics) -> float:
            code = function.__code__
            key = (code.co_filename, code.co_firstlineno, code.co_name)
            return float(statistics.stats[key][3]) if key in statistics.stats else 0.0

        total = statistics.total_tt
        spent = {name: seconds(outer) - sum(map(seconds, inner)) for name, (outer, *inner) in _KINDS.items()}
        spent["the rest: products, turned blocks, the order of work"] = total - sum(spent.values())
        what = f"{points}, accuracy {accuracy:g}"
        rows += [{"points": what, "part": n, "seconds": s, "fraction": s / total} for n, s in spent.items()]
    return rows


def _sum(points: ScenePoints, accuracy: float) -> None:
    points.operator(accuracy).forward(points.weights, job=Job(batch_map=_ThisThread()))


class _ThisThread:
    """Computes batches where they are profiled."""

    workers = threads = 1

    def __call__(self, batches: Iterable[Batch]) -> Generator[Any, None, None]:
        for batch in batches:
            yield batch.prepare()()
