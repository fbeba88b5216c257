"""Reconstructions on one core at the paper's size, against bare FFTs, a pass over the image, and the paper's seconds.

Two captures: one with every pixel lit, where nothing can be skipped, and the letters. "FFTs" are the Fourier transforms
that the coherent method performs, of the same lengths and in the same number, along the axes of whole arrays.

Shift-and-add by whole bins is how PlenoptiCam (0.9.3) refocuses: every view is moved by a whole number of bins on a
canvas that holds them all, and the middle of the sum is cut out. PlenoptiCam itself cannot be installed with this
package (it demands tifffile 2022.4.8, and its dependency depthy takes from SciPy what 1.12 dropped), so the sum is
written out here, in NumPy, for one channel and without the borders that PlenoptiCam repeats.

Reconstructions of captures by fast cameras: time and memory of each method, and what estimates said.

The step by the angular spectrum against the bare pair of FFTs, and the route on a GPU.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft

from mitsuba_plenoptic import (
    Capture,
    InputError,
    PlenopticCamera,
    decode,
    estimate_reconstruction,
    load_scene,
    read_capture,
    reconstruct,
    render_capture,
    write_capture,
)
from mitsuba_plenoptic.extensions.deconvolution import response
from mitsuba_plenoptic.extensions.paper.paper_limits import plain_seconds, plain_sums, run_plain_sums
from mitsuba_plenoptic.optics.waves import propagate
from mitsuba_plenoptic.refocus import METHODS, planning
from mitsuba_plenoptic.refocus.planning import plan
from mitsuba_plenoptic.refocus.ray_sums import pupil_radius, ray_sums
from mitsuba_plenoptic.refocus.wave_methods import lit_window
from mitsuba_plenoptic.runtime.backend import Backend, backend
from mitsuba_plenoptic.runtime.fft import resting_drjit, worker_count
from mitsuba_plenoptic.views import distance_of, refocus

from .. import Pivot, Row, at_most, case
from ..measures import relative
from ..speed import PAPER_SECONDS, SPEED, WAVELENGTH, beam, compared
from ..timing import Timing, in_process, once, paired, peak_memory
from .lens_models import scene_of

DISTANCE = 280.0
DISTANCES = [210.0, 240.0, 280.0]


@case(
    "speed.reconstructions",
    "Reconstructions on one core at the paper's size, against bare FFTs, a pass over the image, whole-bin "
    "shift-and-add, and the paper's seconds",
    SPEED,
    page="docs/theory/cost.md",
    quick={"resolution": 2048, "runs": 1},
)
def reconstructions(*, runs: int = 5, resolution: int = 4096) -> Iterator[Row]:
    """Time everything in one process."""
    yield from in_process(_compare_all, runs, resolution, cores=1)


@case(
    "speed.plain-rays",
    "Reconstruction by rays in a plain loop over the pixels, interpreted and compiled by Numba, on one core at the "
    "paper's size, against ours with the same sums, and against the paper's 330 s",
    {
        "plain loop": "{name}",
        "seconds": "{loop:.3g}",
        "ours, seconds": "{ours:.3g}",
        "loop over ours": "{slower:.3g}",
        "the paper over loop": "{paper:.3g}",
        "difference of sums": "{difference:.0e}",
    },
    (at_most("difference", 1e-4),),
    page="docs/reference/numbers.md",
    quick={"resolution": 512, "runs": 1},
    needs=("numba",),
)
def plain_rays(*, runs: int = 5, resolution: int = 4096) -> Iterator[Row]:
    """Time the loops; the interpreted one on the rows of two lenses, scaled to the paper's pixels."""
    yield from in_process(_compare_plain, runs, resolution, cores=1)


