"""Measure the derivatives of captures against central differences of the full field, and reverse against forward mode.

Writes ``derivative_accuracy.md`` and ``.json`` to the folder that ``--output`` names. Every figure has a limit; where
one is beyond, the exit status is 1. ``--cost`` measures instead what derivatives take, relative to `forward`.

The camera is the paper's main lens at half its size before four lenses. Radiators are held. The step of a difference
is such that the image changes by 1 % of its norm, a quarter of that for the wavelength, and the grids of the full
field are those of the middle, 1.5 times as fine and in windows 2.6 times as wide as for images: what steep orders of
the microlenses fold back, and what wraps round a window, changes fastest with the numbers. Where the detector's width
changes the grids grow with it, and where wavelength or pitch do, the count of microlens orders is held.

A wall of points is differentiated, too, as a capture in its own unit at accuracy 0.02, where the changes of single
spreads nearly cancel; its differences are by full fields of all points. Inside the micro-images of white, the
derivatives by pitch and `mla_distance` must nearly vanish; that table alone takes ten minutes (`--only white`).
"""

from __future__ import annotations

import sys
import time
import tracemalloc
from dataclasses import replace
from functools import partial
from typing import Any

import accuracy
import numpy as np
from scipy import ndimage

from mitsuba_plenoptic.camera import PlenopticCamera
from mitsuba_plenoptic.operator.derivatives import brightness_slopes
from mitsuba_plenoptic.operator.full_field import full_field
from mitsuba_plenoptic.operator.full_field_grids import FieldGrids, field_grids
from mitsuba_plenoptic.operator.operator import CaptureOperator
from mitsuba_plenoptic.optics.spectrum import Spectrum
from mitsuba_plenoptic.runtime.batches import Threads
from mitsuba_plenoptic.runtime.jobs import Job
from mitsuba_plenoptic.system.optical_system import OpticalSystem

WAVELENGTH = 633.0
STEP = 0.01
STEPS = {"wavelength": 0.0025}
"""Steps of differences by numbers whose captures bend sooner, over the norm of the image."""

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


def _error(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def against_full_field(names: set[str]) -> list[accuracy.Row]:
    """Every named number at every point, and 36 aberrations at one."""
    rows = []
    for case, (camera, place) in CASES.items():
        point = np.array(place)
        operator = CaptureOperator(camera, [point], wavelength=WAVELENGTH, accuracy=0)
        size = float(np.linalg.norm(operator.forward([1.0])))
        changes: list[tuple[str, Any, float]] = [(name, 1.0, limit) for name, limit in LIMITS.items()]
        changes = [(name, (0.6, -0.8) if name == "mla_offset" else 1.0, limit) for name, _, limit in changes]
        if case == "square, off axis, near":
            changes += [("wavefront", np.eye(ABERRATIONS)[j].tolist(), 0.005) for j in range(1, ABERRATIONS)]
        for name, change, limit in changes:
            if name not in names:
                continue
            if name == "mla_fill" and camera.mla_fill == 1:
                continue  # it can only shrink, and has no central difference
            found = operator.derivative([1.0], {name: change})
            step = STEPS.get(name, STEP) * size / float(np.linalg.norm(found))
            label = f"wavefront {change.index(1.0) + 1}" if name == "wavefront" else name
            error = _error(found, difference(camera, point, name, change, step))
            rows.append({"case": case, "number": label, "step": step, "error": error, "limit": limit})
            print(f"{case}, {label}: {error:.3%}", flush=True)
    return rows


def walls() -> list[accuracy.Row]:
    """Measure a wall, by the numbers by which its captures must stay white."""
    place = (np.arange(12) + 0.5) / 2 - 3
    x, y = (index.ravel() * HALF.mla_pitch for index in np.meshgrid(place, place))
    points = np.column_stack([-x * 116 / HALF.mla_distance, -y * 116 / HALF.mla_distance, np.full(x.size, 116.0)])
    operator = CaptureOperator(HALF, points, wavelength=WAVELENGTH, accuracy=WALL_ACCURACY)
    weights, rows = np.ones(len(points)), []
    image = operator.forward(weights).astype(np.float64)
    for name, limit in WALL.items():
        unit = float(brightness_slopes(HALF, [name])[name].sum()) * image
        found = operator.derivative(weights, {name: 1.0}).astype(np.float64)
        step = WALL_STEP * float(np.linalg.norm(image) / np.linalg.norm(found))
        expected = sum(difference(HALF, point, name, 1.0, step).astype(np.float64) for point in points)
        error = _error(found + unit, expected + unit)
        rows.append({"case": f"wall of {len(points)} points", "number": name, "error": error, "limit": limit})
        print(f"wall, {name}: {error:.3%}", flush=True)
    return rows


def whites() -> list[accuracy.Row]:
    """Differentiate a white capture in its own unit: it stays white inside the micro-images, whatever pitch and b."""
    camera = HALF.replace(mla_offset=(HALF.mla_pitch / 2,) * 2, detector_width=HALF.mla_pitch, resolution=(32, 32))
    place = ((np.arange(3 * WHITE_PER_LENS) + 0.5) / WHITE_PER_LENS - 1.5) * camera.mla_pitch
    x, y = (part.ravel() for part in np.meshgrid(place, place))
    points = np.column_stack([-x * 116 / camera.mla_distance, -y * 116 / camera.mla_distance, np.full(x.size, 116.0)])
    # finer than from where spreads are shared
    operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=0.0039)
    weights, rows = np.ones(len(points)), []
    image = operator.forward(weights).astype(np.float64)
    lit = image > 0.9 * np.median(image[image > 0.5 * image.max()])
    inside = ndimage.binary_erosion(lit, iterations=WHITE_EDGE)
    for name, limit in WHITE.items():
        unit = float(brightness_slopes(camera, [name])[name].sum()) * image
        change = operator.derivative(weights, {name: 1.0}).astype(np.float64) + unit
        error = float(np.sqrt((change[inside] ** 2).mean()) / np.abs(change).max())
        rows.append({"case": f"white, {inside.sum()} pixels inside", "number": name, "error": error, "limit": limit})
        print(f"white, {name}: {error:.3%}", flush=True)
    return rows


