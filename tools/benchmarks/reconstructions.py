"""Reconstructions on one core at the paper's size, against bare FFTs, a pass over the image, and the paper's seconds.

Two captures: one with every pixel lit, where nothing can be skipped, and the letters. "FFTs" are the Fourier transforms
that the coherent method performs, of the same lengths and in the same number, along the axes of whole arrays.

Shift-and-add by whole bins is how PlenoptiCam (0.9.3) refocuses: every view is moved by a whole number of bins on a
canvas that holds them all, and the middle of the sum is cut out. PlenoptiCam itself cannot be installed beside this
package (it demands tifffile 2022.4.8, and its dependency depthy takes from SciPy what 1.12 dropped), so the sum is
written out here, in NumPy, for one channel and without the borders that PlenoptiCam repeats.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.lightfield.geometry import distance_of
from mitsuba_plenoptic.lightfield.refocus import refocus
from mitsuba_plenoptic.reconstruction.full_fields import lit_window
from mitsuba_plenoptic.reconstruction.planning import plan

from .table import Row, on_cores, side_by_side

_WAVELENGTH = 633.0
_DISTANCE = 280.0
_DISTANCES = [210.0, 240.0, 280.0]
# One core of about 2012.
PAPER_SECONDS = {"ray, point version": 330.0, "coherent": 65.0, "partially coherent, K = 2": 195.0}


def run(runs: int, old: Path | None) -> list[Row]:
    """Time everything on one core; in the notes, beside it, what an older version takes."""
    rows = on_cores(1, _compare_all, runs)
    return rows if old is None else list(_beside(rows, old.resolve(), runs))


def _beside(rows: list[Row], old: Path, runs: int) -> Iterator[Row]:
    """Let the older version's own benchmark run, and add its figures to the rows of the same titles."""
    with tempfile.TemporaryDirectory() as output:
        command = [old / ".venv/bin/python", old / "tools/benchmark.py", "--only", "reconstructions"]
        subprocess.run([*command, "--runs", str(runs), "--output", output], cwd=old, check=True)
        found = json.loads((Path(output) / "benchmark.json").read_text())["rows"]["reconstructions"]
    before = {(row["what"], row["against"]): row for row in found}
    for row in rows:
        figures = before.get((row.what, row.against))
        if figures and figures["cpu_ratio"]:
            said = "{ours:.3g} s, ratio {ratio:.3g}, CPU ratio {cpu_ratio:.3g}".format(**figures)
            row = dataclasses.replace(row, note=f"{row.note}; {old.name}: {said}")
        yield row


def _compare_all(runs: int) -> list[Row]:
    camera = PlenopticCamera()
    white = Capture(np.random.default_rng(0).random(camera.shape, dtype=np.float32) + 0.1, camera)
    letters = render_capture(load_scene("letters"), spp=1)
    lit, some = _compare("all lit", white, runs), _compare("letters", letters, runs)
    return [*lit, *some, *compare_shift_and_add(letters, runs)]


def compare_shift_and_add(capture: Capture, runs: int) -> Iterator[Row]:
    """Compare with shift-and-add by whole bins, at the distance where neighbouring views differ by one bin."""
    views = decode(capture)
    distance = float(distance_of(views, 1.0))
    ours, theirs = refocus(views, distance).values, shift_and_add(views.values * views["weight"].values)
    theirs *= np.vdot(theirs, ours) / np.vdot(theirs, theirs)
    inside = (slice(len(views), -len(views)),) * 2
    difference = np.linalg.norm((ours - theirs)[inside]) / np.linalg.norm(ours[inside])
    weighted = views.values * views["weight"].values
    works = {
        "ray, point version": lambda: reconstruct(capture, distance, footprint="point"),
        "decoding": lambda: decode(capture),
        "shift-and-add by whole bins": lambda: shift_and_add(weighted),
        "refocus": lambda: refocus(views, distance),
    }
    timings = side_by_side(works, runs)
    adding, decoding = timings["shift-and-add by whole bins"], timings["decoding"]
    for what, ours_timing, seconds, cpu, against in (
        (
            "ray, point version, letters, from the capture", timings["ray, point version"],
            decoding.seconds + adding.seconds, decoding.cpu_seconds + adding.cpu_seconds,
            "decoding, then shift-and-add by whole bins",
        ),
        (
            "`refocus`, letters, from the views, any distance", timings["refocus"],
            adding.seconds, adding.cpu_seconds, "shift-and-add by whole bins",
        ),
    ):  # fmt: skip
        note = f"times faster; {len(views)} x {len(views)} views; sums differ by {100 * difference:.2g} %"
        yield Row(
            f"{what}, one core", "s", ours_timing.seconds, against, seconds, seconds / ours_timing.seconds,
            cpu / ours_timing.cpu_seconds, note,
        )  # fmt: skip


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
    def work(distance: float | list[float] = _DISTANCE, **options: Any) -> Callable[[], Any]:
        if "method" in options:
            options["wavelength"] = _WAVELENGTH
        return lambda: reconstruct(capture, distance, **options)

    image = capture.image
    works = {
        "`(I * I).sum()`": lambda: (image * image).sum(),
        "ray, point version": work(footprint="point"),
        "ray, lens version": work(footprint="lens"),
        "FFTs of coherent": _bare_transforms(capture, _DISTANCE),
        "coherent": work(method="coherent"),
        "coherent, 3 distances": work(_DISTANCES, method="coherent"),
        "partially coherent, K = 2": work(method="partial", interleave=2),
    }
    against = {
        "ray, point version": "`(I * I).sum()`",
        "ray, lens version": "`(I * I).sum()`",
        "coherent": "FFTs of coherent",
        "coherent, 3 distances": "coherent",
        "partially coherent, K = 2": "coherent",
    }
    timings = side_by_side(works, runs)
    for what, other in against.items():
        ours, theirs = timings[what], timings[other]
        title = f"{what}, {name}, one core"
        yield Row(
            title, "s", ours.seconds, other, theirs.seconds, ours.seconds / theirs.seconds,
            ours.cpu_seconds / theirs.cpu_seconds, "ours over theirs",
        )  # fmt: skip
        if what in PAPER_SECONDS:
            paper = PAPER_SECONDS[what]
            yield Row(title, "s", ours.seconds, "the paper", paper, paper / ours.seconds, note="times faster")


def _bare_transforms(capture: Capture, distance: float) -> Callable[[], None]:
    """Do nothing but the transforms of the coherent method."""
    lit = lit_window(capture.image, capture.camera)
    assert lit is not None
    grids = plan(capture.camera, _WAVELENGTH, [distance], lit)
    # Along rows for the first and the last of a step's four, along columns for the two between them; the last step has
    # two, along rows and along columns.
    shapes = [
        ((count, length) if axis else (length, count), axis, inverse)
        for step in grids.steps
        for (count, length, inverse), axis in zip(step.transforms, (1, 0, 0, 1), strict=False)
    ]
    memory = np.ones(max(rows * columns for (rows, columns), _, _ in shapes), np.complex64)

    def transforms() -> None:
        for shape, axis, inverse in shapes:
            field = memory[: shape[0] * shape[1]].reshape(shape)
            transform = scipy.fft.ifft if inverse else scipy.fft.fft
            transform(field, axis=axis, overwrite_x=True, workers=1, norm="ortho")

    return transforms