def _compare_plain(runs: int, resolution: int) -> list[Row]:
    import numba

    camera = PlenopticCamera(resolution=(resolution, resolution), detector_width=0.002 * resolution)
    image = np.random.default_rng(0).random(camera.shape, dtype=np.float32)
    compiled = numba.njit(plain_sums)
    works = {
        "ours": lambda: ray_sums(image[..., None], camera, DISTANCE, pupil_radius(camera), "point", 1)[..., 0],
        "compiled": lambda: run_plain_sums(image, camera, DISTANCE, compiled),
    }
    difference = relative(works["compiled"](), works["ours"]())
    timings = paired(works, runs)
    loops = {"compiled by Numba": timings["compiled"].processor, "in Python": plain_seconds(camera, DISTANCE)}
    ours, paper = timings["ours"].processor, PAPER_SECONDS["ray, point version"]
    return [
        {"name": name, "loop": loop, "ours": ours, "slower": loop / ours, "paper": paper / loop,
         "difference": difference}
        for name, loop in loops.items()
    ]  # fmt: skip


def _compare_all(runs: int, resolution: int) -> list[Row]:
    camera = PlenopticCamera(resolution=(resolution, resolution), detector_width=0.002 * resolution)
    white = Capture(np.random.default_rng(0).random(camera.shape, dtype=np.float32) + 0.1, camera)
    scene = load_scene(
        "letters", parameters={"resolution": str(resolution), "detector_width": str(camera.detector_width)}
    )
    letters = render_capture(scene, spp=1)
    lit, some = _compare("all lit", white, runs), _compare("letters", letters, runs)
    return [*lit, *some, *compare_shift_and_add(letters, runs)]


def compare_shift_and_add(capture: Capture, runs: int) -> Iterator[Row]:
    """Compare with shift-and-add by whole bins, at the distance where neighbouring views differ by one bin."""
    views = decode(capture)
    distance = float(distance_of(views, 1.0))
    weighted = views.values * views["weight"].values
    ours, theirs = refocus(views, distance).values, shift_and_add(weighted)
    theirs *= np.vdot(theirs, ours) / np.vdot(theirs, theirs)
    inside = (slice(len(views), -len(views)),) * 2
    note = (
        f"{len(views)} x {len(views)} views; sums differ by {relative(theirs[inside], ours[inside]):.2%}; times faster"
    )
    timings = paired(
        {
            "ray": lambda: reconstruct(capture, distance, footprint="point"),
            "decode and add": lambda: (decode(capture), shift_and_add(weighted)),
            "add": lambda: shift_and_add(weighted),
            "refocus": lambda: refocus(views, distance),
        },
        runs,
    )
    adding = "shift-and-add by whole bins"
    what = "ray, point version, letters, from the capture, one core"
    whole = timings["decode and add"]
    yield compared(what, "s", timings["ray"], f"decoding, then {adding}", whole, note, faster=True)
    what = "`refocus`, letters, from the views, any distance, one core"
    yield compared(what, "s", timings["refocus"], adding, timings["add"], note, faster=True)


def shift_and_add(views: np.ndarray) -> np.ndarray:
    """Add views (v, u, t, s), each moved by one bin more than its neighbour, and cut out the middle."""
    down, across, rows, columns = views.shape
    canvas = np.zeros((rows + down - 1, columns + across - 1))
    for j in range(down):
        for i in range(across):
            canvas[down - 1 - j : down - 1 - j + rows, across - 1 - i : across - 1 - i + columns] += views[j, i]
    top, left = (down - 1) // 2, (across - 1) // 2
    return canvas[top : top + rows, left : left + columns]


