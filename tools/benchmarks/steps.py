"""The step by the angular spectrum against the bare pair of FFTs and against other libraries' steps."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import scipy.fft

from mitsuba_plenoptic.propagation import propagate
from mitsuba_plenoptic.propagation.fft import resting_drjit, worker_count

from .table import Row, on_cores, side_by_side

_PITCH, _DISTANCE, _WAVELENGTH = 4e-3, 5.0, 633.0
_PAIR = "bare FFT pair"
_PEERS = (
    "HCIPy (pads to twice the size), cached transfer function",
    "torchoptics, asm_pad = 0",
    "NumPy, cached transfer function",
)
_AGREEMENT = 1e-4

Step = Callable[[np.ndarray], np.ndarray]


def run(sizes: list[int], runs: int) -> list[Row]:
    """Compare at several sizes, on one thread and on all."""
    counts = sorted({1, worker_count()})
    return [row for threads in counts for row in on_cores(threads, _compare_sizes, sizes, threads, runs)]


def _compare_sizes(sizes: list[int], threads: int, runs: int) -> list[Row]:
    return [row for size in sizes for row in _compare(size, threads, runs)]


def _beam(size: int) -> np.ndarray:
    """Make a narrow beam, slightly oblique, that stays far from the edges: with padding or without it is the same."""
    x = (np.arange(size) - size // 2) / size
    y, x = np.meshgrid(x, x, indexing="ij")
    wave = np.exp(-((x - 0.03) ** 2 + (y + 0.02) ** 2) / 0.004 + 2j * np.pi * (9 * x - 14 * y))
    return wave.astype(np.complex64)


def _compare(size: int, threads: int, runs: int) -> list[Row]:
    beam = _beam(size)
    fields = {name: beam.copy() for name in (_PAIR, "ours")}

    def pair() -> None:
        with resting_drjit():
            field = scipy.fft.fft2(fields[_PAIR], overwrite_x=True, workers=threads)
            fields[_PAIR] = scipy.fft.ifft2(field, overwrite_x=True, workers=threads)

    def ours() -> None:
        fields["ours"] = propagate(fields["ours"], _PITCH, _DISTANCE, _WAVELENGTH, overwrite=True)

    expected = propagate(beam, _PITCH, _DISTANCE, _WAVELENGTH)
    works: dict[str, Callable[[], object]] = {"ours": ours, _PAIR: pair}
    notes = {}
    for name, make in zip(_PEERS, (_hcipy, _torchoptics, _numpy), strict=True):
        try:
            step = make(size, threads)
        except ImportError as missing:
            notes[name] = f"not installed ({missing.name})"
            continue
        carrier = np.exp(2j * np.pi * ((_DISTANCE / (_WAVELENGTH * 1e-6)) % 1))
        answer = step(beam)
        difference = min(
            np.linalg.norm(answer * factor - expected) / np.linalg.norm(expected) for factor in (1, carrier.conj())
        )
        notes[name] = f"{answer.dtype}; differs by {difference:.0e}"
        if difference > _AGREEMENT:
            notes[name] += ": not the same result"
        works[name] = lambda step=step: step(beam)
    timings = side_by_side(works, runs)
    what = f"angular-spectrum step, {size} x {size}, {threads} thread{'s' * (threads > 1)}"
    rows = []
    for name in (_PAIR, *_PEERS):
        if name not in timings:
            rows.append(Row(what, against=name, note=notes[name]))
            continue
        # of the bare pair: how many pairs ours takes; of a library: how many times ours is faster
        theirs = timings[name]
        ratio, cpu = theirs.ratio, theirs.cpu_ratio
        if name == _PAIR:
            ratio, cpu = 1 / ratio, 1 / cpu
        note = notes.get(name, "ours over the pair")
        rows.append(Row(what, "ms", 1e3 * timings["ours"].seconds, name, 1e3 * theirs.seconds, ratio, cpu, note))
    return rows


def _hcipy(size: int, threads: int) -> Step:
    """HCIPy's step, which pads to twice the size."""
    hcipy = importlib.import_module("hcipy")
    grid = hcipy.make_uniform_grid([size, size], [size * _PITCH] * 2)
    step = hcipy.AngularSpectrumPropagator(grid, _DISTANCE, num_oversampling=1)

    def run(field: np.ndarray) -> np.ndarray:
        wave = hcipy.Wavefront(hcipy.Field(field.ravel(), grid), _WAVELENGTH * 1e-6)
        return np.asarray(step.forward(wave).electric_field).reshape(size, size)

    return run


def _torchoptics(size: int, threads: int) -> Step:
    torchoptics, torch = importlib.import_module("torchoptics"), importlib.import_module("torch")
    torch.set_num_threads(threads)

    def run(field: np.ndarray) -> np.ndarray:
        wave = torchoptics.Field(torch.from_numpy(field), _WAVELENGTH * 1e-6, 0.0, _PITCH)
        return wave.propagate_to_z(_DISTANCE, propagation_method="ASM", asm_pad=(0, 0)).data.numpy()

    return run


def _numpy(size: int, threads: int) -> Step:
    frequency = np.fft.fftfreq(size, _PITCH) * _WAVELENGTH * 1e-6
    square = frequency[:, None] ** 2 + frequency**2
    turns = _DISTANCE / (_WAVELENGTH * 1e-6) * (np.sqrt(np.maximum(1 - square, 0)) - 1)
    transfer = (np.exp(2j * np.pi * turns) * (square < 1)).astype(np.complex64)
    return lambda field: np.fft.ifft2(np.fft.fft2(field) * transfer)


def run_gpu(sizes: list[int], runs: int) -> list[Row]:
    """Compare the step on a CUDA device with the bare pair of CuPy's transforms there."""
    if not dr.has_backend(dr.JitBackend.CUDA):
        command = "python tools/benchmark.py --only gpu --output out/benchmark"
        return [Row("GPU", note=f"no CUDA device here; where one is, `{command}` fills this in")]
    import cupy
    from drjit.cuda.ad import Complex2f, Float

    from mitsuba_plenoptic.propagation.angular_spectrum import propagate_differentiable

    rows = []
    for size in sizes:
        beam = _beam(size)
        field = Complex2f(*(Float(np.ascontiguousarray(part).ravel()) for part in (beam.real, beam.imag)))
        array = cupy.asarray(beam)

        def ours(field: Any = field, size: int = size) -> None:
            dr.eval(propagate_differentiable(field, (size, size), _PITCH, _DISTANCE, _WAVELENGTH))
            dr.sync_thread()

        def pair(array: Any = array) -> None:
            cupy.fft.ifft2(cupy.fft.fft2(array))
            cupy.cuda.Device().synchronize()

        timings = side_by_side({_PAIR: pair, "ours": ours}, runs)
        seconds = [1e3 * timings[name].seconds for name in ("ours", _PAIR)]
        what = f"angular-spectrum step, {size} x {size}, CUDA"
        rows.append(Row(what, "ms", seconds[0], f"{_PAIR}, CuPy", seconds[1], timings["ours"].ratio))
    return rows
