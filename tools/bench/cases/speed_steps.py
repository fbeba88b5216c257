"""The step by the angular spectrum against the bare pair of FFTs, and the route on a GPU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft

from mitsuba_plenoptic import InputError, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.optics.waves import propagate
from mitsuba_plenoptic.runtime.backend import Backend, backend
from mitsuba_plenoptic.runtime.fft import resting_drjit, worker_count

from .. import Row, at_most, case
from ..measures import relative
from ..speed import PAPER_SECONDS, SPEED, beam, compared
from ..timing import in_process, paired

PITCH, DISTANCE, WAVELENGTH = 4e-3, 5.0, 633.0

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
            yield in_process(_compare, size, threads, runs, cores=threads)


def _compare(size: int, threads: int, runs: int) -> Row:
    fields = {name: beam(size) for name in (_PAIR, "ours")}

    def pair() -> None:
        with resting_drjit():
            spectrum = scipy.fft.fft2(fields[_PAIR], overwrite_x=True, workers=threads)
            fields[_PAIR] = scipy.fft.ifft2(spectrum, overwrite_x=True, workers=threads)

    def ours() -> None:
        fields["ours"] = propagate(fields["ours"], PITCH, DISTANCE, WAVELENGTH, overwrite=True)

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
    return propagate(field, PITCH, DISTANCE, WAVELENGTH, overwrite=True)


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