def _compare(name: str, capture: Capture, runs: int) -> Iterator[Row]:
    def work(distance: float | list[float] = DISTANCE, **options: Any) -> Callable[[], Any]:
        if "method" in options:
            options["wavelength"] = WAVELENGTH
        return lambda: reconstruct(capture, distance, **options)

    image = capture.image
    works = {
        "`(I * I).sum()`": lambda: (image * image).sum(),
        "ray, point version": work(footprint="point"),
        "ray, lens version": work(footprint="lens"),
        "FFTs of coherent": bare_transforms(capture, DISTANCE, WAVELENGTH),
        "coherent": work(method="coherent"),
        "coherent, 3 distances": work(DISTANCES, method="coherent"),
        "partially coherent, K = 2": work(method="partial", interleave=2),
    }
    against = {
        "ray, point version": "`(I * I).sum()`",
        "ray, lens version": "`(I * I).sum()`",
        "coherent": "FFTs of coherent",
        "coherent, 3 distances": "coherent",
        "partially coherent, K = 2": "coherent",
    }
    timings: dict[str, Timing] = paired(works, runs)
    for what, other in against.items():
        title = f"{what}, {name}, one core"
        yield compared(title, "s", timings[what], other, timings[other], "ours over theirs")
        if what in PAPER_SECONDS:
            paper, ours = PAPER_SECONDS[what], timings[what].seconds
            yield {
                "what": title, "unit": "s", "ours": ours, "against": "the paper", "theirs": paper,
                "ratio": paper / ours, "note": "times faster",
            }  # fmt: skip


def bare_transforms(capture: Capture, distance: float, wavelength: float, interleave: int = 1) -> Callable[[], None]:
    """Do nothing but the transforms of the coherent method, or of the partially coherent one."""
    lit = lit_window(capture.image, capture.camera)
    assert lit is not None
    grids = plan(capture.camera, wavelength, [distance], lit)
    steps = [step for strip in grids.strips for step in strip.steps] + list(grids.to_objects)
    # Along rows for the first and the last of a step's four, along columns for the two between them; the last step has
    # two, along rows and along columns.
    shapes = [
        ((count, length) if axis else (length, count), axis, inverse)
        for step in steps * interleave**2
        for (count, length, inverse), axis in zip(step.transforms, (1, 0, 0, 1), strict=False)
    ]
    memory = np.ones(max(rows * columns for (rows, columns), _, _ in shapes), np.complex64)

    def transforms() -> None:
        for shape, axis, inverse in shapes:
            field = memory[: shape[0] * shape[1]].reshape(shape)
            transform = scipy.fft.ifft if inverse else scipy.fft.fft
            transform(field, axis=axis, overwrite_x=True, workers=1, norm="ortho")

    return transforms


FAST_DISTANCE = 285.0
"""Of the wall and of the images, in millimetres; the cameras focus on 320."""

WAVELENGTHS = (611.0, 549.0, 464.0)

FINER_FIELDS = (
    (planning, {
        "GUARD": 1.6, "_PIXEL_GUARD": 2.0, "_DIRECTION_SAMPLES": 6.0, "OBJECT_MARGIN": 12.0, "_MARGIN_ORDERS": 1.5,
        "_MARGIN_LENSES": 3.0,
    }),
)  # fmt: skip
FINER_SPREADS = ((response, {"_ACCURACY": 0.002}),)
FINER = {
    "coherent": FINER_FIELDS, "partial": FINER_FIELDS, "incoherent": FINER_SPREADS, "deconvolved": FINER_SPREADS,
}  # fmt: skip
"""Constants of the sampling rules with which results are compared."""

FAST = 5.6
"""Largest f-number of which the time over that of transforms has a limit; slower cameras take fractions of a second."""

LONG = 30.0
"""Seconds from which on an estimate must be right within a factor of 1.5."""


