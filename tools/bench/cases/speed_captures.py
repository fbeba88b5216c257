"""Captures: samples per second, the command, whole scenes, sums on several processes, and their parts.

Time, memory and noise of captures by signed rays against ray captures.

Wave captures by cameras whose pixels are large beside the spots of their microlenses: price, noise and accuracy.

Cells of the detector's grid are at least half a pixel wide, or a third, however small spots are.
"""

from __future__ import annotations

import cProfile
import functools
import itertools
import math
import pstats
import statistics
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import uniform_filter

from mitsuba_plenoptic import Cluster, Job, PlenopticCamera, cli, estimate_capture, load_scene, render_capture
from mitsuba_plenoptic.light import array_kernels, phase_space, scheme, signed_rays
from mitsuba_plenoptic.points.accuracy import DEFAULT_ACCURACY, find_patterns
from mitsuba_plenoptic.points.patch import PatchBatch
from mitsuba_plenoptic.points.recorder import Recorder
from mitsuba_plenoptic.points.tile import PatchTile
from mitsuba_plenoptic.report.images import write_png
from mitsuba_plenoptic.runtime.batches import Batch, BatchMap, Threads, add
from mitsuba_plenoptic.runtime.fft import fft, worker_count

from .. import Row, at_most, case, figure, pick
from ..measures import mean_of_seeds, relative, without_noise
from ..speed import SPEED, ScenePoints, compared
from ..timing import in_process, once, paired, peak_memory
from .lens_models import WAVELENGTH, camera_of, distance_of, scene_of


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
    yield figure(f"{what}, of which the capture {resolution**2 * 4 / 2**30:.2g} GiB", gib, unit="GiB", at_most=1.0)


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


MODELS: dict[str, dict[str, Any]] = {"ray": {"model": "ray"}, "wave": {"model": "wave", "method": "signed_rays"}}

CROP, SEEDS = 512, 16

_LIT, _NOISY = 0.1, 0.01
"""Light of lit pixels over the median of pixels that have any; noise of a noisy pixel's ray captures over its light."""


@case(
    "signed-ray-cost",
    "Captures by signed rays and by rays in turn, a scene in a process of its own: seconds of the processor and "
    "elapsed, their ratios, peak of memory, light, and variance over seeds of lit pixels of the middle",
    {
        "scene": "{scene}", "rays (s)": "{ray[0]:.1f}, {ray[1]:.1f}", "waves (s)": "{wave[0]:.1f}, {wave[1]:.1f}",
        "waves over rays": "{ratio:.2f}, {elapsed_ratio:.2f}", "peak (GiB)": "{memory:.1f}", "light": "{light:.3f}",
        "variance": "{variance:.2f}", "median, 99 %": "{median:.2f}, {highest:.1f}",
        "99 % of noisy pixels": "{highest_of_noisy:.1f}",
    },
    (at_most("light_off", 0.01), at_most("median", 1.3), at_most("highest_of_noisy", "most")),
    page="docs/theory/cost.md",
    quick={"scenes": ("letters",), "pixels": 256, "runs": 1, "seeds": 2},
)  # fmt: skip
def signed_ray_cost(
    *,
    scenes: tuple[str, ...] = ("letters", "still_life", "vitrine", "keplerian"),
    pixels: int = 4096,
    samples: int = 16,
    runs: int = 2,
    seeds: int = SEEDS,
    variant: str = "llvm_ad_mono",
) -> Iterator[Row]:
    """Measure scenes; ``variant=llvm_ad_rgb`` captures three wavelengths."""
    for name in scenes:
        row = in_process(_times, name, pixels, samples, runs, variant=variant)
        yield row | in_process(_variances, name, pixels, samples, seeds, variant=variant)


def _times(name: str, pixels: int, samples: int, runs: int) -> Row:
    scene, means = load_scene(name, parameters={"resolution": str(pixels)}), {}

    def capture(model: str) -> None:
        means[model] = float(render_capture(scene, spp=samples, **MODELS[model]).image.mean())

    timings = paired({model: lambda model=model: capture(model) for model in MODELS}, runs)
    light = means["wave"] / means["ray"]
    return {
        "scene": name, "memory": peak_memory(), "light": light, "light_off": abs(light - 1),
        "ratio": timings["wave"].processor_ratio, "elapsed_ratio": timings["wave"].ratio,
        **{model: [timing.processor, timing.seconds] for model, timing in timings.items()},
    }  # fmt: skip


