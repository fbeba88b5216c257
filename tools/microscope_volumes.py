"""Measure volumes deconvolved behind an objective: widths of beads over depth, and the time of a step beside pyolaf's.

Beads, points between bins, lie one in each plane, and the volume of all planes is deconvolved from one capture of exact
point spreads. Their widths at half of the peak stand beside Broxton's limit, the distance of points just told apart.

A step of Richardson and Lucy is a projection forward and one back. pyolaf, the extra `peers`, does both with as many
samples: bins and pixels a lens, lenses, planes. Its patterns are given their sizes and any values, on which its time
does not depend: it convolves by Fourier transforms whatever they are. Of ours whole steps of that deconvolution are
timed, with all that they do beside. Peak memory is that of the process before pyolaf is run.

    python tools/microscope_volumes.py
    python tools/microscope_volumes.py --planes 32 --iterations 70      as many planes as pyolaf's examples have
    python tools/microscope_volumes.py --planes 32 --peer-planes 4      pyolaf and ours compared with fewer
    python tools/microscope_volumes.py --alone          without pyolaf
"""

from __future__ import annotations

import math
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np
from accuracy import Row, finish, markdown, options, start

from mitsuba_plenoptic import Capture, CaptureOperator, Objective, PlenopticCamera, design, reconstruct
from mitsuba_plenoptic.reconstruction.deconvolution.response import Response

WAVELENGTH, PITCH, PIXELS, BINS = 550.0, 0.075, 15, 5
"""Nanometres; millimetres; pixels and bins across a lens."""

REACH = 0.25
"""How far from the axis beads lie at most, over the width of the field."""

NEAREST, FARTHEST = 0.016, 0.04
"""Depths in millimetres, beyond that where the lens pitch decides."""

WIDTH_LIMIT, PLACE_LIMIT, MEMORY_LIMIT = 1.0, 0.25, 8.0
"""Largest width over Broxton's distance, largest error of place in bins, and most memory in GiB."""


def microscope(lenses: int) -> PlenopticCamera:
    """Return a microscope whose planes are beyond the shallow ones from 13 um on; one lens is on its axis."""
    return PlenopticCamera(
        main_lens=Objective(20, 0.5),
        mla_pitch=PITCH,
        mla_focal_length=20 * PITCH,
        mla_offset=(PITCH / 2, PITCH / 2),
        detector_width=lenses * PITCH,
        resolution=(lenses * PIXELS,) * 2,
    )


