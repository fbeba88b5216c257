"""The step by the angular spectrum against the bare pair of FFTs and against other libraries' steps."""

from __future__ import annotations

import importlib
from collections.abc import Callable

import numpy as np
import scipy.fft

from mitsuba_plenoptic.optics.free_space import propagate
from mitsuba_plenoptic.runtime.fft import resting_drjit, worker_count

from .table import Row, on_cores, side_by_side

PITCH, DISTANCE, WAVELENGTH = 4e-3, 5.0, 633.0
_PAIR = "bare FFT pair"
_PEERS = (
    "HCIPy (pads to twice the size), cached transfer function",
    "torchoptics, asm_pad = 0",
    "NumPy, cached transfer function",
)
_AGREEMENT = 1e-4

# Bytes that a library's step takes for each sample, with its cached transfer function: peaks measured at 2048 x 2048.
_BYTES = {_PEERS[0]: 290, _PEERS[1]: 110, _PEERS[2]: 55}

_LARGE = 4096
"""Samples across above which the libraries are timed once: their steps take a minute each."""

Step = Callable[[np.ndarray], np.ndarray]


def run(sizes: list[int], runs: int, memory: float) -> list[Row]:
    """Compare at several sizes, on one thread and on all; a library that needs more GiB than allowed is left out."""
    counts = sorted({1, worker_count()})
    # A process for each: what one leaves behind is not in the next one's way.
    cases = [(size, threads) for threads in counts for size in sizes]
    return [row for size, threads in cases for row in on_cores(threads, _compare, size, threads, runs, memory)]


def beam(size: int) -> np.ndarray:
    """Make a narrow beam, slightly oblique, that stays far from the edges: with padding or without it is the same."""
    x = (np.arange(size) - size // 2) / size
    along_x, along_y = (
        np.exp(-((x - centre) ** 2) / 0.004 + 2j * np.pi * turns * x).astype(np.complex64)
        for centre, turns in ((0.03, 9), (-0.02, -14))
    )
    return along_y[:, None] * along_x


def _compare(size: int, threads: int, runs: int, memory: float) -> list[Row]:
    field = beam(size)
    fields = {name: field.copy() for name in (_PAIR, "ours")}

    def pair() -> None:
        with resting_drjit():
            spectrum = scipy.fft.fft2(fields[_PAIR], overwrite_x=True, workers=threads)
            fields[_PAIR] = scipy.fft.ifft2(spectrum, overwrite_x=True, workers=threads)

    def ours() -> None:
        fields["ours"] = propagate(fields["ours"], PITCH, DISTANCE, WAVELENGTH, overwrite=True)

    expected = propagate(field, PITCH, DISTANCE, WAVELENGTH)
    works: dict[str, Callable[[], object]] = {"ours": ours, _PAIR: pair}
    notes = {}
    for name, make in zip(_PEERS, (_hcipy, _torchoptics, _numpy), strict=True):
        needed = _BYTES[name] * size**2 / 2**30
        if needed > memory:
            notes[name] = f"left out: it takes about {needed:.0f} GiB, --memory allows {memory:g}"
            continue
        try:
            step = make(size, threads)
        except ImportError as missing:
            notes[name] = f"not installed ({missing.name})"
            continue
        carrier = np.exp(2j * np.pi * ((DISTANCE / (WAVELENGTH * 1e-6)) % 1))
        answer = step(field)
        difference = min(
            np.linalg.norm(answer * factor - expected) / np.linalg.norm(expected) for factor in (1, carrier.conj())
        )
        notes[name] = f"{answer.dtype}; differs by {difference:.0e}"
        if difference > _AGREEMENT:
            notes[name] += ": not the same result"
        works[name] = lambda step=step: step(field)
    large = size > _LARGE
    peers = {name: works.pop(name) for name in _PEERS if name in works} if large else {}
    timings = side_by_side(works, runs)
    if peers:
        timings = side_by_side({"ours": ours, **peers}, 1) | timings
        notes |= {name: f"{notes[name]}; timed once" for name in peers}
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
    grid = hcipy.make_uniform_grid([size, size], [size * PITCH] * 2)
    step = hcipy.AngularSpectrumPropagator(grid, DISTANCE, num_oversampling=1)

    def run(field: np.ndarray) -> np.ndarray:
        wave = hcipy.Wavefront(hcipy.Field(field.ravel(), grid), WAVELENGTH * 1e-6)
        return np.asarray(step.forward(wave).electric_field).reshape(size, size)

    return run


def _torchoptics(size: int, threads: int) -> Step:
    torchoptics, torch = importlib.import_module("torchoptics"), importlib.import_module("torch")
    torch.set_num_threads(threads)

    def run(field: np.ndarray) -> np.ndarray:
        wave = torchoptics.Field(torch.from_numpy(field), WAVELENGTH * 1e-6, 0.0, PITCH)
        return wave.propagate_to_z(DISTANCE, propagation_method="ASM", asm_pad=(0, 0)).data.numpy()

    return run


def _numpy(size: int, threads: int) -> Step:
    frequency = np.fft.fftfreq(size, PITCH) * WAVELENGTH * 1e-6
    square = frequency[:, None] ** 2 + frequency**2
    turns = DISTANCE / (WAVELENGTH * 1e-6) * (np.sqrt(np.maximum(1 - square, 0)) - 1)
    transfer = (np.exp(2j * np.pi * turns) * (square < 1)).astype(np.complex64)
    return lambda field: np.fft.ifft2(np.fft.fft2(field) * transfer)