@case(
    "reconstruction.fast-cameras",
    "Ray captures in three colours by cameras of 100 x 100 lenses of 10 x 10 pixels, refocused by each method in a "
    "process of its own",
    {
        "camera": "{camera}", "method": "{method}", "elapsed s": "{seconds:.3g}", "estimated s": "{estimate:.3g}",
        "factor between them": "{off:.2f}", "estimate took s": "{took:.3g}", "GiB above start": "{memory:.2f}",
        "estimated GiB": "{estimated_memory:.2f}",
    },
    (at_most("off", "most_off"),),
    page="docs/theory/cost.md",
    pivot=Pivot("{method}", "{camera}", "{seconds:.3g} s, {memory:.1f} GiB"),
    quick={"f_numbers": (10.0,), "methods": ("ray", "coherent")},
)  # fmt: skip
def fast_cameras(
    output: Path, *, f_numbers: tuple[float, ...] = (2.8, 5.6, 10.0), methods: tuple[str, ...] = tuple(METHODS)
) -> Iterator[Row]:
    """Refocus a textured wall that fills the view."""
    for f_number in f_numbers:
        path = output / f"f{f_number:g}.exr"
        in_process(_capture, path, f_number)
        for method in methods:
            yield {"camera": f"f/{f_number:g}", "method": method, **in_process(_refocus, path, method)}


@case(
    "reconstruction.fast-sampling",
    "The same cameras in one colour, on one core: processor time of coherent reconstructions over "
    "that of their Fourier transforms alone, and what finer sampling changes (L2)",
    {"camera": "{camera}", "method": "{method}", "over transforms": "{ratio:.2f}", "change": "{change:.2%}"},
    (at_most("ratio", "most"), at_most("change", 0.01)),
    page="docs/theory/cost.md",
    quick={"f_numbers": (10.0,), "lenses": 8},
)
def fast_sampling(*, f_numbers: tuple[float, ...] = (2.8, 5.6, 10.0), lenses: int = 100) -> Iterator[Row]:
    """Patch the constants of the sampling rules for what is finer."""
    for f_number in f_numbers:
        yield from in_process(_sample, f_number, lenses, cores=1)


def _sample(f_number: float, lenses: int) -> list[Row]:
    camera = _camera(f_number, lenses)
    capture = render_capture(scene_of(camera, FAST_DISTANCE), model="ray", spp=16)
    rows = []
    for method, finer in FINER.items():
        options = {"wavelength": WAVELENGTHS[1]} | ({"iterations": 5} if method == "deconvolved" else {})
        work = functools.partial(reconstruct, capture, FAST_DISTANCE, method=method, **options)
        found = work().image
        with contextlib.ExitStack() as patched:
            for module, values in finer:
                patched.enter_context(mock.patch.multiple(module, **values))
            change = relative(found, work().image)
        rows.append(
            {
                "camera": f"f/{f_number:g}",
                "method": method,
                "ratio": None,
                "most": 1.5 if f_number <= FAST else None,
                "change": change,
            }
        )
        if finer is FINER_FIELDS:
            bare = bare_transforms(capture, FAST_DISTANCE, WAVELENGTHS[1], 2 if method == "partial" else 1)
            rows[-1]["ratio"] = paired({"transforms": bare, method: work}, 3)[method].processor_ratio
    return rows


def _camera(f_number: float, lenses: int) -> PlenopticCamera:
    return PlenopticCamera.matched(
        f_number=f_number, lenses=lenses, pixels_per_lens=10, pixel_size=0.005, focal_length=50, focus_distance=320
    )


def _capture(path: Path, f_number: float) -> None:
    camera = _camera(f_number, 100)
    capture = render_capture(scene_of(camera, FAST_DISTANCE), model="ray", spp=16)
    colours = capture.image[..., None] * np.array((1, 0.8, 0.6), np.float32)
    write_capture(path, dataclasses.replace(capture, image=colours))


def _refocus(path: Path, method: str) -> Row:
    capture = read_capture(path)
    options: dict[str, Any] = {"wavelength": WAVELENGTHS} if METHODS[method].waves else {}
    start = peak_memory()
    cost, took, _ = once(lambda: estimate_reconstruction(capture, FAST_DISTANCE, method=method, **options))
    _, seconds, _ = once(lambda: reconstruct(capture, FAST_DISTANCE, method=method, **options))
    return {
        "seconds": seconds, "estimate": cost.seconds, "off": max(seconds / cost.seconds, cost.seconds / seconds),
        "most_off": 1.5 if seconds > LONG else None, "took": took, "memory": peak_memory() - start,
        "estimated_memory": cost.memory / 2**30,
    }  # fmt: skip


