"""Derivatives of captures against central differences of the full field, and their cost.

The camera is the paper's main lens at half its size before four lenses. Radiators are held. The step of a difference
is such that the image changes by 1 % of its norm, a quarter of that for the wavelength, and the grids of the full
field are those of the middle, 1.5 times as fine and in windows 2.6 times as wide as for images: what steep orders of
the microlenses fold back, and what wraps round a window, changes fastest with the parameters. Where the detector's
width changes the grids grow with it, and where wavelength or pitch do, the count of microlens orders is held.

The cost of derivatives of captures, compared with the capture itself, and that of a fit's steps by waves, compared with
those by rays.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from cases import relative

from mitsuba_plenoptic import CaptureOperator, PlenopticCamera, load_scene
from mitsuba_plenoptic.camera import change_of, parts_of, with_parts
from mitsuba_plenoptic.fields.optical_system import OpticalSystem
from mitsuba_plenoptic.points.arrival import field_grids
from mitsuba_plenoptic.points.full_fields import full_field

from .. import Pivot, Row, at_most, case, pick
from ..scenes.letters import letter_points
from ..timing import in_process, peak_memory, status_memory

WAVELENGTH = 633.0

STEP = 0.01

STEPS = {"wavelength": 0.0025}
"""Steps of differences by parameters whose captures bend sooner, over the norm of the image."""

WINDOW, FINER = 2.6, 1.5
"""Width and fineness of the full field's windows over those for images."""


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


def difference(
    camera: PlenopticCamera,
    point: np.ndarray,
    name: str,
    change: Any,
    step: float,
    finer: float = FINER,
    window: float = WINDOW,
) -> np.ndarray:
    """Central difference of the full field."""
    base = field_grids(OpticalSystem(camera, WAVELENGTH), point, finer, window)
    sides = []
    for amount in (step, -step):
        changed, wavelength = camera, WAVELENGTH
        if name == "wavelength":
            wavelength += amount
        else:
            value = amount * change_of(camera, name, change)
            present = parts_of(camera, name)
            value[: len(present)] += present
            # The detector stays where it stands, whatever focal length its distance follows.
            changed = with_parts(camera, {name: value}, detector_distance=camera.detector_distance)
        growth = changed.detector_width / camera.detector_width
        order = wavelength / WAVELENGTH * camera.row_pitch / changed.row_pitch
        x, y = base.wide_origin
        grown = {"pitch": base.pitch * growth, "wide_origin": (x * growth, y * growth)}
        grids = replace(base, bend=base.bend * order * (1 + 1e-9), **grown)
        sides.append(full_field(OpticalSystem(changed, wavelength), point, grids=grids))
    return (sides[0] - sides[1]) / (2 * step)


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
    "derivative-cost.steps",
    "A step of Adam on the distance of the microlens array, by waves and by rays, for parts of the letters: processor "
    "time of the median step of a camera that changes. Rays by waves fill a margin of 2.5 lenses around the pixels",
    {
        "pixels": "{pixels}", "lenses": "{lenses:.0f}", "samples": "{samples}", "rays (s)": "{rays:.3f}",
        "waves (s)": "{waves:.3f}", "waves over rays": "{ratio:.1f}",
    },
    (at_most("ratio of eight lenses", 8.0),),
    page="docs/guides/derivatives.md",
    quick={"cases": ((64, 8, 16),)},
)  # fmt: skip
def steps(
    *,
    cases: tuple[tuple[int, int, int], ...] = ((64, 2, 16), (64, 4, 16), (64, 8, 16), (64, 8, 64), (256, 8, 16)),
    count: int = 7,
) -> Iterator[Row]:
    """Run the steps, with a camera whose distance starts 0.2 % too long; the first two steps are left out."""
    for pixels, lenses, samples in cases:
        rays, waves = (in_process(_step, kind, pixels, lenses, samples, count) for kind in ("direct", "plenoptic_wave"))
        row = {"pixels": pixels, "lenses": lenses, "samples": samples, "rays": rays, "waves": waves}
        row["ratio"] = waves / rays
        yield row | ({"ratio of eight lenses": row["ratio"]} if lenses >= 8 else {})


def _step(kind: str, pixels: int, lenses: int, samples: int, count: int) -> float:
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    parameters = {"resolution": str(pixels), "detector_width": str(0.064 * lenses)}
    scene = load_scene("letters", parameters=parameters)
    integrator = mi.load_dict({"type": kind})
    params = mi.traverse(scene)
    key = "camera.mla_distance"
    start = float(params[key][0])
    with dr.suspend_grad():
        target = mi.render(scene, spp=samples, integrator=integrator, seed=0)
    optimizer = mi.ad.Adam(lr=1e-4 * start)
    optimizer[key] = mi.Float(1.002 * start)
    taken = []
    for seed in range(count):
        began = time.process_time()
        params.update(optimizer)
        image = mi.render(scene, params, spp=samples, integrator=integrator, seed=seed)
        dr.backward(dr.mean(dr.square(image - target), axis=None))
        optimizer.step()
        dr.eval(optimizer[key])
        dr.sync_thread()
        taken.append(time.process_time() - began)
    return float(np.median(taken[2:]))
