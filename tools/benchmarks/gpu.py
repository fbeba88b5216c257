"""The CUDA route on a device: steps against bare transforms and the memory's speed, the paper's work in seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mitsuba_plenoptic import load_scene, reconstruct, render_capture
from mitsuba_plenoptic.optics.free_space import propagate
from mitsuba_plenoptic.runtime.backend import Backend, backend

from .reconstructions import PAPER_SECONDS
from .steps import DISTANCE, PITCH, WAVELENGTH, beam
from .table import Row, side_by_side

COMMAND = "python tools/benchmark.py --only gpu --output out/benchmark"

_PAIR = "bare FFT pair"
_COPIED = 2**27
"""Samples of the field whose copy tells the speed of the memory."""

_BYTES_PER_SAMPLE = 80
"""Two transforms that each read and write a field twice (rows, columns), and one pass for the transfer function."""


def run(sizes: list[int], runs: int) -> list[Row]:
    """Measure on the device, or say that there is none and what to type where there is one."""
    if not dr.has_backend(dr.JitBackend.CUDA):
        return [Row("GPU", note=f"no CUDA device here; where one is, `{COMMAND}` fills this in")]
    expected = {size: _moved(beam(size)) for size in sizes}
    before = mi.variant()
    mi.set_variant("cuda_ad_mono")
    try:
        return [*steps(expected, runs), *letters({}, runs)]
    finally:
        mi.set_variant(before)


def _moved(field: Any) -> Any:
    return propagate(field, PITCH, DISTANCE, WAVELENGTH, overwrite=True)


def steps(expected: dict[int, np.ndarray], runs: int, copied: int = _COPIED) -> Iterator[Row]:
    """Compare the step with the bare pair of transforms, and what it takes on the device with its memory traffic."""
    libraries = backend()
    speed = _copy_speed(libraries, copied)
    yield Row("memory of the device: a copy, read and written", "GB/s", speed / 1e9)
    for size, answer in expected.items():
        fields = {name: libraries.arrays.asarray(beam(size)) for name in (_PAIR, "ours")}

        def pair(fields: dict[str, Any] = fields) -> None:
            field = libraries.transforms.fft2(fields[_PAIR], overwrite_x=True)
            fields[_PAIR] = libraries.transforms.ifft2(field, overwrite_x=True)

        def ours(fields: dict[str, Any] = fields) -> None:
            fields["ours"] = _moved(fields["ours"])

        result = libraries.to_host(_moved(libraries.arrays.asarray(beam(size))))
        difference = np.linalg.norm(result - answer) / np.linalg.norm(answer)
        timings = side_by_side({"ours": _waited(libraries, ours), _PAIR: _waited(libraries, pair)}, runs)
        mine, bare = timings["ours"].seconds, timings[_PAIR].seconds
        what = f"angular-spectrum step, {size} x {size}, CUDA"
        note = f"ours over the pair; differs from the processor's by {difference:.0e}"
        yield Row(what, "ms", 1e3 * mine, f"{_PAIR}, CuPy", 1e3 * bare, mine / bare, note=note)
        kernels = _on_device(libraries, pair) + _kernels(libraries, ours)
        limit = _BYTES_PER_SAMPLE * size**2 / speed
        note = "without the host's share; ours over the limit"
        yield Row(
            f"{what}, kernels", "ms", 1e3 * kernels, "its traffic as a copy", 1e3 * limit, kernels / limit, note=note
        )


def letters(parameters: dict[str, str], runs: int) -> Iterator[Row]:
    """Time whole captures of the letters, by rays and by waves, and their reconstructions."""
    libraries = backend()
    scene = load_scene("letters", parameters=parameters)
    captures: dict[str, Any] = {}

    def render(model: str) -> None:
        captures[model] = render_capture(scene, model=model, spp=16)

    works: dict[str, Callable[[], object]] = {model: lambda model=model: render(model) for model in ("ray", "wave")}
    timings = side_by_side({name: _waited(libraries, work) for name, work in works.items()}, runs)
    size = " x ".join(map(str, captures["wave"].camera.resolution))
    for model, timing in timings.items():
        yield Row(f"`render letters --model {model} --spp 16`, {size}, CUDA", "s", timing.seconds)
    capture = captures["wave"]
    methods: dict[str, dict[str, Any]] = {
        "ray, point version": {"footprint": "point"},
        "coherent": {"method": "coherent"},
        "partially coherent, K = 2": {"method": "partial", "interleave": 2},
    }
    works = {name: lambda options=options: reconstruct(capture, 280.0, **options) for name, options in methods.items()}
    timings = side_by_side({name: _waited(libraries, work) for name, work in works.items()}, runs)
    for name, timing in timings.items():
        paper = PAPER_SECONDS[name]
        what = f"{name}, letters, {size}, CUDA"
        yield Row(what, "s", timing.seconds, "the paper", paper, paper / timing.seconds, note="times faster")


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
