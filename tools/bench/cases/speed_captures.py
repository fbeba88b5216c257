"""Time, memory and noise of captures by signed rays against ray captures, also behind coarse pixels.

Cells of the detector's grid are at least half a pixel wide, or a third, however small spots are.
"""

from __future__ import annotations

import functools
import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
from cases import relative
from scipy.ndimage import uniform_filter

from mitsuba_plenoptic import PlenopticCamera, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.runtime import progress

from .. import Row, at_most, case
from ..timing import in_process, once, paired, peak_memory
from .lens_models import WAVELENGTH, camera_of, distance_of, scene_of

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
    (
        at_most("light_off", 0.01), at_most("median", 1.3), at_most("highest_of_noisy", "most"),
    ),
    page="docs/theory/accuracy.md",
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

    works = {model: lambda model=model: capture(model) for model in MODELS}
    timings = paired(works, runs)
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
    page="docs/theory/accuracy.md",
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
    "progress",
    "Progress of works: seconds of the processor in all and to the first percentage, and the estimate at a tenth of "
    "them over the truth",
    {"work": "{work}", "all (s)": "{seconds:.1f}", "first (s)": "{first:.1f}", "estimate": "{estimate:.2f}"},
    (at_most("off", 1.5),),
    quick={"pixels": 256, "samples": 16},
)
def progress_told(*, pixels: int = 720, samples: int = 64, variant: str = "llvm_ad_mono") -> Iterator[Row]:
    """Capture the still life by rays and by waves, and refocus the wave capture by every method of the core."""
    size = {"resolution": pixels, "detector_width": 0.002 * pixels}
    scene = load_scene("still_life", variant=variant, parameters=size)
    captures: dict[str, Any] = {}
    for model in MODELS:

        def run(told: Any, model: str = model) -> None:
            captures[model] = render_capture(scene, model=model, spp=samples, progress=told)

        yield _told(model, run)
    for method in ("ray", "coherent", "partial"):
        yield _told(method, lambda told, m=method: reconstruct(captures["wave"], [215, 258], method=m, progress=told))


def _told(work: str, run: Callable[[Any], Any]) -> Row:
    """Return what a bar of progress knew of a work, by the processor's time."""
    with mock.patch.object(progress, "time", SimpleNamespace(monotonic=time.process_time)):
        bar, told = progress.ProgressBar(work), []

        def show(done: int, total: int) -> None:
            bar(done, total)
            told.append((time.process_time() - bar.start, bar.fraction, bar.left()))

        run(show)
        seconds = time.process_time() - bar.start
    first = next((at for at, fraction, _ in told if fraction), seconds)
    known = [at + left for at, _, left in told if left and at <= seconds / 10]
    known = known[-1:] or [at + left for at, _, left in told if left][:1] or [math.inf]
    estimate = known[0] / seconds
    # Short work needs no estimate.
    off = max(estimate, 1 / estimate) if seconds >= 10 else 1.0
    return {"work": work, "seconds": seconds, "first": first, "estimate": estimate, "off": off}


_NEW_CAMERAS: dict[str, tuple[float, dict[str, Any]]] = {
    "square": (0.6, {}),
    "round": (0.6, {"mla_aperture": "circle", "mla_fill": 0.9}),
    "hexagonal": (1.0, {"mla_lattice": "hexagonal", "mla_rotation": 7.0}),
    "aberrated": (1.0, {"wavefront": (0.0, 0.0, 0.0, 0.1, -0.05, 0.08, 0.1, 0.0, 0.05)}),
    "in a medium": (1.4, {"mla_medium": 1.5, "mla_tilt": (0.5, -0.3)}),
}
"""Kinds of cameras by the parameters that make them, and the most that a first wave capture may cost, in s."""


@case(
    "first-capture",
    "First wave captures of cameras drawn at random, after one camera of the kind: median and largest seconds of the "
    "processor, those of a second capture, and kernels compiled for a camera's first capture",
    {
        "camera": "{camera}", "first (s)": "{first:.2f}, {worst:.2f}", "second (s)": "{second:.2f}",
        "compiled": "{compiled:.0f}",
    },
    (at_most("first", "most"), at_most("compiled", 0)),
    quick={"cameras": 2},
)  # fmt: skip
def first_capture(*, cameras: int = 10, seed: int = 0) -> Iterator[Row]:
    """Capture a white world of 8 lenses across, of 8 to 16 pixels a lens, by drawn cameras."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for kind, (most, options) in _NEW_CAMERAS.items():
            rng = np.random.default_rng(seed)
            rows = np.array([_first_and_second(rng, options) for _ in range(cameras + 1)][1:])
            first, second, compiled = np.median(rows, axis=0)
            yield {
                "camera": kind, "first": first, "worst": rows[:, 0].max(), "second": second, "compiled": compiled,
                "most": most,
            }  # fmt: skip


def _first_and_second(rng: np.random.Generator, options: dict[str, Any]) -> tuple[float, float, int]:
    """Return the processor time of a drawn camera's first and second wave capture, and the kernels of the first."""
    pixels, pitch = int(rng.integers(8, 17)), rng.uniform(0.03, 0.15)
    distance = rng.uniform(50, 150)
    camera = PlenopticCamera.matched(
        f_number=rng.uniform(4, 8), pixels_per_lens=pixels, pixel_size=pitch / pixels, lenses=8,
        focal_length=distance / rng.uniform(1.1, 1.6), mla_distance=distance, **options,
    )  # fmt: skip
    light = {"type": "constant"}
    scene = mi.load_dict(
        {"type": "scene", "integrator": {"type": "path"}, "light": light, "camera": camera.to_sensor()}
    )
    dr.kernel_history_clear()
    times = [time.process_time()]
    for _ in range(2):
        _captured(scene, 4, "wave")
        dr.sync_thread()
        if len(times) == 1:
            compiled = sum(not kernel["cache_hit"] for kernel in dr.kernel_history((dr.KernelType.JIT,)))
        times.append(time.process_time())
    return times[1] - times[0], times[2] - times[1], compiled
