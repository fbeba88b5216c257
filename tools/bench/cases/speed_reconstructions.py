"""Reconstructions on one core at the paper's size, against bare FFTs, a pass over the image, and the paper's seconds.

Two captures: one with every pixel lit, where nothing can be skipped, and the letters. "FFTs" are the Fourier transforms
that the coherent method performs, of the same lengths and in the same number, along the axes of whole arrays.

Shift-and-add by whole bins is how PlenoptiCam (0.9.3) refocuses: every view is moved by a whole number of bins on a
canvas that holds them all, and the middle of the sum is cut out. PlenoptiCam itself cannot be installed with this
package (it demands tifffile 2022.4.8, and its dependency depthy takes from SciPy what 1.12 dropped), so the sum is
written out here, in NumPy, for one channel and without the borders that PlenoptiCam repeats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.fft

from mitsuba_plenoptic import Capture, PlenopticCamera, decode, load_scene, reconstruct, render_capture
from mitsuba_plenoptic.extensions.paper.paper_limits import plain_seconds, plain_sums, run_plain_sums
from mitsuba_plenoptic.refocus.planning import plan
from mitsuba_plenoptic.refocus.ray_sums import pupil_radius, ray_sums
from mitsuba_plenoptic.refocus.wave_methods import lit_window
from mitsuba_plenoptic.views import distance_of, refocus

from .. import Row, at_most, case
from ..measures import relative
from ..speed import PAPER_SECONDS, SPEED, WAVELENGTH, compared
from ..timing import Timing, in_process, paired

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
    page="docs/numbers.md",
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
