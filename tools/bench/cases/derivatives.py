"""Derivatives of captures against central differences of the full field and direct sums, and their cost.

The camera is the paper's main lens at half its size before four lenses. Radiators are held. The step of a difference
is such that the image changes by 1 % of its norm, a quarter of that for the wavelength, and the grids of the full
field are those of the middle, 1.5 times as fine and in windows 2.6 times as wide as for images: what steep orders of
the microlenses fold back, and what wraps round a window, changes fastest with the parameters. Where the detector's
width changes the grids grow with it, and where wavelength or pitch do, the count of microlens orders is held.

The cost of derivatives of captures, compared with the capture itself.
"""

from __future__ import annotations

import itertools
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from mitsuba_plenoptic import CaptureOperator, Job, PlenopticCamera, Spectrum
from mitsuba_plenoptic.light.optical_system import OpticalSystem
from mitsuba_plenoptic.points.accuracy import derivative_band_for
from mitsuba_plenoptic.points.arrival import FieldGrids, field_grids
from mitsuba_plenoptic.points.derivatives import brightness_slopes
from mitsuba_plenoptic.points.field_grid import Grid, place
from mitsuba_plenoptic.points.full_field import full_field
from mitsuba_plenoptic.runtime.batches import Threads

from .. import Pivot, Row, at_most, case, figure, pick
from ..direct_sums import BANDS, spread
from ..measures import relative
from ..scenes.letters import letter_points
from ..timing import in_process, paired, peak_memory, status_memory

WAVELENGTH = 633.0

STEP = 0.01

STEPS = {"wavelength": 0.0025}
"""Steps of differences by parameters whose captures bend sooner, over the norm of the image."""

WINDOW, FINER = 2.6, 1.5
"""Width and fineness of the full field's windows over those for images."""

WALL = {"mla_distance": 0.03, "mla_pitch": 0.08, "detector_distance": 0.08}
"""Limits for a wall, whose derivatives are small differences of large ones."""

WALL_ACCURACY, WALL_STEP = 0.02, 0.004

WHITE = {"mla_pitch": 0.05, "mla_distance": 0.05}
"""Limits, inside micro-images of white, for derivatives over the largest at the micro-images' edges."""

WHITE_PER_LENS, WHITE_EDGE = 12, 2
"""Radiators along a lens, and pixels within the edge of a micro-image that are no part of its inside."""

HALF = PlenopticCamera(
    focal_length=40, aperture_radius=2.5, mla_distance=60, detector_width=0.128, resolution=(64, 64)
)  # fmt: skip

HEXAGONAL = HALF.replace(mla_lattice="hexagonal", mla_fill=0.9)

DOUBLE_GAUSS = HALF.replace(main_lens="double_gauss", mla_distance=60.0)

CASES = {
    # Where four lenses meet on the axis, turning them changes nothing.
    "square, on axis, in focus": (HALF.replace(mla_offset=(0.012, 0.02)), (0.0, 0.0, 120.0)),
    "square, off axis, near": (HALF, (0.03, -0.02, 115.0)),
    "square, off axis, far": (HALF.replace(mla_fill=0.9), (-0.04, 0.03, 126.0)),
    "hexagonal, off axis, near": (HEXAGONAL, (0.03, -0.02, 115.0)),
    "hexagonal, focused, off axis": (
        HEXAGONAL.replace(mla_distance=57.0, detector_distance=0.6), (0.02, 0.03, 124.0)
    ),
    "double Gauss, on axis, in focus": (DOUBLE_GAUSS.replace(mla_offset=(0.012, 0.02)), (0.0, 0.0, 120.0)),
    "double Gauss, turned, off axis, near": (DOUBLE_GAUSS.replace(mla_rotation=9.0), (0.03, -0.02, 115.0)),
    "singlet, off axis, near": (HALF.replace(main_lens="singlet", mla_distance=60.0), (0.03, -0.02, 115.0)),
}  # fmt: skip
"""Cameras and scene points."""

LIMITS = {
    "focal_length": 0.005,
    "aperture_radius": 0.02,
    "mla_distance": 0.005,
    "mla_focal_length": 0.005,
    "mla_pitch": 0.005,
    "mla_rotation": 0.005,
    "mla_offset": 0.005,
    "mla_fill": 0.005,
    "detector_distance": 0.005,
    "detector_width": 0.005,
    "wavelength": 0.005,
}

ABERRATIONS = 36


TABLE = {"case": "{case}", "parameter": "{parameter}", "error": "{error:.2e}", "limit": "{limit:g}"}
JUDGED = (at_most("error", "limit"),)