PITCH, STEP_DISTANCE = 4e-3, 5.0

_PAIR = "bare FFT pair"


@case(
    "speed.steps",
    "The angular-spectrum step against a pair of FFTs (ours over the pair), in processes of one and of all threads",
    SPEED,
    page="docs/theory/cost.md",
    quick={"sizes": (512,), "runs": 2},
)
def steps(*, sizes: tuple[int, ...] = (1024, 2048, 4096, 8192), runs: int = 5) -> Iterator[Row]:
    """Compare at several sizes."""
    for threads in sorted({1, worker_count()}):
        for size in sizes:
            yield in_process(_compare_step, size, threads, runs, cores=threads)


def _compare_step(size: int, threads: int, runs: int) -> Row:
    fields = {name: beam(size) for name in (_PAIR, "ours")}

    def pair() -> None:
        with resting_drjit():
            spectrum = scipy.fft.fft2(fields[_PAIR], overwrite_x=True, workers=threads)
            fields[_PAIR] = scipy.fft.ifft2(spectrum, overwrite_x=True, workers=threads)

    def ours() -> None:
        fields["ours"] = propagate(fields["ours"], PITCH, STEP_DISTANCE, WAVELENGTH, overwrite=True)

    timings = paired({"ours": ours, _PAIR: pair}, runs)
    what = f"angular-spectrum step, {size} x {size}, {threads} thread{'s' * (threads > 1)}"
    return compared(what, "ms", timings["ours"], _PAIR, timings[_PAIR], "ours over the pair", scale=1e3)


_COPIED = 2**27
"""Samples of the field whose copy measures the speed of the memory."""

_BYTES_PER_SAMPLE = 80
"""Two transforms that each read and write a field twice (rows, columns), and one pass for the transfer function."""


@case(
    "speed.gpu",
    "On a CUDA device: steps against bare transforms and the memory's speed, whole captures and reconstructions",
    SPEED,
    (at_most("difference", 1e-5),),
    page="docs/theory/cost.md",
    quick={"sizes": (1024,), "runs": 1},
)
def gpu(*, sizes: tuple[int, ...] = (1024, 2048, 4096, 8192), runs: int = 5) -> Iterator[Row]:
    """Measure on the device, and refuse where there is none."""
    if not dr.has_backend(dr.JitBackend.CUDA):
        raise InputError("no CUDA device on this machine")
    expected = {size: _moved(beam(size)) for size in sizes}
    before = mi.variant()
    mi.set_variant("cuda_ad_mono")
    try:
        yield from gpu_steps(expected, runs)
        yield from gpu_letters({}, runs)
    finally:
        mi.set_variant(before)


def _moved(field: Any) -> Any:
    return propagate(field, PITCH, STEP_DISTANCE, WAVELENGTH, overwrite=True)