def beads(camera: PlenopticCamera, depths: np.ndarray) -> np.ndarray:
    """Return a bead in each plane, (n, 3), one in each cell of a square grid, and not in the middle of bins."""
    random = np.random.default_rng(4)
    across, size = _cells(camera, len(depths))
    cells = random.permutation(across**2)[: len(depths)]
    corner = np.column_stack([cells % across, cells // across]) - across / 2
    return np.column_stack([(corner + random.uniform(0.4, 0.6, corner.shape)) * size, depths])


def _cells(camera: PlenopticCamera, count: int) -> tuple[int, float]:
    """Return how many cells there are along an axis for so many beads, and their width."""
    across = math.ceil(math.sqrt(count))
    return across, 2 * REACH * camera.detector_width / 20 / across


def width(profile: np.ndarray, bin_size: float) -> float:
    """Return the width at half of the peak, between bins by straight lines."""
    peak = int(profile.argmax())
    half, ends = profile[peak] / 2, []
    for side in (profile[peak::-1], profile[peak:]):
        below = int(np.argmax(side < half))
        ends.append(below - (half - side[below]) / (side[below - 1] - side[below]))
    return float(sum(ends) * bin_size)


def deconvolved_beads(camera: PlenopticCamera, depths: np.ndarray, iterations: int) -> tuple[list[Row], Row]:
    """Return place and width of each bead in the deconvolved volume, and the seconds of planning and of a step."""
    points = beads(camera, depths)
    image = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0).forward(np.ones(len(points)))
    capture = Capture(np.maximum(image, 0), camera, WAVELENGTH, "wave", {})
    times: dict[int, float] = {}

    def told(done: int, total: int) -> None:
        times.setdefault(done, time.perf_counter())

    found = reconstruct(
        capture,
        depths.tolist(),
        method="deconvolved",
        oversample=BINS,
        iterations=iterations,
        volume=True,
        progress=told,
    )
    # Point spreads are the first 30 of the 100 parts of the work that are told, steps the others.
    planned, first = max(done for done in times if done <= 30), min(done for done in times if done > 30)
    # Where something is compiled it is in the first step.
    seconds = {"step": (times[100] - times[first]) / (iterations - 1), "planning": times[planned] - times[0]}
    rows = []
    for plane, (X, Y, depth) in zip(found, points, strict=True):
        values = np.nan_to_num(plane.image)
        # Pictures have +x to the left and +y up.
        y, x = ((size / 2 - np.arange(size) - 0.5) * plane.bin_size for size in values.shape)
        # Planes show beads of their neighbours, too, in other cells.
        reach = _cells(camera, len(depths))[1] / 2
        own = values * ((np.abs(x - X) < reach) & (np.abs(y - Y) < reach)[:, None])
        row, column = np.unravel_index(own.argmax(), own.shape)
        around = np.s_[max(0, row - 3) : row + 4, max(0, column - 3) : column + 4]
        light = values[around] / values[around].sum()
        error = np.hypot(light.sum(0) @ x[around[1]] - X, light.sum(1) @ y[around[0]] - Y)
        widths = width(own[row], plane.bin_size), width(own[:, column], plane.bin_size)
        limit = design.resolution_limit(camera, depth, WAVELENGTH)
        rows.append(
            {
                "depth": float(1e3 * depth),
                "error": float(error / plane.bin_size),
                "width": 1e3 * max(widths),
                "limit": 1e3 / limit.waves,
                "pixels": 1e3 / (2 * limit.pixels),
                "pitch": 1e3 * PITCH / 20,
            }
        )
    bins = sum(plane.image.size for plane in found)
    return rows, {"who": "ours, whole steps", "planes": len(depths), "bins": bins, **seconds}


def quickest(work: Callable[[], object], runs: int = 3) -> float:
    """Return the seconds of the quickest of some runs, the first left out."""
    times = []
    for _ in range(runs + 1):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return min(times[1:])


def our_step(camera: PlenopticCamera, depths: np.ndarray) -> Row:
    """Return the seconds of a step, and of the planning before the first."""
    began = time.perf_counter()
    response = Response(camera, depths.tolist(), wavelength=WAVELENGTH, oversample=BINS)
    planning = time.perf_counter() - began
    image = np.random.default_rng(0).random(camera.shape).astype(np.float32)
    volume = response.adjoint(image)
    step = quickest(lambda: response.adjoint(response.forward(volume)))
    bins = sum(values.size for values in volume)
    return {"who": "ours", "planes": len(depths), "step": step, "planning": planning, "bins": bins}


def their_step(camera: PlenopticCamera, depths: np.ndarray) -> Row:
    """Return the seconds of pyolaf's step with as many samples."""
    from pyolaf import project
    from scipy.sparse import csr_matrix

    lenses = camera.lens_count[0] // 2 * 2 + 1
    across = int(np.ceil(max(camera.blur_diameter(depth) for depth in depths) / 2 / PITCH) + 2)
    patterns = {}
    for name, number, samples in (("H", BINS, PIXELS), ("Ht", PIXELS, BINS)):
        pattern = csr_matrix(np.ones((2 * across * samples + 1,) * 2, np.float32))
        patterns[name] = np.full((number, number, len(depths)), pattern, dtype=object)
    index = np.arange(lenses) - lenses // 2
    grid = np.stack(np.meshgrid(index, index, indexing="ij"), -1).astype(float)
    centres = {"px": grid * PIXELS, "vox": grid * BINS}
    resolution: dict[str, Any] = {
        "TexNnum": np.array([BINS, BINS]), "TexNnum_half": np.array([BINS // 2 + 1] * 2), "texMask": np.array(1),
        "Nnum": np.array([PIXELS, PIXELS]), "Nnum_half": np.array([PIXELS // 2 + 1] * 2),
        "sensMask": np.ones((PIXELS, PIXELS)), "texScaleFactor": np.array([BINS / PIXELS] * 2),
    }  # fmt: skip
    detector, volume = np.array([lenses * PIXELS] * 2), np.ones((lenses * BINS, lenses * BINS, len(depths)))
    for name in ("TexNnum", "TexNnum_half", "texMask", "Nnum", "Nnum_half", "sensMask", "texScaleFactor"):
        resolution[name] = np.asarray(resolution[name])

    def step() -> None:
        image = project.LFM_forwardProject(patterns["H"], volume, centres, resolution, detector, "full")
        project.LFM_backwardProject(patterns["Ht"], image, centres, resolution, detector // PIXELS * BINS, "full")

    # Nothing of it is compiled, so that its first run is as quick as any.
    began = time.perf_counter()
    step()
    seconds = time.perf_counter() - began
    return {"who": "pyolaf", "planes": len(depths), "step": seconds, "planning": float("nan"), "bins": volume.size}


def main() -> None:
    """Measure, print and write."""
    parser = options("microscope_volumes", __doc__)
    parser.add_argument("--planes", type=int, default=4, help="planes of the volume")
    parser.add_argument("--lenses", type=int, default=21, help="lenses across the detector, odd")
    parser.add_argument("--iterations", type=int, default=30, help="steps of the deconvolution")
    parser.add_argument("--peer-planes", type=int, help="planes with which pyolaf is compared; default: as many")
    parser.add_argument("--alone", action="store_true", help="do without pyolaf")
    arguments = start(parser)
    if not 2 <= arguments.iterations <= 70:
        parser.error(f"--iterations {arguments.iterations}: steps are timed between 2 and 70")
    camera, depths = microscope(arguments.lenses), np.linspace(NEAREST, FARTHEST, arguments.planes)
    widths, whole = deconvolved_beads(camera, depths, arguments.iterations)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 2**30
    steps = [whole]
    if not arguments.alone:
        some = depths[: arguments.peer_planes or len(depths)]
        steps += [our_step(camera, some), their_step(camera, some)]
    texts = [
        f"Beads in {len(depths)} planes after {arguments.iterations} steps (limits: width {WIDTH_LIMIT:g} of Broxton's "
        f"distance, or two bins if that is wider; place {PLACE_LIMIT:g} bins)\n",
        markdown(
            {
                "depth, um": "{depth:.3g}",
                "place, bins": "{error:.3f}",
                "width, um": "{width:.3g}",
                "Broxton's distance, um": "{limit:.3g}",
                "lens pitch, um": "{pitch:.3g}",
            },
            widths,
        ),
        "A step of Richardson and Lucy (limit: ours quicker)\n",
        markdown(
            {
                "": "{who}",
                "planes": "{planes}",
                "bins": "{bins}",
                "step, s": "{step:.3g}",
                "planning, s": "{planning:.3g}",
            },
            steps,
        ),
        f"Peak memory: {memory:.2f} GiB (limit {MEMORY_LIMIT:g})\n",
    ]
    least = 2e3 * PITCH / 20 / BINS
    failed = [
        row for row in widths if row["width"] > max(WIDTH_LIMIT * row["limit"], least) or row["error"] > PLACE_LIMIT
    ]
    if len(steps) > 1 and steps[1]["step"] >= steps[2]["step"]:
        failed.append(steps[1])
    if memory > MEMORY_LIMIT:
        failed.append({"memory": memory})
    finish(arguments, {"variant": mi.variant(), "widths": widths, "steps": steps, "memory": memory}, *texts)
    if failed:
        sys.exit(f"beyond the limits: {failed}")


if __name__ == "__main__":
    main()
