"""The cost of derivatives of captures, compared with the capture itself."""

from __future__ import annotations

import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mitsuba_plenoptic import CaptureOperator, Job, PlenopticCamera
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.accuracy import derivative_band_for
from mitsuba_plenoptic.points.field_grid import Grid, place
from mitsuba_plenoptic.runtime.batches import Threads

from .. import Row, at_most, case, figure
from ..scenes.letters import letter_points
from ..timing import in_process, paired, peak_memory, status_memory

WAVELENGTH = 633.0
MODES: dict[str, Callable[[CaptureOperator, Any, Any], object]] = {
    "image": lambda operator, weights, image: operator.forward(weights),
    "reverse, by all parameters": lambda operator, weights, image: operator.gradient(weights, image),
    "reverse, by `focal_length` and `wavefront`": lambda operator, weights, image: operator.gradient(
        weights, image, ("focal_length", "wavefront")
    ),
    "forward, by `focal_length`": lambda operator, weights, image: operator.derivative(weights, {"focal_length": 1.0}),
}


@case(
    "derivative-cost.letters",
    "Derivatives of a capture of the letters with spreads shared, each in a process of its own, against the image: "
    "processor time, time, and the largest memory beyond that of the process before (Linux)",
    {
        "": "{mode}", "points": "{points}", "processor (s)": "{processor:.2f}", "over the image": "{ratio:.2f}",
        "time (s)": "{seconds:.2f}", "memory (GiB)": "{memory:.2f}", "over that of the image": "{memory_ratio:.2f}",
    },
    (at_most("reverse_ratio", 4.0), at_most("reverse_memory", 3.0)),
    page="docs/derivatives.md",
    quick={"pixels": 128, "points_per_lens": 16},
)  # fmt: skip
def letters(*, pixels: int = 256, points_per_lens: int = 64, accuracy: float = 0.01, runs: int = 2) -> Iterator[Row]:
    """Run each mode; radiators are found once. The last of the runs counts, as the first compiles."""
    part = pixels / 4096
    camera = PlenopticCamera(detector_width=8.192 * part, resolution=(pixels, pixels))
    points, weights = letter_points(camera, part, points_per_lens)
    image: Row = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "points.npz"
        np.savez(file, points=points, weights=weights)
        for mode in MODES:
            row = in_process(_measured, mode, file, camera, accuracy, runs)
            image = image or row
            row["ratio"], row["memory_ratio"] = (row[key] / image[key] for key in ("processor", "memory"))
            # Small detectors are dominated by what is planned.
            if mode == "reverse, by all parameters" and pixels >= 256:
                row |= {"reverse_ratio": row["ratio"], "reverse_memory": row["memory_ratio"]}
            yield {"mode": mode, "points": len(points), **row}


def _measured(mode: str, file: Path, camera: PlenopticCamera, accuracy: float, runs: int) -> Row:
    stored = np.load(file)
    operator = CaptureOperator(camera, stored["points"], wavelength=WAVELENGTH, accuracy=accuracy)
    image = np.random.default_rng(0).uniform(-1, 1, camera.shape).astype(np.float32)
    before = status_memory("VmRSS") or 0.0
    for _ in range(runs):
        began = time.perf_counter(), time.process_time()
        MODES[mode](operator, stored["weights"], image)
        taken = time.perf_counter() - began[0], time.process_time() - began[1]
    return {"seconds": taken[0], "processor": taken[1], "memory": peak_memory() - before}


@case(
    "derivative-cost.unshared",
    "Forward and reverse mode over the image, on one thread, nothing shared: processor time, and NumPy's memory",
    {"accuracy": "{accuracy:g}", "mode": "{mode}", "time": "{time:.1f}", "memory": "{memory:.1f}"},
    page="docs/derivatives.md",
    quick={"points": 16, "runs": 1},
)
def unshared(*, points: int = 128, runs: int = 3) -> Iterator[Row]:
    """Time random points before a small detector."""
    rng = np.random.default_rng(2)
    camera = PlenopticCamera(detector_width=0.512, resolution=(256, 256))
    g = rng.uniform(215, 265, points)
    places = np.column_stack([rng.uniform(-0.2, 0.2, (points, 2)) * -g[:, None] / 120, g])
    weights, image, job = np.ones(points), rng.normal(size=camera.shape).astype(np.float32), Job(batch_map=Threads(1))
    for accuracy in (0.01, 0.05):
        operator = CaptureOperator(camera, places, wavelength=WAVELENGTH, accuracy=accuracy)
        works: dict[str, Callable[[], object]] = {
            "image": lambda o=operator: o.forward(weights, job=job),
            "forward mode": lambda o=operator: o.derivative(weights, {"focal_length": 1.0}, job=job),
            "reverse mode": lambda o=operator: o.gradient(weights, image, job=job),
        }
        timings, memory = paired(works, runs), {}
        for name, work in works.items():
            tracemalloc.start()
            work()
            memory[name] = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        for name in ("forward mode", "reverse mode"):
            ratio = timings[name].processor_ratio
            yield {"accuracy": accuracy, "mode": name, "time": ratio, "memory": memory[name] / memory["image"]}


@case(
    "derivative-cost.torchoptics",
    "One point's light through one lens to a plane, and the gradient of the power there by the focal length, on one "
    "thread: ours on a patch, against the autograd of torchoptics in its own double precision",
    page="docs/derivatives.md",
    needs=("torchoptics",),
    quick={"runs": 1},
)
def against_torchoptics(*, runs: int = 5) -> Iterator[Row]:
    """Time both in turn; the field of torchoptics is as large as the patch."""
    import torch
    import torchoptics

    camera = PlenopticCamera(
        aperture_radius=2.0, mla_distance=119.5, detector_distance=0.5,
        # One weak microlens about the axis.
        mla_focal_length=1e5, mla_pitch=2.0, mla_offset=(1.0, 1.0), detector_width=0.256, resolution=(128, 128),
    )  # fmt: skip
    operator = CaptureOperator(camera, [(0.0, 0.0, 225.0)], wavelength=WAVELENGTH, accuracy=0.02)
    image, job = np.ones(camera.shape, np.float32), Job(batch_map=Threads(1))
    points = np.array(operator.points)
    grid = Grid.of(OpticalSystem(camera, WAVELENGTH), derivative_band_for(0.02, 1), points)
    size = int(place(grid, points).samples[0])
    torch.set_num_threads(1)
    torchoptics.set_default_spacing(float(grid.pitch.min()))
    torchoptics.set_default_wavelength(WAVELENGTH * 1e-6)
    field = torchoptics.Field(torch.ones(size, size, dtype=torch.complex128))

    def power(lens: Any) -> Any:
        return lens(field).propagate_to_z(5.0, propagation_method="ASM").intensity().sum()

    def gradient() -> None:
        lens = torchoptics.elements.Lens(size, torch.nn.Parameter(torch.tensor(80.0, dtype=torch.double)))
        power(lens).backward()
        assert lens.focal_length.grad is not None

    still = torchoptics.elements.Lens(size, 80.0)
    timings = paired(
        {
            "our gradient": lambda: operator.gradient([1.0], image, ("focal_length",), job=job),
            "our image": lambda: operator.forward([1.0], job=job),
            "gradient of torchoptics": gradient,
            "image of torchoptics": lambda: power(still),
        },
        runs,
    )
    for name, timing in timings.items():
        yield figure(f"{name}, {size} x {size} samples", 1e3 * timing.processor, unit="ms")
    yield figure("gradient, torchoptics over ours", timings["gradient of torchoptics"].processor_ratio)