def _variances(name: str, pixels: int, samples: int, seeds: int) -> Row:
    """Compare the spread over seeds of the middle of the detector."""
    scene = load_scene(name, parameters={"resolution": str(pixels)})
    parameters = mi.traverse(scene)
    film = next(key for key in parameters.keys() if key.endswith("film.crop_size")).removesuffix("crop_size")  # noqa: SIM118
    size = min(CROP, pixels)
    parameters[f"{film}crop_size"] = mi.ScalarVector2u(size, size)
    parameters[f"{film}crop_offset"] = mi.ScalarPoint2u((pixels - size) // 2)
    parameters.update()
    rays, waves = (
        np.stack([render_capture(scene, spp=samples, seed=seed, **options).image for seed in range(seeds)])
        .reshape(seeds, size, size, -1)
        .mean(-1)
        for options in MODELS.values()
    )
    # Of few seeds, a pixel's variance is known better with its neighbours.
    spread = [uniform_filter(each.var(0, ddof=1), 3) for each in (rays, waves)]
    light = rays.mean(0)
    lit = (light > _LIT * np.median(light[light > 0])) & (spread[0] > 0)
    ratio, noisy = spread[1][lit] / spread[0][lit], np.sqrt(spread[0][lit]) > _NOISY * light[lit]
    return {
        "variance": float(spread[1][lit].sum() / spread[0][lit].sum()), "median": float(np.median(ratio)),
        "highest": float(np.percentile(ratio, 99)), "highest_of_noisy": float(np.percentile(ratio[noisy], 99)),
        # Ratios of variances of fewer seeds scatter too much.
        "most": 3.0 if seeds >= SEEDS else math.inf,
    }  # fmt: skip


_COLOURS = {"mono": "llvm_ad_mono", "rgb": "llvm_ad_rgb"}
_MOST = {8: 4.0, 64: 2.0}
_MOST_MEMORY = 1.5
_RUNS = 5


def _camera(f_number: float, pixels: int, film: int, lattice: str) -> PlenopticCamera:
    """Return a camera with some pixels to a lens, and a square film of some pixels."""
    camera = camera_of(f_number)
    pixel = 10 * camera.pixel_size / pixels
    return camera.replace(resolution=(film, film), detector_width=film * pixel, mla_lattice=lattice)


@case(
    "coarse-pixels.cost",
    "Processor time of wave captures over that of ray captures, alternating in one process, five runs after the first",
    {
        "f-number": "{f_number:g}", "pixels a lens": "{pixels}", "film": "{film}", "lattice": "{lattice}",
        "colours": "{colours}", "blur (lenses)": "{blur:g}", "samples": "{spp}", "rays (s)": "{rays:.2f}",
        "waves (s)": "{waves:.2f}", "waves over rays": "{ratio:.2f}", "noise of rays": "{ray_noise:.2%}",
        "noise of waves": "{noise:.2%}", "waves over rays, at equal noise": "{equal:.2f}",
        "memory above that of rays (GiB)": "{memory:.2f}",
    },
    (at_most("ratio", "limit"), at_most("memory", _MOST_MEMORY)),
    page="docs/theory/cost.md",
    quick={"films": (100,), "f_numbers": (5.6,), "samples": (8,)},
)  # fmt: skip
def cost(
    *,
    films: tuple[int, ...] = (400, 1000),
    f_numbers: tuple[float, ...] = (1.8, 2.8, 5.6, 10.0),
    pixels: tuple[int, ...] = (10,),
    lattices: tuple[str, ...] = ("square",),
    colours: tuple[str, ...] = ("mono",),
    blurs: tuple[float, ...] = (2.0,),
    samples: tuple[int, ...] = (8, 64),
) -> Iterator[Row]:
    """Time captures of a textured wall."""
    for colour in colours:
        mi.set_variant(_COLOURS[colour])
        for film, number, count, lattice, blur in (
            (film, number, count, lattice, blur)
            for film in films for number in f_numbers for count in pixels for lattice in lattices for blur in blurs
        ):  # fmt: skip
            camera = _camera(number, count, film, lattice)
            scene = scene_of(camera, distance_of(camera, blur))
            for spp in samples:
                peaks = {
                    model: in_process(_peak, camera, blur, spp, model, variant=_COLOURS[colour])
                    for model in ("ray", "wave")
                }
                runs: dict[str, list[tuple[Any, float]]] = {"ray": [], "wave": []}
                for seed, (model, own) in itertools.product(range(1 + _RUNS), runs.items()):
                    image, _, seconds = once(functools.partial(_captured, scene, spp, model, seed))
                    own.append((image.astype(float), seconds))
                (rays, ray_noise), (waves, noise) = (
                    (statistics.mean(each[1] for each in own[1:]), relative(own[0][0], own[1][0]) / 2**0.5)
                    for own in runs.values()
                )
                yield {
                    "f_number": number, "pixels": count, "film": film, "lattice": lattice, "colours": colour,
                    "blur": blur, "spp": spp, "rays": rays, "waves": waves, "ratio": waves / rays,
                    "ray_noise": ray_noise, "noise": noise, "limit": _MOST.get(spp),
                    "equal": waves / rays * (noise / ray_noise) ** 2, "memory": peaks["wave"] - peaks["ray"],
                }  # fmt: skip


def _captured(scene: mi.Scene, spp: int, model: str, seed: int = 0) -> np.ndarray:
    """Return the image of a capture, by waves in a monochrome variant at one wavelength."""
    options = {"wavelength": WAVELENGTH} if model == "wave" and mi.variant() == _COLOURS["mono"] else {}
    return render_capture(scene, model=model, spp=spp, seed=seed, **options).image


def _peak(camera: PlenopticCamera, blur: float, spp: int, model: str) -> float:
    """Return the peak memory of this process in GiB, which captures a wall once."""
    _captured(scene_of(camera, distance_of(camera, blur)), spp, model)
    return peak_memory()


@case(
    "coarse-pixels.accuracy",
    "Wave captures with two or three cells across a pixel against those with all cells that resolve the spots",
    {
        "f-number": "{f_number:g}", "blur (lenses)": "{blur:g}", "capture": "{kind}", "cells": "{cells}",
        "all cells": "{every}",
        "difference": "{difference:.2%}", "light": "{light:.4f}", "noise": "{noise:.2%}",
    },
    (at_most("difference", "limit"),),
    page="docs/theory/phase_space.md",
    quick={"f_numbers": (5.6,), "blurs": (0.0,), "lenses": 4, "spp": 512},
)  # fmt: skip
def accuracy(
    *,
    f_numbers: tuple[float, ...] = (1.8, 2.8, 5.6, 10.0),
    blurs: tuple[float, ...] = (0.0, 2.0),
    lenses: int = 6,
    spp: int = 2048,
) -> Iterator[Row]:
    """Compare captures of a textured wall with ten pixels a lens, usual ones and finer ones."""
    for number in f_numbers:
        for blur in blurs:
            camera = camera_of(number, lenses=lenses)
            scene = scene_of(camera, distance_of(camera, blur))
            with mock.patch.object(phase_space, "_MOST_CELLS", (10**6, 10**6)):
                every = phase_space.PhaseSpace(camera, WAVELENGTH).parts(False)
            # Of a finer plan, without tolerance for missing functions.
            with (
                mock.patch.object(array_kernels, "_FUNCTIONS", 0.0),
                mock.patch.object(phase_space.PhaseSpace, "parts", lambda *_, every=every: every),
            ):
                _forget_plans()
                reference, noise = _taken(scene, spp, True)
            _forget_plans()
            for finer, limit in ((False, 0.01), (True, 0.005)):
                cells = phase_space.PhaseSpace(camera, WAVELENGTH).parts(finer)
                image, own = _taken(scene, spp, finer)
                yield {
                    "f_number": number, "blur": blur, "kind": "finer" if finer else "usual", "cells": cells,
                    "every": every, "noise": max(noise, own),
                    "difference": without_noise(relative(image, reference), noise, own),
                    "light": float(image.mean() / reference.mean()), "limit": limit,
                }  # fmt: skip


def _forget_plans() -> None:
    """Clear what is kept of plans, which do not state the constants that are replaced here."""
    for cached in (scheme.plan_of, signed_rays._kernels_of, signed_rays._convolution_of):
        cached.cache_clear()


def _taken(scene: mi.Scene, spp: int, finer: bool) -> tuple[np.ndarray, float]:
    """Return the mean of two captures of a scene, usual or finer ones, and its noise."""
    options = {"accuracy": 0.8 * phase_space.FINE} if finer else {}
    return mean_of_seeds(
        lambda seed: render_capture(scene, model="wave", spp=spp, seed=seed, wavelength=WAVELENGTH, **options).image, 2
    )