def gpu_steps(expected: dict[int, np.ndarray], runs: int, copied: int = _COPIED) -> Iterator[Row]:
    """Compare the step with the bare pair of transforms, and its kernels with their memory traffic."""
    libraries = backend()
    speed = _copy_speed(libraries, copied)
    yield {"what": "memory of the device: a copy, read and written", "unit": "GB/s", "ours": speed / 1e9}
    for size, answer in expected.items():
        fields = {name: libraries.arrays.asarray(beam(size)) for name in (_PAIR, "ours")}

        def pair(fields: dict[str, Any] = fields) -> None:
            field = libraries.transforms.fft2(fields[_PAIR], overwrite_x=True)
            fields[_PAIR] = libraries.transforms.ifft2(field, overwrite_x=True)

        def ours(fields: dict[str, Any] = fields) -> None:
            fields["ours"] = _moved(fields["ours"])

        difference = relative(libraries.to_host(_moved(libraries.arrays.asarray(beam(size)))), answer)
        timings = paired({"ours": _waited(libraries, ours), _PAIR: _waited(libraries, pair)}, runs)
        what = f"angular-spectrum step, {size} x {size}, CUDA"
        row = compared(what, "ms", timings["ours"], f"{_PAIR}, CuPy", timings[_PAIR], "ours over the pair", scale=1e3)
        yield {**row, "difference": difference}
        kernels = _on_device(libraries, pair) + _kernels(libraries, ours)
        limit = _BYTES_PER_SAMPLE * size**2 / speed
        yield {
            "what": f"{what}, kernels", "unit": "ms", "ours": 1e3 * kernels, "against": "its traffic as a copy",
            "theirs": 1e3 * limit, "ratio": kernels / limit, "note": "without the host's part; ours over the traffic",
        }  # fmt: skip


def gpu_letters(parameters: dict[str, str], runs: int) -> Iterator[Row]:
    """Time whole captures of the letters by both models, and their reconstructions."""
    libraries = backend()
    scene = load_scene("letters", parameters=parameters)
    captures: dict[str, Any] = {}

    def render(model: str) -> None:
        captures[model] = render_capture(scene, model=model, spp=16)

    works: dict[str, Callable[[], object]] = {model: lambda model=model: render(model) for model in ("ray", "wave")}
    timings = paired({name: _waited(libraries, work) for name, work in works.items()}, runs)
    size = " x ".join(map(str, captures["wave"].camera.resolution))
    for model, timing in timings.items():
        what = f"`render letters --model {model} --spp 16`, {size}, CUDA"
        yield {"what": what, "unit": "s", "ours": timing.seconds}
    capture = captures["wave"]
    methods: dict[str, dict[str, Any]] = {
        "ray, point version": {"footprint": "point"},
        "coherent": {"method": "coherent"},
        "partially coherent, K = 2": {"method": "partial", "interleave": 2},
    }
    works = {name: lambda options=options: reconstruct(capture, 280.0, **options) for name, options in methods.items()}
    timings = paired({name: _waited(libraries, work) for name, work in works.items()}, runs)
    for name, timing in timings.items():
        paper = PAPER_SECONDS[name]
        yield {
            "what": f"{name}, letters, {size}, CUDA", "unit": "s", "ours": timing.seconds, "against": "the paper",
            "theirs": paper, "ratio": paper / timing.seconds, "note": "times faster",
        }  # fmt: skip


def _waited(libraries: Backend, work: Callable[[], object]) -> Callable[[], None]:
    """Do some work and wait until the device has done it."""

    def whole() -> None:
        work()
        libraries.synchronize()

    return whole


def _copy_speed(libraries: Backend, samples: int) -> float:
    """Bytes per second that a copy reads and writes."""
    source = libraries.arrays.zeros(samples, np.complex64)
    target = libraries.arrays.zeros(samples, np.complex64)
    return 16 * samples / min(
        _on_device(libraries, lambda: libraries.arrays.copyto(target, source)) for _ in range(5)
    )  # fmt: skip


def _on_device(libraries: Backend, work: Callable[[], object]) -> float:
    """Seconds between events on the device around some work, once warm."""
    cuda = libraries.arrays.cuda
    for _ in range(2):
        start, end = cuda.Event(), cuda.Event()
        start.record()
        work()
        end.record()
        end.synchronize()
    return float(cuda.get_elapsed_time(start, end)) / 1e3


def _kernels(libraries: Backend, work: Callable[[], object]) -> float:
    """Seconds that Dr.Jit's kernels take in some work."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        work()
        libraries.synchronize()
        return sum(float(entry["execution_time"]) for entry in dr.kernel_history()) / 1e3