def difference(camera: PlenopticCamera, point: np.ndarray, name: str, change: Any, step: float) -> np.ndarray:
    """Central difference of the full field."""
    base = field_grids(OpticalSystem(camera, WAVELENGTH), point, FINER, WINDOW)
    sides = []
    for amount in (step, -step):
        changed, wavelength = camera, WAVELENGTH
        if name == "wavelength":
            wavelength += amount
        else:
            values = camera.to_dict()
            present = np.zeros(len(change)) if name == "wavefront" else values[name]
            value = np.asarray(present) + amount * np.asarray(change)
            changed = camera.replace(**{name: value.tolist(), "detector_distance": values["detector_distance"]})
            if name == "detector_distance":
                changed = camera.replace(detector_distance=value.tolist())
        grids = _grown(base, changed.detector_width / camera.detector_width)
        order = wavelength / WAVELENGTH * camera.mla_pitch / changed.mla_pitch
        grids = replace(grids, bend=base.bend * order * (1 + 1e-9))
        sides.append(full_field(OpticalSystem(changed, wavelength), point, grids=grids))
    return (sides[0] - sides[1]) / (2 * step)


def _grown(grids: FieldGrids, factor: float) -> FieldGrids:
    x, y = grids.wide_origin
    return replace(grids, pitch=grids.pitch * factor, wide_origin=(x * factor, y * factor))


@case(
    "derivatives.full-field",
    "Derivatives of captures against central differences of the full field, relative L2 over the detector",
    TABLE,
    JUDGED,
    page="docs/guides/derivatives.md",
    pivot=Pivot("{case}", "{parameter}", "{error:.2%}"),
    quick={"parameters": ("mla_pitch",), "cases": ("square, off axis, near",)},
)
def against_full_field(*, parameters: tuple[str, ...] = (), cases: tuple[str, ...] = ()) -> Iterator[Row]:
    """Compare every named parameter at every point, and 36 aberrations at one."""
    limits = pick({**LIMITS, "wavefront": 0.005}, parameters)
    for name, (camera, position) in pick(CASES, cases).items():
        point = np.array(position)
        operator = CaptureOperator(camera, [point], wavelength=WAVELENGTH, accuracy=0)
        size = float(np.linalg.norm(operator.forward([1.0])))
        changes: list[tuple[str, Any]] = [(each, (0.6, -0.8) if each == "mla_offset" else 1.0) for each in limits]
        if "wavefront" in limits:
            changes.remove(("wavefront", 1.0))
            if name == "square, off axis, near":
                changes += [("wavefront", np.eye(ABERRATIONS)[j].tolist()) for j in range(1, ABERRATIONS)]
        for each, change in changes:
            if each == "mla_fill" and camera.mla_fill == 1:
                continue  # it can only shrink, and has no central difference
            found = operator.derivative([1.0], {each: change})
            step = STEPS.get(each, STEP) * size / float(np.linalg.norm(found))
            label = f"wavefront {change.index(1.0) + 1}" if each == "wavefront" else each
            error = relative(found, difference(camera, point, each, change, step))
            yield {"case": name, "parameter": label, "step": step, "error": error, "limit": limits[each]}


@case(
    "derivatives.wall",
    "Derivatives of a wall of points in the capture's own unit at accuracy 0.02, where changes of single spreads "
    "nearly cancel, against central differences of the full fields",
    TABLE,
    JUDGED,
    page="docs/guides/derivatives.md",
    quick={"across": 2, "parameters": ("mla_pitch",)},
)
def walls(*, across: int = 12, parameters: tuple[str, ...] = ()) -> Iterator[Row]:
    """Measure a wall, by the parameters under which its captures must stay white."""
    place = (np.arange(across) + 0.5) / 2 - across / 4
    x, y = (index.ravel() * HALF.mla_pitch for index in np.meshgrid(place, place))
    points = np.column_stack([-x * 116 / HALF.mla_distance, -y * 116 / HALF.mla_distance, np.full(x.size, 116.0)])
    operator = CaptureOperator(HALF, points, wavelength=WAVELENGTH, accuracy=WALL_ACCURACY)
    weights = np.ones(len(points))
    image = operator.forward(weights).astype(np.float64)
    for name, limit in pick(WALL, parameters).items():
        unit = float(brightness_slopes(HALF, [name])[name].sum()) * image
        found = operator.derivative(weights, {name: 1.0}).astype(np.float64)
        step = WALL_STEP * float(np.linalg.norm(image) / np.linalg.norm(found))
        expected = sum(difference(HALF, point, name, 1.0, step).astype(np.float64) for point in points)
        error = relative(found + unit, expected + unit)
        yield {"case": f"wall of {len(points)} points", "parameter": name, "error": error, "limit": limit}