def adjoints() -> list[accuracy.Row]:
    """Compare <A x, y> with <x, A' y>, of the capture and of its derivatives by all numbers, over |A x| |y|."""
    rows = []
    for case, (camera, place) in CASES.items():
        rng = np.random.default_rng(1)
        points = np.array(place) + rng.normal(size=(3, 3)) * (0.01, 0.01, 1.0)
        operator = CaptureOperator(camera, points, spectrum=Spectrum.lines(633, 532), accuracy=0.01)
        weights, image = rng.normal(size=(3, 2)), rng.normal(size=(*camera.shape, 2)).astype(np.float32)
        forward, back = operator.forward(weights).astype(np.float64), operator.adjoint(image)
        scale = float(np.linalg.norm(forward) * np.linalg.norm(image))
        error = abs(np.vdot(forward, image) - np.vdot(weights, back)) / scale
        rows.append({"case": case, "number": "capture", "error": float(error), "limit": 1e-5})
        for name, gradient in operator.gradient(weights, image).items():
            change = rng.normal(size=gradient.shape)
            moved = operator.derivative(weights, {name: change}).astype(np.float64)
            scale = float(np.linalg.norm(moved) * np.linalg.norm(image))
            error = abs(np.vdot(moved, image) - np.vdot(change, gradient)) / scale
            rows.append({"case": case, "number": f"derivative, {name}", "error": float(error), "limit": 1e-4})
    return rows


def cost() -> list[accuracy.Row]:
    """Processor time and NumPy's memory of the reverse and of the forward mode over those of `forward` unshared."""
    rng = np.random.default_rng(2)
    camera = PlenopticCamera(detector_width=0.512, resolution=(256, 256))
    g = rng.uniform(215, 265, 128)
    points = np.column_stack([rng.uniform(-0.2, 0.2, (128, 2)) * -g[:, None] / 120, g])
    weights, image = np.ones(128), rng.normal(size=camera.shape).astype(np.float32)
    rows = []
    for accuracy_ in (0.01, 0.05):
        operator = CaptureOperator(camera, points, wavelength=WAVELENGTH, accuracy=accuracy_)
        job = Job(batch_map=Threads(1))
        figures = {}
        for name, work in {
            "forward": lambda o=operator, j=job: o.forward(weights, job=j),
            "forward mode": lambda o=operator, j=job: o.derivative(weights, {"focal_length": 1.0}, job=j),
            "reverse mode": lambda o=operator, j=job: o.gradient(weights, image, job=j),
        }.items():
            work()
            start = time.process_time()
            work()
            seconds = time.process_time() - start
            tracemalloc.start()
            work()
            figures[name] = seconds, tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        for name in ("forward mode", "reverse mode"):
            ratio, memory = (figures[name][k] / figures["forward"][k] for k in (0, 1))
            rows.append({"accuracy": accuracy_, "mode": name, "time": ratio, "memory": memory})
    return rows


def main() -> None:
    """Measure all cases and write the tables."""
    parser = accuracy.options("derivative_accuracy", __doc__)
    parser.add_argument("--cost", action="store_true", help="what derivatives take, instead of how true they are")
    parser.add_argument("--only", choices=("adjoint", "full_field", "wall", "white"), help="one of the tables")
    parser.add_argument("--numbers", help="by which derivatives are compared with full fields; default: all")
    arguments = accuracy.start(parser)
    if arguments.cost:
        arguments.tool += "_cost"
        rows = cost()
        columns = {
            "accuracy": "{accuracy:g}", "mode": "{mode}", "time": "{time:.1f}", "memory": "{memory:.1f}"
        }  # fmt: skip
        accuracy.finish(
            arguments,
            rows,
            "# What derivatives take, relative to forward, unshared\n",
            accuracy.markdown(columns, rows),
        )
        return
    names = set(arguments.numbers.split(",")) if arguments.numbers else {*LIMITS, "wavefront"}
    tables = {"adjoint": adjoints, "full_field": partial(against_full_field, names), "wall": walls, "white": whites}
    results = {name: table() for name, table in tables.items() if arguments.only in (None, name)}
    for row in (row for rows in results.values() for row in rows):
        row["verdict"] = "kept" if row["error"] <= row["limit"] else "beyond"
    columns = {"case": "{case}", "number": "{number}", "error": "{error:.2e}", "limit": "{limit:g}", "": "{verdict}"}
    titles = {
        "adjoint": "## Reverse against forward, over the product of the norms\n",
        "full_field": "## Against central differences of the full field, relative L2\n",
        "wall": "## Of a wall, against central differences of the full fields, relative L2\n",
        "white": "## Inside micro-images of white, root mean square over the largest at their edges\n",
    }
    texts = [text for name, rows in results.items() for text in (titles[name], accuracy.markdown(columns, rows))]
    accuracy.finish(arguments, results, "# Accuracy of derivatives\n", *texts)
    if any(row["verdict"] == "beyond" for rows in results.values() for row in rows):
        sys.exit(1)


if __name__ == "__main__":
    main()