@case(
    "derivatives.white",
    "Derivatives of a white capture inside its micro-images, where it stays white: RMS over the largest at their edges",
    TABLE,
    JUDGED,
    page="docs/guides/derivatives.md",
    quick={"per_lens": 2},
)
def whites(*, per_lens: int = WHITE_PER_LENS) -> Iterator[Row]:
    """Differentiate by the pitch and the distance of the array."""
    camera = HALF.replace(mla_offset=(HALF.mla_pitch / 2,) * 2, detector_width=HALF.mla_pitch, resolution=(32, 32))
    place = ((np.arange(3 * per_lens) + 0.5) / per_lens - 1.5) * camera.mla_pitch
    x, y = (part.ravel() for part in np.meshgrid(place, place))
    points = np.column_stack([-x * 116 / camera.mla_distance, -y * 116 / camera.mla_distance, np.full(x.size, 116.0)])
    # Finer than from where spreads are shared.
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0.0039)
    weights = np.ones(len(points))
    image = operator.forward(weights).astype(np.float64)
    lit = image > 0.9 * np.median(image[image > 0.5 * image.max()])
    inside = ndimage.binary_erosion(lit, iterations=WHITE_EDGE)
    for name, limit in WHITE.items():
        # Fewer radiators are no white.
        limit = limit if per_lens >= WHITE_PER_LENS else None
        unit = float(brightness_slopes(camera, [name])[name].sum()) * image
        change = operator.derivative(weights, {name: 1.0}).astype(np.float64) + unit
        error = float(np.sqrt((change[inside] ** 2).mean()) / np.abs(change).max())
        yield {"case": f"white, {inside.sum()} pixels inside", "parameter": name, "error": error, "limit": limit}


@case(
    "derivatives.adjoint",
    "Reverse against forward mode of captures and their derivatives: <A x, y> and <x, A' y>, over |A x| |y|",
    TABLE,
    JUDGED,
    page="docs/guides/derivatives.md",
    quick={"cases": ("square, off axis, near",)},
)
def adjoints(*, cases: tuple[str, ...] = ()) -> Iterator[Row]:
    """Compare two wavelengths of three points, by all parameters."""
    for case_name, (camera, position) in pick(CASES, cases).items():
        rng = np.random.default_rng(1)
        points = np.array(position) + rng.normal(size=(3, 3)) * (0.01, 0.01, 1.0)
        operator = CaptureOperator(camera, points, spectrum=Spectrum.lines(633, 532), accuracy=0.01)
        weights, image = rng.normal(size=(3, 2)), rng.normal(size=(*camera.shape, 2)).astype(np.float32)
        forward, back = operator.forward(weights).astype(np.float64), operator.adjoint(image)
        pairs = [("capture", forward, weights, back, 1e-5)]
        for name, gradient in operator.gradient(weights, image).items():
            change = rng.normal(size=gradient.shape)
            moved = operator.derivative(weights, {name: change}).astype(np.float64)
            pairs.append((f"derivative, {name}", moved, change, gradient, 1e-4))
        for name, moved, change, gradient, limit in pairs:
            scale = float(np.linalg.norm(moved) * np.linalg.norm(image))
            error = float(abs(np.vdot(moved, image) - np.vdot(change, gradient)) / scale)
            yield {"case": case_name, "parameter": name, "error": error, "limit": limit}


@case(
    "derivatives.wavelength",
    "Derivatives by the wavelength against direct sums in double precision, which share no code with captures, for "
    "three steepest directions: the sums move with these, and decide nothing finer",
    {
        "case": "{case}", "image": "{image:.2%}", "sums move by": "{moved:.2%}",
        "captures off the sums": "{captures[0]:.2%}, {captures[1]:.2%}, {captures[2]:.2%}",
        "full field off the sums": "{full_field[0]:.2%}, {full_field[1]:.2%}, {full_field[2]:.2%}",
    },
    (at_most("image", 0.002), at_most("least", "limit")),
    page="docs/guides/derivatives.md",
)  # fmt: skip
def wavelength(*, points: int = 1) -> Iterator[Row]:
    """Measure up to three points before square arrays, by central differences of 0.02 nanometres."""
    step = 0.02
    for name in ("square, off axis, near", "square, on axis, in focus", "square, off axis, far")[:points]:
        camera, position = CASES[name]
        point = np.array(position)
        operator = CaptureOperator(camera, [point], wavelength=WAVELENGTH, accuracy=0)
        image, ours = operator.forward([1.0]), operator.derivative([1.0], {"wavelength": 1.0}).astype(np.float64)
        of_field = STEPS["wavelength"] * float(np.linalg.norm(image) / np.linalg.norm(ours))
        full = difference(camera, point, "wavelength", 1.0, of_field).astype(np.float64)
        sums = []
        for band in BANDS:
            up, down = (spread(camera, point, WAVELENGTH + side * step, band) for side in (1, -1))
            sums.append((up - down) / (2 * step))
        moved = max(relative(one, other) for one, other in itertools.combinations(sums, 2))
        captures = [relative(ours, one) for one in sums]
        yield {
            "case": name, "image": relative(image, spread(camera, point, WAVELENGTH, BANDS[0])), "moved": moved,
            "captures": captures, "full_field": [relative(full, one) for one in sums], "least": min(captures),
            "limit": max(moved, 0.015),
        }  # fmt: skip


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
    page="docs/guides/derivatives.md",
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
    page="docs/guides/derivatives.md",
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
    page="docs/guides/derivatives.md",
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
